"""V4L2 cameras: their modes, and their frames with the kernel's stamps and numbers."""

import errno
import select
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import av
import numpy as np
from av.error import FFmpegError
from av.video.codeccontext import VideoCodecContext
from av.video.reformatter import VideoReformatter

from sliplens.errors import SourceError
from sliplens.extras import require_packages
from sliplens.live.contract import LiveOptions, LiveSource
from sliplens.live.reading import LiveFrame
from sliplens.recordings.capture import Frame

if TYPE_CHECKING:
    from linuxpy.video.device import Device

_DECODERS = {
    "MJPG": ("mjpeg", "", 0),
    "JPEG": ("mjpeg", "", 0),
    "YUYV": ("rawvideo", "yuyv422", 2),
    "UYVY": ("rawvideo", "uyvy422", 2),
    "RGB3": ("rawvideo", "rgb24", 3),
    "BGR3": ("rawvideo", "bgr24", 3),
    "GREY": ("rawvideo", "gray", 1),
}
"""Formats of V4L2 by their four letters: the decoder of FFmpeg, its pixel format, and bytes a pixel."""
_BUFFERS = 4  # two are not enough where a process is now and then late
_POLL_S, _STALL_S = 0.1, 2.0
_MOST_BAD = 30  # frames in a row that cannot be decoded
_CURES = {
    errno.EBUSY: "is taken by another program; close that one",
    errno.EACCES: "may not be opened; add yourself to the group video and log in again",
    errno.ENOENT: "is not there; plug it in, and see `sliplens live --list`",
    errno.ENODEV: "was unplugged; plug it in again",
    errno.ENXIO: "was unplugged; plug it in again",
    errno.ENOTTY: "is no camera; see `sliplens live --list`",
    errno.EINVAL: "does not take these settings; see `sliplens live --list`",
}


@dataclass(frozen=True, kw_only=True)
class CameraMode:
    """Format, size and rates of a camera."""

    pixel_format: str
    """Four letters, such as MJPG."""
    size: tuple[int, int]
    """Height and width, in pixels."""
    rates_hz: tuple[float, ...]
    """Frames a second; empty where unknown."""

    def in_words(self) -> tuple[str, str, str]:
        """Describe format, size and rates."""
        rates = ", ".join(f"{rate:g}" for rate in self.rates_hz)
        return self.pixel_format, f"{self.size[1]}x{self.size[0]}", rates or "unknown"


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A camera of this machine."""

    path: Path
    """Device file, such as /dev/video0."""
    name: str
    """Name of the driver."""
    modes: tuple[CameraMode, ...]
    """Modes that sliplens can read; empty where the camera cannot be opened."""


class FrameDecoder:
    """Decoder of a camera's frames, of a size (height, width) in pixels; scales them down to `wanted`."""

    def __init__(self, pixel_format: str, *, size: tuple[int, int], wanted: tuple[int, int] | None = None) -> None:
        codec, pixels, pixel_bytes = _DECODERS[pixel_format]
        self._height, self._row_bytes, self._wanted = size[0], size[1] * pixel_bytes, wanted or size
        context = av.CodecContext.create(codec, "r")
        assert isinstance(context, VideoCodecContext)
        context.thread_count = 1  # frame by frame: more threads would each keep one back
        if pixels:
            context.height, context.width = size
            context.pix_fmt = pixels
        else:  # a JPEG decoder halves the picture up to three times for nothing
            ratio = min(have / want for have, want in zip(size, self._wanted, strict=True))
            context.options = {"lowres": str(min(max(int(np.log2(ratio)), 0), 3)), "err_detect": "explode"}
        self._context, self._to_rgb = context, VideoReformatter()

    def decode(self, data: bytes, *, row_bytes: int = 0) -> Frame | None:
        """Decode one frame as RGB; None where the bytes are no whole frame. `row_bytes`: length of a padded row."""
        if row_bytes > self._row_bytes > 0 and len(data) >= self._height * row_bytes:
            rows = np.frombuffer(data, dtype=np.uint8, count=self._height * row_bytes).reshape(self._height, row_bytes)
            data = rows[:, : self._row_bytes].tobytes()
        if len(data) < max(1, self._height * self._row_bytes):
            return None
        try:
            frames = self._context.decode(av.Packet(data))
        except FFmpegError:
            return None
        if len(frames) != 1 or frames[0].is_corrupt:
            return None
        height, width = self._wanted
        rgb = self._to_rgb.reformat(frames[0], width=width, height=height, format="rgb24", interpolation="AREA")
        return rgb.to_ndarray()


class CameraSource(LiveSource):
    """V4L2 camera, in MJPG where it has that; its frames carry the kernel's stamps and numbers.

    Parameters
    ----------
    path
        Device file.
    options
        Rate, size and pixel format; the camera's own where None.
    """

    reconnects = True

    def __init__(self, path: Path, options: LiveOptions) -> None:
        require_packages("linuxpy", extra="live", purpose="reading a camera")
        options.require_only("rate_hz", "size", "pixel_format", what=f"the camera {path}")
        self.name, self._path, self._options = f"the camera {path}", path, options
        self._stack = ExitStack()

    def __enter__(self) -> "CameraSource":
        from linuxpy.video.device import Device, VideoCapture  # noqa: PLC0415 (an extra)

        self.closed.clear()
        options = self._options
        with ExitStack() as stack:
            try:
                self._device = stack.enter_context(Device(self._path))
                mode = self._choose(read_modes(self._device))
                self._capture = VideoCapture(self._device, size=_BUFFERS)
                if mode is not None:
                    self._capture.set_format(mode.size[1], mode.size[0], mode.pixel_format)
                if options.rate_hz is not None:
                    self._capture.set_fps(options.rate_hz)
                chosen = self._capture.get_format()
                pixel_format, size = chosen.pixel_format.human_str(), (chosen.height, chosen.width)
                if pixel_format not in _DECODERS:
                    raise SourceError(
                        f"{self.name} gives {pixel_format}, which is not read; choose one of {', '.join(_DECODERS)} "
                        "with --pixel-format"
                    )
                fit = options.fit_size
                fits = fit is not None and _is_alike(size, fit) and size[0] >= fit[0]
                self.size = options.size or (fit if fit is not None and fits else size)
                self._decoder = FrameDecoder(pixel_format, size=size, wanted=self.size)
                self._row_bytes = chosen.bytes_per_line
                self.rate_hz = float(self._capture.get_fps())
                stack.enter_context(self._capture)
            except (OSError, ZeroDivisionError) as error:
                raise self._explained(error) from None
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
        with suppress(OSError):  # it may be gone already
            self._stack.close()

    def frames(self) -> Iterator[LiveFrame]:
        """Iterate over frames; those that are broken, or cannot be decoded, are missing in the numbers."""
        from linuxpy.video.device import BufferFlag  # noqa: PLC0415 (an extra)

        buffers, last_s, bad = self._capture.buffer, time.monotonic(), 0
        assert buffers is not None
        while not self.closed.is_set():
            try:
                ready, _, _ = select.select([self._device], [], [], _POLL_S)
                sent = buffers.raw_read() if ready else None
            except BlockingIOError:
                sent = None
            except (OSError, ValueError) as error:
                raise self._explained(error) from None
            now_s = time.monotonic()
            if sent is None:
                if now_s - last_s > _STALL_S:
                    raise SourceError(
                        f"{self.name} has given no frame for {_STALL_S:g} s; check its cable, "
                        "or plug it into a port of its own"
                    )
                continue
            last_s, image = now_s, None
            if BufferFlag.ERROR not in sent.flags:
                image = self._decoder.decode(bytes(sent.data), row_bytes=self._row_bytes)
            if image is None:
                bad += 1
                if bad >= _MOST_BAD:
                    raise SourceError(
                        f"{self.name} sends frames that cannot be decoded; check its cable, choose another "
                        "--pixel-format, or a smaller --size"
                    )
                continue
            bad = 0
            monotonic = (sent.flags & BufferFlag.TIMESTAMP_MASK) == BufferFlag.TIMESTAMP_MONOTONIC
            yield LiveFrame(
                image=image,
                number=int(sent.frame_nb),
                time_s=float(sent.timestamp),
                captured_s=float(sent.timestamp) if monotonic else now_s,
                decode_ms=1e3 * (time.monotonic() - now_s),
            )

    def _choose(self, modes: Sequence[CameraMode]) -> CameraMode | None:
        """Choose the mode that suits the options; None to leave the camera as it is."""
        pixel_format, wanted = self._options.pixel_format, self._options.size or self._options.fit_size
        usable = [mode for mode in modes if pixel_format in {None, mode.pixel_format}]
        if pixel_format is not None and not usable and modes:
            formats = ", ".join(sorted({mode.pixel_format for mode in modes}))
            raise SourceError(f"{self.name} has no format {pixel_format}; choose {formats} with --pixel-format")
        # compressed first: what is not compressed fills the cable, and the rate falls
        usable.sort(key=lambda mode: list(_DECODERS).index(mode.pixel_format))
        if wanted is None or not usable:
            return None if pixel_format is None or not usable else usable[0]
        rate_hz = self._options.rate_hz or 0.0
        for mode in sorted(usable, key=lambda mode: mode.size):
            fast = max(mode.rates_hz, default=np.inf) >= rate_hz
            fits = _is_alike(mode.size, wanted) and mode.size[0] >= wanted[0]
            if fits and fast and mode.pixel_format == usable[0].pixel_format:
                return mode
        if self._options.size is None:
            return None  # no size was set: the network refuses frames of another size
        sizes = ", ".join(dict.fromkeys(f"{mode.size[1]}x{mode.size[0]}" for mode in usable))
        raise SourceError(
            f"{self.name} has no mode that gives {wanted[1]}x{wanted[0]} at {rate_hz:g} frames a second; "
            f"choose a --size of the same shape as one of {sizes}, or a lower --rate"
        )

    def _explained(self, error: Exception) -> SourceError:
        number = getattr(error, "errno", None) or 0
        return SourceError(f"{self.name} {_CURES.get(number, f'cannot be read ({error}); plug it in again')}")


def _is_alike(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Return True where two sizes have the same shape."""
    return size[0] * other[1] == size[1] * other[0]


def read_modes(device: "Device") -> tuple[CameraMode, ...]:
    """List the modes of an open camera that can be read, the largest rate first in each."""
    assert device.info is not None
    kinds = sorted(
        (kind.pixel_format.human_str(), (kind.height, kind.width), float(kind.max_fps))
        for kind in device.info.frame_types
    )
    return tuple(
        CameraMode(
            pixel_format=pixel_format,
            size=size,
            rates_hz=tuple(sorted({rate for *_, rate in same if rate > 0}, reverse=True)),
        )
        for (pixel_format, size), same in groupby(kinds, key=lambda mode: mode[:2])
        if pixel_format in _DECODERS
    )


def list_cameras(folder: Path = Path("/dev")) -> tuple[Camera, ...]:
    """List the cameras of this machine, with their modes.

    Raises
    ------
    InputError
        If the extra `live` is not installed.
    """
    require_packages("linuxpy", extra="live", purpose="listing cameras")
    from linuxpy.video.device import Capability, Device  # noqa: PLC0415 (an extra)

    cameras = []
    for path in sorted(folder.glob("video*"), key=lambda path: (len(path.name), path.name)):
        try:
            with Device(path) as device:
                assert device.info is not None
                if Capability.VIDEO_CAPTURE in device.info.device_capabilities:
                    cameras.append(Camera(path=path, name=device.info.card, modes=read_modes(device)))
        except OSError as error:
            if error.errno not in {errno.ENOTTY, errno.ENODEV}:
                cameras.append(Camera(path=path, name=f"cannot be opened ({error.strerror})", modes=()))
    return tuple(cameras)


__all__ = ["Camera", "CameraMode", "CameraSource", "FrameDecoder", "list_cameras"]
