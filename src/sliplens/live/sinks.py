"""Where readings go: one row a kind of sink."""

import errno
import itertools
import json
import os
import re
import secrets
import socket
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import msgspec
import numpy as np

from sliplens.errors import InputError
from sliplens.extras import Table, require_packages
from sliplens.files import to_builtins
from sliplens.images import encode_jpeg, encode_png
from sliplens.live.mailbox import Outlet
from sliplens.live.reading import LiveFrame, Reading, ReadingWords, describe_reading
from sliplens.progress import number_of
from sliplens.recordings.capture import Frame


@runtime_checkable
class Sink(Protocol):
    """Takes readings, one after another."""

    def send(self, reading: Reading, image: Frame | None, /) -> None:
        """Send a reading, and the frame that it was made from where there is one."""
        ...

    def close(self) -> None:
        """Send what waits, and end."""
        ...


def encode_reading(reading: Reading) -> bytes:
    """One line of JSON: the reading, and its `words`; what is not known is null."""
    return msgspec.json.encode({**to_builtins(reading), "words": to_builtins(describe_reading(reading))})


class JsonLines:
    """One line of JSON a reading on standard output."""

    def send(self, reading: Reading, _: Frame | None, /) -> None:
        """Print a line, at once."""
        sys.stdout.buffer.write(encode_reading(reading) + b"\n")
        sys.stdout.buffer.flush()

    def close(self) -> None:
        """Nothing waits."""


def _open_json(address: str) -> Sink:
    if address:
        raise InputError(f"--sink json prints on standard output and takes no address, got {address}; leave it out")
    return JsonLines()


class Datagrams:
    """A JSON object a reading, as one UDP datagram; what nobody listens for is gone.

    Parameters
    ----------
    host, port
        Where they are sent.
    """

    def __init__(self, host: str, port: int) -> None:
        try:
            [(family, kind, protocol, _, self._address), *_] = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
        except socket.gaierror as error:
            raise InputError(f"--sink udp: {host} is not known ({error.strerror}); give an address") from None
        self._socket = socket.socket(family, kind, protocol)
        self._socket.setblocking(False)

    def send(self, reading: Reading, _: Frame | None, /) -> None:
        """Send a datagram, without waiting."""
        try:
            self._socket.sendto(encode_reading(reading), self._address)
        except OSError as error:
            # nobody listens, the buffer is full, the network is away for a while: the next reading is newer anyway
            if error.errno not in _PASSING:
                raise

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


_PASSING = (
    errno.EAGAIN, errno.ECONNREFUSED, errno.ENETUNREACH, errno.EHOSTUNREACH, errno.ENETDOWN, errno.ENOBUFS,
)  # fmt: skip


def _host_and_port(address: str, *, kind: str, port: int | None = None) -> tuple[str, int]:
    """Parts of HOST:PORT, of :PORT, or of nothing where there is a usual port; this machine where no host is named."""
    host, _, number = address.rpartition(":")
    if not address and port is not None:
        return "127.0.0.1", port
    if not number.isdecimal() or not 0 <= int(number) <= 65535:
        raise InputError(f"--sink {kind}:{address} names no port; give {kind}:HOST:PORT, as {kind}:127.0.0.1:9870")
    return host.strip("[]") or "127.0.0.1", int(number)


def _open_udp(address: str) -> Sink:
    host, port = _host_and_port(address, kind="udp")
    if port == 0:
        raise InputError("--sink udp cannot send to port 0; give udp:HOST:PORT, as udp:127.0.0.1:9870")
    return Datagrams(host, port)


READING_TOPIC, IMAGE_TOPIC = "/sliplens/reading", "/sliplens/image"
"""Topics of Foxglove and MCAP: readings as JSON, frames as `foxglove.CompressedImage`."""
_BACKLOG = 8  # messages that wait for a slow viewer: old readings help nobody
_FOXGLOVE_PORT = 8765


def reading_schema() -> dict[str, Any]:
    """JSON schema of a reading, an object at its root as Foxglove wants it."""
    (_, words), parts = msgspec.json.schema_components([Reading, ReadingWords], ref_template="#/$defs/{name}")
    schema = parts.pop("Reading")
    return {**schema, "properties": {**schema["properties"], "words": words}, "$defs": parts}


class FoxgloveTopics:
    """Readings and frames on two topics of Foxglove: of a server that viewers visit, or in an MCAP file.

    Parameters
    ----------
    path
        MCAP file to write; None for a server.
    host, port
        Where the server listens.
    """

    def __init__(self, *, path: Path | None = None, host: str = "127.0.0.1", port: int = _FOXGLOVE_PORT) -> None:
        require_packages("foxglove", extra="sinks", purpose=f"--sink {'mcap' if path else 'foxglove'}")
        import foxglove  # noqa: PLC0415 (an extra)
        from foxglove.channels import CompressedImageChannel  # noqa: PLC0415
        from foxglove.messages import CompressedImage, Timestamp  # noqa: PLC0415

        # without a reference to it, its channels are closed
        self._context = context = foxglove.Context()
        self._image, self._timestamp, self._stamps = CompressedImage, Timestamp, _Stamps()
        self._readings = foxglove.Channel(READING_TOPIC, schema=reading_schema(), context=context)
        self._frames = CompressedImageChannel(IMAGE_TOPIC, context=context)
        try:
            if path is not None:
                self._close = foxglove.open_mcap(str(path), context=context).close
                return
            server = foxglove.start_server(
                name="sliplens", host=host, port=port, context=context, message_backlog_size=_BACKLOG
            )
        except (OSError, RuntimeError) as error:
            where = str(path) if path else f"{host}:{port}"
            raise InputError(f"{where} cannot be opened ({error}); name another with --sink") from None
        self.port = server.port
        """Port on which the server listens."""
        self._close = server.stop

    def send(self, reading: Reading, image: Frame | None, /) -> None:
        """Send the reading and its frame, at the time of its capture."""
        at_ns = self._stamps.of(reading)
        self._readings.log(encode_reading(reading), log_time=at_ns)
        if image is not None:
            stamp = self._timestamp(sec=at_ns // 10**9, nsec=at_ns % 10**9)
            frame = self._image(timestamp=stamp, frame_id=_FRAME_ID, data=encode_jpeg(image, _QUALITY), format="jpeg")
            self._frames.log(frame, log_time=at_ns)

    def close(self) -> None:
        """End the file, or the server."""
        self._close()


_QUALITY = 90
_FRAME_ID = "fingertip"


class _Stamps:
    """Times of captures as other programs count them: readings count from whenever the machine was started."""

    def __init__(self) -> None:
        self._epoch_s = time.time() - time.monotonic()  # once, so that what follows stays in order

    def of(self, reading: Reading) -> int:
        """Nanoseconds since 1970."""
        captured_s = reading.captured_s if np.isfinite(reading.captured_s) else time.monotonic()
        return round(1e9 * (captured_s + self._epoch_s))


def _open_foxglove(address: str) -> Sink:
    host, port = _host_and_port(address, kind="foxglove", port=_FOXGLOVE_PORT)
    return FoxgloveTopics(host=host, port=port)


def _open_mcap(address: str) -> Sink:
    path = _new_file(address, kind="mcap")
    return FoxgloveTopics(path=path)


def _new_file(address: str, *, kind: str) -> Path:
    path = Path(address)
    ending = {"rerun": "rrd"}.get(kind, kind)
    if path.suffix != f".{ending}":
        raise InputError(f"--sink {kind} writes a file that ends in .{ending}; give {kind}:grip.{ending}")
    if path.exists():
        raise InputError(f"{path} is there already; name another file, or move it away")
    if not path.parent.is_dir():
        raise InputError(f"the folder {path.parent} does not exist; make it, or name another file")
    return path


class RerunSink:
    """Readings and frames for the Rerun viewer.

    Its entities are `margin`, `interval/low`, `interval/high`, `words` and `frame`.

    Parameters
    ----------
    connect
        Opens the stream that it is given: to a file, or to a running viewer.
    lossless
        If True, frames are stored as PNG, else as JPEG.
    """

    def __init__(
        self, connect: Callable[[Any], None], *, application: str = "sliplens-live", lossless: bool = False
    ) -> None:
        require_packages("rerun", extra="sinks", purpose="--sink rerun")
        import rerun  # noqa: PLC0415 (an extra, and large)

        self._rerun, self._lossless = rerun, lossless
        self.stream = rerun.RecordingStream(application)
        connect(self.stream)

    def set_frame(self, number: int, time_s: float) -> None:
        """Set number and time of the frame that is logged next."""
        # Rerun would cut off what is less than a nanosecond
        self.stream.set_time("time", duration=np.timedelta64(round(1e9 * time_s), "ns"))
        self.stream.set_time("frame", sequence=number)

    def log(self, entity: str, value: Any, *, static: bool = False) -> None:
        """Log a value of Rerun's at the frame that was set, or for all frames."""
        self.stream.log(entity, value, static=static)

    def log_image(self, entity: str, image: Frame, *, static: bool = False) -> None:
        """Log an image."""
        if self._lossless:
            picture = self._rerun.EncodedImage(contents=encode_png(image), media_type="image/png")
        else:
            picture = self._rerun.Image(image).compress(jpeg_quality=_QUALITY)
        self.log(entity, picture, static=static)

    def send(self, reading: Reading, image: Frame | None, /) -> None:
        """Log a reading on the clock of the source; one without a time is left out."""
        if not np.isfinite(reading.time_s):
            return
        self.set_frame(reading.number, reading.time_s)
        for entity, value in (
            ("margin", reading.margin), ("interval/low", reading.low), ("interval/high", reading.high),
        ):  # fmt: skip
            # a withheld margin ends the line, and is no longer shown as the newest
            self.log(entity, self._rerun.Clear(recursive=False) if value is None else self._rerun.Scalars(value))
        self.log("words", self._rerun.TextLog(str(describe_reading(reading))))
        if image is not None:
            self.log_image("frame", image)

    def close(self) -> None:
        """Write what waits, and end the stream."""
        self.stream.flush()
        self.stream.disconnect()


def _open_rerun(address: str) -> Sink:
    path = _new_file(address, kind="rerun")
    return RerunSink(lambda stream: stream.save(str(path)))


@dataclass(frozen=True, kw_only=True)
class RosTopic:
    """What is sent to ROS on one topic."""

    name: str
    """Below the key of the sink."""
    kind: str
    """Type of its messages."""
    fields: Callable[[Reading, Frame | None, Any], dict[str, Any] | None]
    """Fields of the message of a reading, with a header at hand; None where there is none to send."""


ROS_TOPICS = (
    RosTopic(
        name="margin",
        kind="std_msgs/msg/Float32",
        fields=lambda reading, *_: None if reading.margin is None else {"data": reading.margin},
    ),
    RosTopic(
        name="reading",
        kind="std_msgs/msg/String",
        fields=lambda reading, *_: {"data": encode_reading(reading).decode()},
    ),
    RosTopic(
        name="image/compressed",
        kind="sensor_msgs/msg/CompressedImage",
        fields=lambda _, image, header: (
            None
            if image is None
            else {
                "header": header,
                "format": "jpeg",
                "data": np.frombuffer(encode_jpeg(image, _QUALITY), dtype=np.uint8),
            }
        ),
    ),
)
"""Topics of ROS 2 that the sink `zenoh` sends; a margin that is withheld is not sent at all."""
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
        What wants it, as a person wrote it, for messages.

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
        config = zenoh.Config()
        for name, value in (
            ("mode", "client"),
            ("connect/endpoints", [address]),
            ("connect/timeout_ms", _ZENOH_PATIENCE_MS),
            ("scouting/multicast/enabled", False),  # it is told where to go, and calls out to nobody else
        ):
            config.insert_json5(name, json.dumps(value))
        try:
            self._session = zenoh.open(config)
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

    def header(self, at_ns: int) -> Any:
        """Header of a message, at nanoseconds since 1970."""
        stamp = self._types.types["builtin_interfaces/msg/Time"](sec=at_ns // 10**9, nanosec=at_ns % 10**9)
        return self._types.types["std_msgs/msg/Header"](stamp=stamp, frame_id=_FRAME_ID)

    def publisher(self, topic: str, kind: str) -> Callable[[dict[str, Any], int], None]:
        """Declare a topic; gives what sends a message of these fields on it, at nanoseconds since 1970.

        Sending raises `OSError` where the way is closed.
        """
        publishers = [self._session.declare_publisher(name) for name in self._names(topic, kind)]
        ext, own_id, count = self._ext, secrets.token_bytes(16), itertools.count(1)

        def send(fields: dict[str, Any], at_ns: int) -> None:
            message = bytes(self._types.serialize_cdr(self._types.types[kind](**fields), kind))
            attachment = ext.z_serialize((ext.Int64(next(count)), ext.Int64(at_ns), own_id))
            by_name, by_type = publishers
            try:
                by_name.put(message)
                by_type.put(message, attachment=attachment)
            except self._error as error:
                raise OSError(str(error)) from None

        return send

    def subscribe(self, topic: str, kind: str, heard: Callable[[bytes], None]) -> None:
        """Hand over each message of a topic, undecoded, in a thread of Zenoh's."""
        for name in self._names(topic, kind):
            self._session.declare_subscriber(name, lambda sample: heard(bytes(sample.payload)))

    def decode(self, message: bytes, kind: str) -> Any:
        """Message of a type; raises whatever its decoder does at one of another."""
        return self._types.deserialize_cdr(message, kind)

    def close(self) -> None:
        """Leave the router."""
        self._session.close()

    def _names(self, topic: str, kind: str) -> tuple[str, str]:
        package, _, message = kind.split("/")
        domain = os.environ.get("ROS_DOMAIN_ID") or "0"
        return topic, f"{domain}/{topic}/{package}::msg::dds_::{message}_/{self._types.hash_rihs01(kind)}"


class ZenohTopics:
    """Readings and frames as messages of ROS 2 over Zenoh (`ZenohRos`).

    Parameters
    ----------
    key
        Key of all topics, such as `tip`, which ROS names `/tip/margin`, `/tip/reading` and `/tip/image/compressed`.
    address
        Router or bridge to connect to.
    """

    def __init__(self, key: str, address: str = ZENOH_ADDRESS) -> None:
        self._ros, self._stamps = ZenohRos(address, purpose="--sink zenoh"), _Stamps()
        self._publishers = {topic: self._ros.publisher(f"{key}/{topic.name}", topic.kind) for topic in ROS_TOPICS}

    def send(self, reading: Reading, image: Frame | None, /) -> None:
        """Send what there is of the reading on each topic, at the time of its capture."""
        at_ns = self._stamps.of(reading)
        for topic, send in self._publishers.items():
            fields = topic.fields(reading, image, self._ros.header(at_ns))
            if fields is not None:
                send(fields, at_ns)

    def close(self) -> None:
        """Leave the router."""
        self._ros.close()


def parse_zenoh(address: str, *, purpose: str) -> tuple[str, str]:
    """Key of the topics and address of the router in KEY or KEY@tcp/HOST:PORT."""
    key, at, where = address.partition("@")
    if not re.fullmatch(r"[A-Za-z]\w*(/[A-Za-z]\w*)*", key) or bool(at) != bool(where):
        raise InputError(
            f"{purpose}:{address} names no key that ROS can have; give letters and digits, as zenoh:tip or "
            f"zenoh:tip@{ZENOH_ADDRESS}"
        )
    return key, where or ZENOH_ADDRESS


def _open_zenoh(address: str) -> Sink:
    return ZenohTopics(*parse_zenoh(address, purpose="--sink zenoh"))


SINKS = Table[Callable[[str], Sink]](
    "sink",
    "sliplens.sinks",
    {
        "json": _open_json,
        "udp": _open_udp,
        "mcap": _open_mcap,
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
_FLUSH_S = 5.0


@dataclass(frozen=True, kw_only=True)
class SinkState:
    """How far a sink is."""

    name: str
    sent: int
    """Readings that it took."""
    lost: int
    """Readings that it was too slow for, or that came after it broke off."""
    trouble: str | None
    """Why it broke off, with the cure; None while it goes on."""

    def __str__(self) -> str:
        lost = f", {self.lost:,} lost" if self.lost else ""
        trouble = f"; {self.trouble}" if self.trouble else ""
        return f"{self.name}: {number_of(self.sent, 'reading')} sent{lost}{trouble}"


class Sender:
    """Sends readings to a sink in a thread of its own: a slow one loses readings, and delays none.

    Parameters
    ----------
    name
        As `open_sink` takes it.
    """

    def __init__(self, name: str) -> None:
        self._name, sink = name, open_sink(name)
        self._outlet = Outlet[tuple[Reading, Frame | None]](
            lambda item: sink.send(*item), sink.close, most_bytes=_MOST_WAITING_BYTES
        )

    @property
    def state(self) -> SinkState:
        """How far it is now."""
        outlet, trouble = self._outlet, None
        if outlet.error is not None:
            trouble = (
                f"--sink {self._name} broke off after {number_of(outlet.sent, 'reading')} "
                f"({outlet.reason}); begin it anew"
            )
        return SinkState(name=self._name, sent=outlet.sent, lost=outlet.lost, trouble=trouble)

    @property
    def error(self) -> Exception | None:
        """What broke it off."""
        return self._outlet.error

    def put(self, reading: Reading, frame: LiveFrame | None) -> None:
        """Take a reading and its frame, without waiting."""
        image = None if frame is None else frame.image
        size_bytes = _READING_BYTES + (0 if image is None else image.nbytes)
        self._outlet.put((reading, image), size_bytes=size_bytes)

    def close(self) -> None:
        """Send what waits, for 5 seconds at most, and end the sink."""
        if not self._outlet.close(_FLUSH_S):
            self._outlet.discard()


__all__ = [
    "IMAGE_TOPIC", "READING_TOPIC", "ROS_TOPICS", "SINKS", "Datagrams", "FoxgloveTopics", "JsonLines", "RerunSink",
    "RosTopic", "Sender", "Sink", "SinkState", "ZenohRos", "ZenohTopics", "encode_reading", "open_sink", "parse_zenoh",
    "reading_schema",
]  # fmt: skip
