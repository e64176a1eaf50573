"""Sinks of readings: JSON lines, datagrams, MCAP and Foxglove, Rerun, ROS 2 over Zenoh."""

import errno
import itertools
import json
import os
import re
import secrets
import socket
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from sliplens.errors import InputError
from sliplens.extras import Table, require_packages
from sliplens.files import to_builtins
from sliplens.images import encode_jpeg, encode_png
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


def _stamp(reading: Reading) -> tuple[int, int]:
    """Compute the time of a capture since 1970, in whole seconds and nanoseconds."""
    captured_s = reading.captured_s if np.isfinite(reading.captured_s) else time.monotonic()
    return divmod(round(1e9 * (captured_s + _EPOCH_S)), 10**9)


def _open_json(address: str) -> Sink:
    if address:
        raise InputError(f"--sink json prints on standard output and takes no address, got {address}; leave it out")

    def send(reading: Reading, _: Frame | None) -> None:
        sys.stdout.buffer.write(encode_reading(reading) + b"\n")
        sys.stdout.buffer.flush()

    return Sink(send)


_TRANSIENT = (
    errno.EAGAIN, errno.ECONNREFUSED, errno.ENETUNREACH, errno.EHOSTUNREACH, errno.ENETDOWN, errno.ENOBUFS,
)  # fmt: skip
"""Errors at which a datagram is lost and the next, newer one is sent: no listener, a full buffer, no network."""


def _split_address(address: str, *, kind: str) -> tuple[str, int]:
    """Split HOST:PORT or :PORT; this machine where no host is named."""
    host, _, number = address.rpartition(":")
    if not number.isdecimal() or not 0 < int(number) <= 65535:
        raise InputError(f"--sink {kind}:{address} names no port; give {kind}:HOST:PORT, as {kind}:127.0.0.1:9870")
    return host.strip("[]") or "127.0.0.1", int(number)


def _open_udp(address: str) -> Sink:
    host, port = _split_address(address, kind="udp")
    try:
        [(family, kind, protocol, _, target), *_] = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
    except socket.gaierror as error:
        raise InputError(f"--sink udp: {host} is not known ({error.strerror}); give an address") from None
    outgoing = socket.socket(family, kind, protocol)
    outgoing.setblocking(False)

    def send(reading: Reading, _: Frame | None) -> None:
        try:
            outgoing.sendto(encode_reading(reading), target)
        except OSError as error:
            if error.errno not in _TRANSIENT:
                raise

    return Sink(send, outgoing.close)


READING_TOPIC, IMAGE_TOPIC = "/sliplens/reading", "/sliplens/image"
"""Topics of Foxglove and MCAP: readings as JSON, frames as `foxglove.CompressedImage`."""
_BACKLOG = 8  # messages that wait for a slow viewer: old readings help nobody


def _open_foxglove(address: str, *, is_file: bool = False) -> Sink:
    """Send readings and frames on two topics of Foxglove, of a server or in an MCAP file."""
    kind = "mcap" if is_file else "foxglove"
    path = _new_file(address, kind=kind) if is_file else None
    host, port = ("", 0) if is_file else _split_address(address or ":8765", kind=kind)
    require_packages("foxglove", extra="sinks", purpose=f"--sink {kind}")
    import foxglove  # noqa: PLC0415 (an extra)
    from foxglove.channels import CompressedImageChannel  # noqa: PLC0415
    from foxglove.messages import CompressedImage, Timestamp  # noqa: PLC0415

    context = foxglove.Context()
    readings = foxglove.Channel(READING_TOPIC, schema=msgspec.json.decode(reading_schema()), context=context)
    frames = CompressedImageChannel(IMAGE_TOPIC, context=context)
    try:
        if path is not None:
            close = foxglove.open_mcap(str(path), context=context).close
        else:
            server = {"host": host, "port": port, "message_backlog_size": _BACKLOG}
            close = foxglove.start_server(name="sliplens", context=context, **server).stop
    except (OSError, RuntimeError) as error:
        raise InputError(f"{path or f'{host}:{port}'} cannot be opened ({error}); name another with --sink") from None

    def send(reading: Reading, image: Frame | None) -> None:
        seconds, nanoseconds = _stamp(reading)
        at_ns = seconds * 10**9 + nanoseconds
        readings.log(encode_reading(reading), log_time=at_ns)
        if image is not None:
            stamp, data = Timestamp(sec=seconds, nsec=nanoseconds), encode_jpeg(image, _QUALITY)
            frames.log(CompressedImage(timestamp=stamp, frame_id=_FRAME_ID, data=data, format="jpeg"), log_time=at_ns)

    # a context that is collected closes its channels
    return Sink(send, lambda _=context: close())


def _new_file(address: str, *, kind: str) -> Path:
    path, suffix = Path(address), {"rerun": ".rrd"}.get(kind, f".{kind}")
    if path.suffix != suffix:
        raise InputError(f"--sink {kind} writes a file that ends in {suffix}; give {kind}:grip{suffix}")
    if path.exists():
        raise InputError(f"{path} is there already; name another file, or move it away")
    if not path.parent.is_dir():
        raise InputError(f"the folder {path.parent} does not exist; make it, or name another file")
    return path


class RerunSink:
    """Readings and frames for the Rerun viewer, by the stream that is connected to a file or a viewer.

    Its entities are `margin`, `interval/low`, `interval/high`, `words` and `frame`; with `lossless`, images are PNG.
    """

    def __init__(self, *, lossless: bool = False) -> None:
        require_packages("rerun", extra="view", purpose="the Rerun viewer")
        import rerun  # noqa: PLC0415 (an extra, and large)

        self.rerun, self._lossless, self.stream = rerun, lossless, rerun.RecordingStream("sliplens")
        if not self.stream.is_enabled():
            raise InputError("the environment variable RERUN switches Rerun off; unset it")

    @staticmethod
    def in_ns(time_s: Any) -> Any:
        """Convert seconds to what Rerun takes as a duration; it would cut off what is less than a nanosecond."""
        return np.round(1e9 * np.asarray(time_s)).astype("timedelta64[ns]")

    def set_frame(self, number: int, time_s: float) -> None:
        """Set number and time of the frame that is logged next."""
        self.stream.set_time("time", duration=self.in_ns(time_s))
        self.stream.set_time("frame", sequence=number)

    def log_image(self, entity: str, image: Frame, *, static: bool = False) -> None:
        """Log an image."""
        data, kind = (encode_png(image), "png") if self._lossless else (encode_jpeg(image, _QUALITY), "jpeg")
        self.stream.log(entity, self.rerun.EncodedImage(contents=data, media_type=f"image/{kind}"), static=static)

    def send(self, reading: Reading, image: Frame | None, /) -> None:
        """Log a reading on the clock of the source; one without a time is left out."""
        if not np.isfinite(reading.time_s):
            return
        self.set_frame(reading.number, reading.time_s)
        ends = ("margin", reading.margin), ("interval/low", reading.low), ("interval/high", reading.high)
        for entity, value in ends:
            # a withheld margin ends the line, and is no longer shown as the newest
            scalar = self.rerun.Clear(recursive=False) if value is None else self.rerun.Scalars(value)
            self.stream.log(entity, scalar)
        self.stream.log("words", self.rerun.TextLog(str(describe_reading(reading))))
        if image is not None:
            self.log_image("frame", image)

    def close(self) -> None:
        """Write what waits, and end the stream."""
        self.stream.flush()
        self.stream.disconnect()


def _open_rerun(address: str) -> Sink:
    path, sink = _new_file(address, kind="rerun"), RerunSink()
    sink.stream.save(path)
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
        If a package is missing, or nobody is there.

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
        # it connects to the given address and calls out to nobody else
        settings = {
            "mode": "client",
            "connect": {"endpoints": [address], "timeout_ms": _ZENOH_PATIENCE_MS},
            "scouting": {"multicast": {"enabled": False}},
        }
        try:
            self._session = zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
        except zenoh.ZError as error:
            raise InputError(
                f"{purpose} reaches nobody at {address} ({error}); start zenoh-bridge-ros2dds or rmw_zenohd there, "
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
        seconds, nanoseconds = _stamp(reading)
        at_ns = seconds * 10**9 + nanoseconds
        publish["reading"]([encode_reading(reading).decode()], at_ns)
        if reading.margin is not None:
            publish["margin"]([reading.margin], at_ns)
        if image is not None:
            stamp = ros.message("builtin_interfaces/msg/Time", seconds, nanoseconds)
            data = np.frombuffer(encode_jpeg(image, _QUALITY), dtype=np.uint8)
            publish["image/compressed"]([ros.message("std_msgs/msg/Header", stamp, _FRAME_ID), "jpeg", data], at_ns)

    return Sink(send, ros.close)


SINKS = Table[Callable[[str], Sink]](
    "sink",
    "sliplens.sinks",
    {
        "json": _open_json,
        "udp": _open_udp,
        "mcap": partial(_open_foxglove, is_file=True),
        "foxglove": _open_foxglove,
        "rerun": _open_rerun,
        "zenoh": _open_zenoh,
    },
)
"""Sinks by kind, each opened with an address; an installed package adds its own by the entry point `sliplens.sinks`."""


def open_sink(name: str) -> Sink:
    """Open a sink by the name of its row, and its address after a colon where it has one.

    Raises
    ------
    InputError
        If there is no such sink, or it cannot be opened.
    """
    kind, _, address = name.partition(":")
    return SINKS.pick(kind)(address)


_MOST_WAITING_BYTES = 64 * 2**20  # a second or two of a camera
_READING_BYTES = 4096


class Sender(Outlet[tuple[Reading, Frame | None]]):
    """Sends readings to a sink in a thread of its own: a slow sink loses readings, and delays none.

    Parameters
    ----------
    name
        As `open_sink` takes it.
    """

    def __init__(self, name: str) -> None:
        sink = open_sink(name)
        most_bytes, cure = _MOST_WAITING_BYTES, "begin it anew"
        super().__init__(name, lambda item: sink.send(*item), sink.close, most_bytes=most_bytes, cure=cure)

    def take(self, reading: Reading, frame: LiveFrame | None) -> None:
        """Take a reading and its frame, without waiting."""
        image = None if frame is None else frame.image
        self.put((reading, image), size_bytes=_READING_BYTES + (0 if image is None else image.nbytes))


__all__ = [
    "IMAGE_TOPIC", "READING_TOPIC", "ROS_TOPICS", "SINKS", "RerunSink", "Sender", "Sink",
    "ZenohRos", "encode_reading", "open_sink", "parse_zenoh", "reading_schema",
]  # fmt: skip
