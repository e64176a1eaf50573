"""Where readings go: one row a kind of sink."""

import errno
import io
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import msgspec
import numpy as np
from PIL import Image

from sliplens.errors import InputError
from sliplens.extras import Table, require_packages
from sliplens.files import to_builtins
from sliplens.live.reading import Reading
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
    """One line of JSON; what is not known is null."""
    return msgspec.json.encode(to_builtins(reading))


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
    (_,), parts = msgspec.json.schema_components([Reading], ref_template="#/$defs/{name}")
    return {**parts.pop("Reading"), "$defs": parts}


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
        self._image, self._timestamp = CompressedImage, Timestamp
        self._readings = foxglove.Channel(READING_TOPIC, schema=reading_schema(), context=context)
        self._frames = CompressedImageChannel(IMAGE_TOPIC, context=context)
        # both count from 1970, readings from whenever the machine was started
        self._epoch_s = time.time() - time.monotonic()
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
        captured_s = reading.captured_s if np.isfinite(reading.captured_s) else time.monotonic()
        at_ns = round(1e9 * (captured_s + self._epoch_s))
        self._readings.log(encode_reading(reading), log_time=at_ns)
        if image is not None:
            buffer = io.BytesIO()
            Image.fromarray(image).save(buffer, "JPEG", quality=_QUALITY)
            stamp = self._timestamp(sec=at_ns // 10**9, nsec=at_ns % 10**9)
            frame = self._image(timestamp=stamp, frame_id="fingertip", data=buffer.getvalue(), format="jpeg")
            self._frames.log(frame, log_time=at_ns)

    def close(self) -> None:
        """End the file, or the server."""
        self._close()


_QUALITY = 90


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


class RerunFile:
    """Readings and frames for the Rerun viewer, in a file: `margin`, `interval/low`, `interval/high` and `frame`.

    Parameters
    ----------
    path
        File to write, which ends in .rrd.
    """

    def __init__(self, path: Path) -> None:
        require_packages("rerun", extra="sinks", purpose="--sink rerun")
        import rerun  # noqa: PLC0415 (an extra, and large)

        self._rerun, self._stream = rerun, rerun.RecordingStream("sliplens-live")
        self._stream.save(str(path))

    def send(self, reading: Reading, image: Frame | None, /) -> None:
        """Log what is known, on the clock of the source."""
        if not np.isfinite(reading.time_s):
            return
        stream, rerun = self._stream, self._rerun
        stream.set_time("time", duration=reading.time_s)
        stream.set_time("frame", sequence=reading.number)
        for entity, value in (
            ("margin", reading.margin), ("interval/low", reading.low), ("interval/high", reading.high),
        ):  # fmt: skip
            # what is withheld ends the line, and is no longer shown as the newest
            stream.log(entity, rerun.Clear(recursive=False) if value is None else rerun.Scalars(value))
        if reading.withheld is not None:
            stream.log("withheld", rerun.TextLog(reading.withheld))
        if image is not None:
            stream.log("frame", rerun.Image(image).compress(jpeg_quality=_QUALITY))

    def close(self) -> None:
        """Write what waits, and end the file."""
        self._stream.flush()
        self._stream.disconnect()


def _open_rerun(address: str) -> Sink:
    return RerunFile(_new_file(address, kind="rerun"))


SINKS = Table[Callable[[str], Sink]](
    "sink",
    "sliplens.sinks",
    {"json": _open_json, "udp": _open_udp, "mcap": _open_mcap, "foxglove": _open_foxglove, "rerun": _open_rerun},
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


__all__ = [
    "IMAGE_TOPIC", "READING_TOPIC", "SINKS", "Datagrams", "FoxgloveTopics", "JsonLines", "RerunFile", "Sink",
    "encode_reading", "open_sink", "reading_schema",
]  # fmt: skip
