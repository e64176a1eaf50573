"""Sinks of readings: JSON lines, MCAP, Rerun, ROS 2 over Zenoh."""

import itertools
import json
import os
import re
import secrets
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from sliplens.errors import InputError
from sliplens.extras import Table, require_packages
from sliplens.files import to_builtins
from sliplens.images import encode_image
from sliplens.live.mailbox import Outlet
from sliplens.live.reading import LiveFrame, Reading, ReadingWords, describe_reading
from sliplens.recordings.capture import Frame


class Sink(NamedTuple):
    """Takes readings, one after another."""

    send: Callable[[Reading, Frame | None], None]
    """Sends a reading, and its frame where there is one."""
    close: Callable[[], None] = lambda: None
    """Sends what waits, and ends."""


def encode_reading(reading: Reading) -> bytes:
    """Encode a reading and its `words` as one line of JSON; unknown values are null."""
    return msgspec.json.encode({**to_builtins(reading), "words": to_builtins(describe_reading(reading))})


def reading_schema() -> bytes:
    """Return the JSON schema of an encoded reading as JSON, an object at its root as Foxglove wants it."""
    (_, words), parts = msgspec.json.schema_components([Reading, ReadingWords], ref_template="#/$defs/{name}")
    schema = parts.pop("Reading")
    return msgspec.json.encode({**schema, "properties": {**schema["properties"], "words": words}, "$defs": parts})


_EPOCH_S = time.time() - time.monotonic()
"""Time of the machine's start, computed once so that stamps stay in order: captures count from there."""
_QUALITY = 90
_FRAME_ID = "fingertip"


def _stamp(reading: Reading) -> tuple[int, tuple[int, int]]:
    """Compute the time of a capture since 1970, in nanoseconds, and in whole seconds and the rest."""
    captured_s = reading.captured_s if np.isfinite(reading.captured_s) else time.monotonic()
    at_ns = round(1e9 * (captured_s + _EPOCH_S))
    return at_ns, divmod(at_ns, 10**9)


def _open_json(address: str) -> Sink:
    if address:
        raise InputError(f"--sink json prints on standard output and takes no address, got {address}; leave it out")

    def send(reading: Reading, _: Frame | None) -> None:
        sys.stdout.buffer.write(encode_reading(reading) + b"\n")
        sys.stdout.buffer.flush()

    return Sink(send)


READING_TOPIC, IMAGE_TOPIC = "/sliplens/reading", "/sliplens/image"
"""Topics of MCAP files: readings and frames (`foxglove.CompressedImage`), both as JSON."""
_FIELDS = {
    "timestamp": {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}},
    "frame_id": {"type": "string"},
    "format": {"type": "string"},
    "data": {"type": "string", "contentEncoding": "base64"},
}


def _open_mcap(address: str) -> Sink:
    """Write readings and frames into an MCAP file, which Foxglove opens."""
    require_packages("mcap", extra="sinks", purpose="--sink mcap")
    from mcap.writer import Writer  # noqa: PLC0415 (an extra)

    file = _new_file(address, kind="mcap", suffix=".mcap").open("wb")
    writer = Writer(file)
    writer.start()
    image_schema = msgspec.json.encode({"type": "object", "properties": _FIELDS})
    schemas = {"Reading": reading_schema(), "foxglove.CompressedImage": image_schema}
    readings, images = (
        writer.register_channel(topic, "json", writer.register_schema(name, "jsonschema", schema))
        for topic, (name, schema) in zip((READING_TOPIC, IMAGE_TOPIC), schemas.items(), strict=True)
    )

    def send(reading: Reading, image: Frame | None) -> None:
        at_ns, (seconds, nanoseconds) = _stamp(reading)
        writer.add_message(readings, at_ns, encode_reading(reading), at_ns)
        if image is not None:
            stamp, data = {"sec": seconds, "nsec": nanoseconds}, encode_image(image, jpeg_quality=_QUALITY)
            picture = {"timestamp": stamp, "frame_id": _FRAME_ID, "format": "jpeg", "data": data}
            writer.add_message(images, at_ns, msgspec.json.encode(picture), at_ns)

    def close() -> None:
        with file:
            writer.finish()

    return Sink(send, close)


def _new_file(address: str, *, kind: str, suffix: str) -> Path:
    """Make a file that does not exist."""
    path = Path(address)
    if path.suffix != suffix:
        raise InputError(f"--sink {kind} writes a file that ends in {suffix}; give {kind}:grip{suffix}")
    try:
        path.open("xb").close()
    except OSError as error:
        raise InputError(f"{path} cannot be written ({error.strerror}); name a new file in a folder") from None
    return path


_LINES = {
    "margin": ("predicted margin", (213, 94, 0)),
    "interval/low": ("its 90 % interval, low", (230, 159, 0)),
    "interval/high": ("its 90 % interval, high", (230, 159, 0)),
    "true": ("true margin", (86, 180, 233)),
}
"""Names and colours (Okabe and Ito) of the numbers of a frame, by entity; read on a dark ground and on a light one."""


class RerunSink:
    """Readings and frames for the Rerun viewer, by the stream that is connected to a file or a viewer.

    Its entities are `margin`, `interval/low`, `interval/high`, `true`, `words` and `frame`; with `lossless`, images are
    PNG.
    """

    def __init__(self, *, lossless: bool = False) -> None:
        require_packages("rerun", extra="view", purpose="the Rerun viewer")
        import rerun  # noqa: PLC0415 (an extra, and large)

        self.rerun, self._lossless, self.stream = rerun, lossless, rerun.RecordingStream("sliplens")
        if not self.stream.is_enabled():
            raise InputError("the environment variable RERUN switches Rerun off; unset it")

    def send_layout(self, maps: Iterable[str] = ()) -> None:
        """Lay out the views: the frame with what lies over it, maps by method, and the margins over time."""
        from rerun import blueprint  # noqa: PLC0415 (an extra, and large)

        for entity, (name, colour) in _LINES.items():
            self.stream.log(entity, self.rerun.SeriesLines(names=name, colors=[colour]), static=True)
        pictures = [blueprint.Spatial2DView(origin="frame")]
        pictures += [blueprint.Spatial2DView(origin=f"map/{name}") for name in maps]
        margins = blueprint.TimeSeriesView(
            contents=list(_LINES),
            name="safety margin (1 sticks, 0 slips)",
            axis_y=blueprint.ScalarAxis(range=(-0.05, 1.05)),
        )
        layout = blueprint.Horizontal(blueprint.Vertical(*pictures), margins)
        self.stream.send_blueprint(blueprint.Blueprint(layout, collapse_panels=True))

    def log_image(self, entity: str, image: Frame) -> None:
        """Log an image."""
        kind, quality = ("png", None) if self._lossless else ("jpeg", _QUALITY)
        data = encode_image(image, jpeg_quality=quality)
        self.stream.log(entity, self.rerun.EncodedImage(contents=data, media_type=f"image/{kind}"))

    def send(self, reading: Reading, image: Frame | None, /) -> None:
        """Log a reading on the clock of the source; one without a time is left out."""
        if not np.isfinite(reading.time_s):
            return
        # it would cut off what is less than a nanosecond
        self.stream.set_time("time", duration=np.timedelta64(round(1e9 * reading.time_s), "ns"))
        self.stream.set_time("frame", sequence=reading.number)
        for entity, value in zip(_LINES, (reading.margin, reading.low, reading.high, reading.true_margin), strict=True):
            # a withheld margin ends the line, and is no longer shown as the newest
            scalar = self.rerun.Clear(recursive=False) if value is None else self.rerun.Scalars(value)
            self.stream.log(entity, scalar)
        if reading.margin is not None or reading.withheld or reading.slip:
            self.stream.log("words", self.rerun.TextLog(str(describe_reading(reading))))
        if image is not None:
            self.log_image("frame", image)

    def close(self) -> None:
        """Write what waits, and end the stream."""
        self.stream.flush()
        self.stream.disconnect()


def _open_rerun(address: str) -> Sink:
    sink = RerunSink()
    sink.stream.save(_new_file(address, kind="rerun", suffix=".rrd"))
    sink.send_layout()
    return Sink(sink.send, sink.close)


ROS_TOPICS = {
    "margin": "std_msgs/msg/Float32",
    "reading": "std_msgs/msg/String",
    "image/compressed": "sensor_msgs/msg/CompressedImage",
}
"""Topics of ROS 2 below the key of the sink `zenoh`, and their types; a withheld margin is not sent at all."""
ZENOH_ADDRESS = "tcp/127.0.0.1:7447"
_ZENOH_PATIENCE_MS = 3000


class ZenohRos:
    """Messages of ROS 2 in its own encoding (CDR) over Zenoh, for nodes that reach it by a bridge or by `rmw_zenoh`.

    Each topic has two names: its own, as `zenoh-bridge-ros2dds` has it, and the one that `rmw_zenoh` makes of domain,
    topic, type and its hash, with the attachment that it asks for. Messages are sent under both, and go on the way only
    where somebody listens.

    Parameters
    ----------
    address
        Router or bridge to connect to.
    purpose
        Option or part of the program that needs it, for messages.

    Raises
    ------
    InputError
        If a package is missing, or nothing answers.

    References
    ----------
    Open Source Robotics Foundation, *rmw_zenoh design* (topics, attachments).
    """

    def __init__(self, address: str = ZENOH_ADDRESS, *, purpose: str) -> None:
        require_packages("zenoh", "rosbags", extra="sinks", purpose=purpose)
        import zenoh  # noqa: PLC0415 (an extra)
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
        from zenoh import ext  # noqa: PLC0415

        self._types, self._ext, self._error = get_typestore(Stores.LATEST), ext, zenoh.ZError
        # it connects to the given address and contacts no other host
        settings = {
            "mode": "client",
            "connect": {"endpoints": [address], "timeout_ms": _ZENOH_PATIENCE_MS},
            "scouting": {"multicast": {"enabled": False}},
        }
        try:
            self._session = zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
        except zenoh.ZError as error:
            raise InputError(
                f"{purpose} reaches nothing at {address} ({error}); start zenoh-bridge-ros2dds or rmw_zenohd there, "
                "or name another with zenoh:KEY@tcp/HOST:PORT"
            ) from None

    def define(self, kind: str, definition: str) -> None:
        """Add a type of messages that ROS itself does not bring, as its `.msg` file has it."""
        from rosbags.typesys import get_types_from_msg  # noqa: PLC0415 (an extra)

        if kind not in self._types.types:
            self._types.register(get_types_from_msg(definition, kind))

    def message(self, kind: str, *values: Any) -> object:
        """Make a message of a type from its fields in order."""
        return self._types.types[kind](*values)

    def publisher(self, topic: str, kind: str) -> Callable[[Sequence[object], int], None]:
        """Declare a topic; returns a function that sends a message of some fields at nanoseconds since 1970.

        It raises `OSError` where the connection is closed.
        """
        by_name, by_type = (self._session.declare_publisher(name) for name in self._names(topic, kind))
        ext, sender_id, count = self._ext, secrets.token_bytes(16), itertools.count(1)

        def send(fields: Sequence[object], at_ns: int) -> None:
            encoded = bytes(self._types.serialize_cdr(self.message(kind, *fields), kind))
            attachment = ext.z_serialize((ext.Int64(next(count)), ext.Int64(at_ns), sender_id))
            try:
                by_name.put(encoded)
                by_type.put(encoded, attachment=attachment)
            except self._error as error:
                raise OSError(str(error)) from None

        return send

    def subscribe(self, topic: str, kind: str, callback: Callable[[bytes], None]) -> None:
        """Call back with each message of a topic, undecoded, in a thread of Zenoh's."""
        for name in self._names(topic, kind):
            self._session.declare_subscriber(name, lambda sample: callback(bytes(sample.payload)))

    def decode(self, message: bytes, kind: str) -> Any:
        """Decode a message of a type; raises whatever the decoder does at one of another."""
        return self._types.deserialize_cdr(message, kind)

    def close(self) -> None:
        """Leave the router."""
        self._session.close()

    def _names(self, topic: str, kind: str) -> tuple[str, str]:
        package, _, message = kind.split("/")
        domain = os.environ.get("ROS_DOMAIN_ID") or "0"
        return topic, f"{domain}/{topic}/{package}::msg::dds_::{message}_/{self._types.hash_rihs01(kind)}"


def parse_zenoh(address: str, *, purpose: str) -> tuple[str, str]:
    """Split KEY or KEY@tcp/HOST:PORT into the key of the topics and the address of the router."""
    key, at, where = address.partition("@")
    if not re.fullmatch(r"[A-Za-z]\w*(/[A-Za-z]\w*)*", key) or bool(at) != bool(where):
        raise InputError(
            f"{purpose}:{address} names no key that ROS can have; give letters and digits, as zenoh:tip or "
            f"zenoh:tip@{ZENOH_ADDRESS}"
        )
    return key, where or ZENOH_ADDRESS


def _open_zenoh(address: str) -> Sink:
    """Send readings and frames to ROS; the key `tip` names `/tip/margin`, `/tip/reading`, `/tip/image/compressed`."""
    key, router = parse_zenoh(address, purpose="--sink zenoh")
    ros = ZenohRos(router, purpose="--sink zenoh")
    publish = {name: ros.publisher(f"{key}/{name}", kind) for name, kind in ROS_TOPICS.items()}

    def send(reading: Reading, image: Frame | None) -> None:
        at_ns, (seconds, nanoseconds) = _stamp(reading)
        publish["reading"]([encode_reading(reading).decode()], at_ns)
        if reading.margin is not None:
            publish["margin"]([reading.margin], at_ns)
        if image is not None:
            stamp = ros.message("builtin_interfaces/msg/Time", seconds, nanoseconds)
            data = np.frombuffer(encode_image(image, jpeg_quality=_QUALITY), dtype=np.uint8)
            publish["image/compressed"]([ros.message("std_msgs/msg/Header", stamp, _FRAME_ID), "jpeg", data], at_ns)

    return Sink(send, ros.close)


SINKS = Table[Callable[[str], Sink]](
    "sink",
    "sliplens.sinks",
    {
        "json": _open_json,
        "mcap": _open_mcap,
        "rerun": _open_rerun,
        "zenoh": _open_zenoh,
    },
)
"""Sinks by kind, each opened with an address; an installed package adds its own by the entry point `sliplens.sinks`."""


_MOST_WAITING_BYTES = 64 * 2**20  # a second or two of a camera
_READING_BYTES = 4096


class Sender(Outlet[tuple[Reading, Frame | None]]):
    """Outlet of readings to a sink, by its row and, after a colon, its address; a slow one loses readings."""

    def __init__(self, name: str) -> None:
        kind, _, address = name.partition(":")
        sink = SINKS.pick(kind)(address)
        super().__init__(name, send=lambda item: sink.send(*item), end=sink.close, most_bytes=_MOST_WAITING_BYTES)

    def add(self, reading: Reading, frame: LiveFrame | None) -> None:
        """Take a reading and its frame, without waiting."""
        image = None if frame is None else frame.image
        self.put((reading, image), size_bytes=_READING_BYTES + (0 if image is None else image.nbytes))
