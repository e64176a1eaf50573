"""Running sources: cameras, network streams, growing folders, replays, and a simulated fingertip."""

import errno
import select
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import av
import numpy as np
from av.error import FFmpegError, InvalidDataError
from av.video.codeccontext import VideoCodecContext
from av.video.frame import VideoFrame
from av.video.reformatter import VideoReformatter
from jaxtyping import UInt8

from sliplens.errors import ImageError, InputError, SourceError
from sliplens.extras import Table, pick, require_packages
from sliplens.files import require_folder
from sliplens.images import is_image, list_images, natural_key
from sliplens.live.contract import LiveOptions, LiveSource, Pace, SourceKind
from sliplens.live.reading import LiveFrame
from sliplens.recordings.capture import Capture, Forces, Frame
from sliplens.recordings.formats import recognise
from sliplens.recordings.formats.images import frame_size, read_frame
from sliplens.recordings.formats.video import upright
from sliplens.recordings.options import ReadOptions
from sliplens.recordings.source import open_source
from sliplens.simulation.filming import prepare_film
from sliplens.simulation.loading import load_at_margins
from sliplens.simulation.nuisances import Day, Grasp, Nuisances, draw_unit
from sliplens.simulation.sensor import SENSORS

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
    """Mode of a camera: format (four letters, such as MJPG), size (height, width) in pixels, and frames a second."""

    pixel_format: str
    size: tuple[int, int]
    rates_hz: tuple[float, ...]

    def in_words(self) -> tuple[str, str, str]:
        """Describe format, size and rates."""
        rates = ", ".join(f"{rate:g}" for rate in self.rates_hz)
        return self.pixel_format, f"{self.size[1]}x{self.size[0]}", rates or "unknown"


@dataclass(frozen=True, kw_only=True)
class Camera:
    """Camera of this machine: its device file, the name of its driver, and the modes that sliplens can read."""

    path: Path
    name: str
    modes: tuple[CameraMode, ...] = ()


class FrameDecoder:
    """Decoder of a camera's frames, of a size (height, width) in pixels; scales them down to `wanted`."""

    def __init__(self, pixel_format: str, *, size: tuple[int, int], wanted: tuple[int, int] | None = None) -> None:
        codec, pixels, pixel_bytes = _DECODERS[pixel_format]
        self._height, self._row_bytes, self._wanted = size[0], size[1] * pixel_bytes, wanted or size
        context = av.CodecContext.create(codec, "r")
        assert isinstance(context, VideoCodecContext)
        context.thread_count = 1  # frame by frame: more threads would each keep one back
        if pixels:
            (context.height, context.width), context.pix_fmt = size, pixels
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
        return _to_rgb(self._to_rgb, frames[0], self._wanted) if len(frames) == 1 and not frames[0].is_corrupt else None


def _to_rgb(reformatter: VideoReformatter, frame: VideoFrame, size: tuple[int, ...]) -> Frame:
    height, width = size
    return reformatter.reformat(frame, width=width, height=height, format="rgb24", interpolation="AREA").to_ndarray()


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
        self.name, self._path, self._options = f"the camera {path}", path, options

    def open(self, stack: ExitStack, /) -> None:
        """Open the device in the mode that suits the options, and start it."""
        from linuxpy.video.device import Device, VideoCapture  # noqa: PLC0415 (an extra)

        options = self._options
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
                formats = ", ".join(_DECODERS)
                raise self._failure(f"gives {pixel_format}, which is not read; choose {formats} with --pixel-format")
            fit = options.fit_size
            self.size = options.size or (fit if fit is not None and _shrinks_to(size, fit) else size)
            self._decoder = FrameDecoder(pixel_format, size=size, wanted=self.size)
            self._row_bytes, self.rate_hz = chosen.bytes_per_line, float(self._capture.get_fps())
            stack.enter_context(self._capture)
        except (OSError, ZeroDivisionError) as error:
            raise self._failure(error) from None

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
                raise self._failure(error) from None
            now_s = time.monotonic()
            if sent is None:
                if now_s - last_s > _STALL_S:
                    raise self._failure(f"has given no frame for {_STALL_S:g} s; check its cable, or use another port")
                continue
            last_s = now_s
            is_whole = BufferFlag.ERROR not in sent.flags
            image = self._decoder.decode(bytes(sent.data), row_bytes=self._row_bytes) if is_whole else None
            bad = bad + 1 if image is None else 0
            if bad >= _MOST_BAD:
                cure = "check its cable, choose another --pixel-format, or a smaller --size"
                raise self._failure(f"sends frames that cannot be decoded; {cure}")
            if image is not None:
                is_monotonic = (sent.flags & BufferFlag.TIMESTAMP_MASK) == BufferFlag.TIMESTAMP_MONOTONIC
                yield LiveFrame(
                    image=image,
                    number=int(sent.frame_nb),
                    time_s=float(sent.timestamp),
                    captured_s=float(sent.timestamp) if is_monotonic else now_s,
                    decode_ms=1e3 * (time.monotonic() - now_s),
                )

    def _choose(self, modes: Sequence[CameraMode]) -> CameraMode | None:
        """Choose the mode that suits the options; None to leave the camera as it is."""
        options = self._options
        wanted, rate_hz = options.size or options.fit_size, options.rate_hz or 0.0
        usable = [mode for mode in modes if options.pixel_format in {None, mode.pixel_format}]
        if modes and not usable:
            formats = ", ".join(sorted({mode.pixel_format for mode in modes}))
            raise self._failure(f"has no format {options.pixel_format}; choose {formats} with --pixel-format")
        # compressed first: what is not compressed fills the cable, and the rate falls
        usable.sort(key=lambda mode: list(_DECODERS).index(mode.pixel_format))
        if wanted is None or not usable:
            return usable[0] if usable and options.pixel_format is not None else None
        fitting = [
            mode
            for mode in usable
            if mode.pixel_format == usable[0].pixel_format
            and _shrinks_to(mode.size, wanted)
            and max(mode.rates_hz, default=np.inf) >= rate_hz
        ]
        if fitting or options.size is None:  # the network refuses frames of another size
            return min(fitting, key=lambda mode: mode.size, default=None)
        sizes = ", ".join(dict.fromkeys(mode.in_words()[1] for mode in usable))
        raise self._failure(
            f"has no mode that gives {wanted[1]}x{wanted[0]} at {rate_hz:g} frames a second; choose a --size of the "
            f"same shape as one of {sizes}, or a lower --rate"
        )

    def _failure(self, reason: Exception | str) -> SourceError:
        if isinstance(reason, Exception):
            number = getattr(reason, "errno", None) or 0
            reason = _CURES.get(number, f"cannot be read ({reason}); plug it in again")
        return SourceError(f"{self.name} {reason}")


def _shrinks_to(size: tuple[int, int], wanted: tuple[int, int]) -> bool:
    """Return True where frames of a size have the wanted shape, and are at least as large."""
    return size[0] * wanted[1] == size[1] * wanted[0] and size[0] >= wanted[0]


def read_modes(device: "Device") -> tuple[CameraMode, ...]:
    """List the modes of an open camera that can be read, the largest rate first in each."""
    assert device.info is not None
    rates: dict[tuple[str, tuple[int, int]], set[float]] = {}
    for kind in device.info.frame_types:
        rates.setdefault((kind.pixel_format.human_str(), (kind.height, kind.width)), set()).add(float(kind.max_fps))
    return tuple(
        CameraMode(pixel_format=name, size=size, rates_hz=tuple(sorted(values - {0.0}, reverse=True)))
        for (name, size), values in sorted(rates.items())
        if name in _DECODERS
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
                cameras.append(Camera(path=path, name=f"cannot be opened ({error.strerror})"))
    return tuple(cameras)


_FOLDER_S = 0.02
_WRITTEN_S = 1.0  # after which a file that cannot be read is damaged, not half written


class FolderSource(LiveSource):
    """Folder into which another program saves images; the newest is the first frame.

    An image's time is that of its file.
    """

    cure = "nothing new was saved there"

    def __init__(self, folder: Path) -> None:
        self.name, self._folder = f"the folder {folder}", folder
        self._taken: set[str] = set()

    def open(self, _: ExitStack, /) -> None:
        """Skip the images that are there, but for the newest."""
        if not any(map(is_image, require_folder(self._folder, what="the folder").iterdir())):
            raise InputError(f"{self.name} holds no image yet; begin when the first has been saved there")
        *before, newest = list_images(self._folder)
        self.size, self._taken = frame_size(newest), {path.name for path in before}

    def frames(self) -> Iterator[LiveFrame]:
        """Iterate over images in the natural order of their names; a damaged one is missing in the numbers."""
        number, last_s, broken_s = 0, -np.inf, np.inf
        while not self.closed.is_set():
            try:
                new = [path for path in self._folder.iterdir() if path.name not in self._taken and is_image(path)]
            except OSError as error:
                raise SourceError(
                    f"{self.name} cannot be read ({error.strerror}); make it again, and begin anew"
                ) from None
            for path in sorted(new, key=lambda path: natural_key(path.name)):
                before = time.monotonic()
                try:
                    written_s, image = path.stat().st_mtime, read_frame(path, size=frame_size(path))
                except (ImageError, OSError):
                    broken_s = min(broken_s, before)
                    if path.exists() and before - broken_s < _WRITTEN_S:
                        break  # it may be half written; the next ones wait too, so that they come in order
                    written_s, image = 0.0, None
                broken_s = np.inf
                self._taken.add(path.name)
                number += 1
                if image is not None:
                    last_s, now_s = max(written_s, last_s + 1e-6), time.monotonic()
                    yield LiveFrame(
                        image=image,
                        number=number - 1,
                        time_s=last_s,
                        captured_s=now_s - max(0.0, time.time() - written_s),
                        decode_ms=1e3 * (now_s - before),
                    )
            self.closed.wait(_FOLDER_S)


_NETWORK = ("rtsp", "rtp", "udp", "tcp", "http", "https", "rtmp", "srt")
_OPEN_S, _READ_S = 5.0, 2.0
_QUICK = {
    # a stream must not lead to a file of this machine
    "protocol_whitelist": ",".join((*_NETWORK, "rtsps", "tls", "crypto", "rtmps")),
    "rtsp_transport": "tcp",
    "fflags": "nobuffer",
    "flags": "low_delay",
    "analyzeduration": "500000",
}


class StreamSource(LiveSource):
    """Video that a network camera sends, as far as FFmpeg reads it: RTSP, HTTP, MPEG-TS over UDP or TCP, SRT."""

    reconnects = True

    def __init__(self, address: str, *, size: tuple[int, int] | None = None) -> None:
        self.name, self._address, self._size = f"the stream {address}", address, size

    def open(self, stack: ExitStack, /) -> None:
        """Connect, and look for pictures."""
        try:
            self._container = stack.enter_context(av.open(self._address, options=_QUICK, timeout=(_OPEN_S, _READ_S)))
        except (FFmpegError, OSError, ValueError) as error:
            raise self._explained(error) from None
        if not self._container.streams.video:
            raise SourceError(f"{self.name} shows no pictures; name the address of a camera")
        self._video = self._container.streams.video[0]
        self._video.thread_type = "SLICE"  # by frame, each thread would keep one back
        self.size = self._size or (self._video.codec_context.height, self._video.codec_context.width)
        self.rate_hz = float(self._video.average_rate or 0) or None

    def frames(self) -> Iterator[LiveFrame]:
        """Iterate over frames as they arrive; those that cannot be decoded are missing in the numbers."""
        to_rgb, number = VideoReformatter(), 0
        packets = self._container.demux(self._video)
        while not self.closed.is_set():
            try:
                packet = next(packets)
                arrived_s = time.monotonic()
                frames = packet.decode()
            except InvalidDataError:
                number += 1
                continue
            except (FFmpegError, OSError) as error:
                if self.closed.is_set():
                    return
                raise self._explained(error) from None
            except StopIteration:
                raise SourceError(f"{self.name} has ended; start the camera again") from None
            for frame in frames:
                size = self._size or (frame.height, frame.width)
                pixels = _to_rgb(to_rgb, frame, size[::-1] if self._size and frame.rotation % 180 else size)
                yield LiveFrame(
                    image=upright(frame, pixels, where=self.name),
                    number=number,
                    time_s=arrived_s if frame.time is None else float(frame.time),
                    captured_s=arrived_s,
                    decode_ms=1e3 * (time.monotonic() - arrived_s),
                )
                number += 1

    def _explained(self, error: Exception) -> SourceError:
        reason = getattr(error, "strerror", None) or str(error)
        return SourceError(f"{self.name} cannot be read ({reason}); check its address and that the camera runs")


class ReplaySource(LiveSource):
    """Trial of a data set, video or bag replayed at its own pace, once or over and over.

    Parameters
    ----------
    capture
        Recording, as `open_source` returns it.
    speed
        Ratio of the recorded time to that of the replay: 2 is twice as fast.
    rate_hz
        Frames a second in place of the recorded times.
    repeat
        If True, begin anew at the end; times and numbers go on.
    """

    def __init__(
        self, capture: Capture, *, speed: float = 1.0, rate_hz: float | None = None, repeat: bool = False
    ) -> None:
        self._capture, self._repeat = capture, repeat
        self.name, self.simulated = f"{capture.name} of {capture.opened}", capture.simulated
        self.size, self.count = capture.frame_size, None if repeat else len(capture)
        self._step_s = 1 / (rate_hz or capture.frame_rate_hz)
        recorded_s = capture.time_s if rate_hz is None else None
        self._time_s = np.arange(len(capture)) * self._step_s if recorded_s is None else recorded_s - recorded_s[0]
        self.speed, self.rate_hz = speed, speed / self._step_s
        self.reference = None if capture.read_reference is None else capture.read_reference()

    def frames(self) -> Iterator[LiveFrame]:
        """Iterate over frames at their times, of the first pass and of those after it."""
        pace, number, begun_s, capture = Pace(self.closed), 0, 0.0, self._capture
        first_s = 0.0 if capture.time_s is None else float(capture.time_s[0])
        margins = np.full(len(capture), np.nan) if capture.safety_margin is None else capture.safety_margin
        while True:
            images, forces_s = capture.read_frames(), -np.inf
            for offset_s, margin in zip(self._time_s.tolist(), margins.tolist(), strict=True):
                before = time.perf_counter()
                image = next(images, None)
                if image is None:  # a video whose header promised more
                    break
                decode_ms = 1e3 * (time.perf_counter() - before)
                if not pace.wait((begun_s + offset_s) / self.speed):
                    return
                yield LiveFrame(
                    image=image,
                    number=number,
                    time_s=begun_s + offset_s,
                    captured_s=time.monotonic(),
                    decode_ms=decode_ms,
                    forces=self._forces_between(forces_s, offset_s + first_s, shift_s=begun_s - first_s),
                    safety_margin=None if np.isnan(margin) else margin,
                )
                number, forces_s = number + 1, offset_s + first_s
            if not self._repeat:
                return
            begun_s += float(self._time_s[-1]) + self._step_s

    def _forces_between(self, after_s: float, until_s: float, *, shift_s: float) -> Forces | None:
        """Return the samples of the force sensor between two times, shifted."""
        forces = self._capture.forces
        if forces is None:
            return None
        first, last = np.searchsorted(forces.time_s, (after_s, until_s), side="right")
        time_s, force_n = forces.time_s[first:last] + shift_s, forces.force_n[first:last]
        return Forces(time_s=time_s, force_n=force_n, source=forces.source) if first < last else None


_GRIP_N = 1.5
_GRIP_COURSE = np.array([[0, 0.3, 1.3, 1.8, 6.8, 7.8, 8.3, 9.5], [0, 0, 1, 1, 1, 1, 0, 0], [0, 0, 0, 0, 1, 1, 0, 0]])
"""Grip that the simulated fingertip repeats until `load` is called: seconds, and shares of press and pull."""


class SimulatedSource(LiveSource):
    """Simulated fingertip that can be pressed and pulled while it runs.

    Until `load` is called it repeats a grip by itself: touch, press, pull until it slips, let go.

    Parameters
    ----------
    sensor
        Row of `SENSORS`.
    friction
        Coefficient of friction of the object.
    rate_hz
        Frames a second.
    seed
        Of the unit's print and the camera's noise.

    Examples
    --------
    >>> from sliplens.live import SimulatedSource
    >>> with SimulatedSource(rate_hz=200.0) as source:
    ...     source.load(normal_force_n=1.5, tangential_force_n=0.6)
    ...     frame = next(source.frames())
    >>> frame.size, round(frame.safety_margin, 2)
    ((224, 224), 0.48)
    """

    simulated = True

    def __init__(
        self, sensor: str = "chromatouch", *, friction: float = 0.775, rate_hz: float = 30.0, seed: int = 0
    ) -> None:
        chosen = pick(SENSORS, sensor, noun="simulated sensor")
        self.name, self.rate_hz, self._step_s = f"a simulated {sensor}", rate_hz, 1 / rate_hz
        self.size = chosen.image_size_px, chosen.image_size_px
        self._rng, self._grasp = np.random.default_rng(seed), Grasp(friction=friction)
        self._forces_n: tuple[float, float] | None = None
        self._film = prepare_film(
            chosen,
            loading=load_at_margins(np.array([np.nan]), grasp=self._grasp),
            grasp=self._grasp,
            day=Day(friction=friction),
            unit=draw_unit(Nuisances(), markers=chosen.geometry.markers, rng=self._rng),
            rng=self._rng,
            noise=chosen.noise,
        )
        self.reference = self._film.draw_reference().numpy()

    def load(self, *, normal_force_n: float, tangential_force_n: float) -> None:
        """Press and pull by so many newtons from the next frame on.

        More pull than friction holds makes the contact slip, and what friction holds remains.
        """
        if not (0 <= normal_force_n < np.inf and 0 <= tangential_force_n < np.inf):
            raise InputError(
                f"a fingertip cannot be pressed by {normal_force_n:g} N and pulled by {tangential_force_n:g} N; "
                "give forces of 0 or more"
            )
        self._forces_n = normal_force_n, tangential_force_n

    def let_go(self) -> None:
        """Repeat the grip again."""
        self._forces_n = None

    def frames(self) -> Iterator[LiveFrame]:
        """Iterate over frames, each of the load at its time."""
        pace, number, friction = Pace(self.closed), 0, self._grasp.friction
        while pace.wait(time_s := number * self._step_s):
            captured_s = time.monotonic()
            normal_n, pull_n = self.forces_n(time_s)
            tangential_n = min(pull_n, friction * normal_n)
            margin = 1 - tangential_n / (friction * normal_n) if normal_n > 0 else np.nan
            loading = load_at_margins(np.array([margin]), grasp=replace(self._grasp, normal_force_n=normal_n))
            image = self._film.under(loading, rng=self._rng).draw(slice(0, 1)).numpy()[0]
            force_n = np.array([[tangential_n, 0.0, normal_n]])
            yield LiveFrame(
                image=image,
                number=number,
                time_s=time_s,
                captured_s=captured_s,
                decode_ms=1e3 * (time.monotonic() - captured_s),
                forces=Forces(time_s=np.array([time_s]), force_n=force_n, source="the simulated fingertip"),
                safety_margin=float(margin) if normal_n > 0 else None,
            )
            number += 1

    def forces_n(self, time_s: float) -> tuple[float, float]:
        """Return the force that presses and the one that pulls at a time, before friction limits the latter."""
        if (forces_n := self._forces_n) is not None:
            return forces_n
        times_s, *courses = _GRIP_COURSE
        press, pull = (float(np.interp(time_s % times_s[-1], times_s, course)) for course in courses)
        return _GRIP_N * press, pull * self._grasp.friction * _GRIP_N


def _open_replay(name: str, options: LiveOptions) -> LiveSource:
    capture, *_ = open_source(Path(name), trial=options.trial, options=ReadOptions(), whole=True)
    return ReplaySource(capture, speed=options.speed or 1.0, rate_hz=options.rate_hz)


def _kind(
    words: str, recognises: Callable[[str], bool], make: Callable[[str, LiveOptions], LiveSource], *takes: str
) -> SourceKind:
    """Make the row of a source that takes some options only."""

    def open_named(name: str, options: LiveOptions) -> LiveSource:
        source = make(name, options)
        options.require_only(*takes, what=source.name)
        return source

    return SourceKind(words=words, recognises=recognises, open=open_named)


_ROWS = {
    "simulated": _kind(
        "simulated fingertip (simulated, or simulated:flat-gel)",
        lambda name: name.partition(":")[0] == "simulated",
        lambda name, options: SimulatedSource(
            name.partition(":")[2] or "chromatouch", rate_hz=options.rate_hz or 30.0
        ),
        "rate_hz",
    ),
    "camera": _kind(
        "camera by its number or device file (0, or /dev/video0)",
        lambda name: name.isdecimal() or name.startswith("/dev/"),
        lambda name, options: CameraSource(Path(f"/dev/video{int(name)}" if name.isdecimal() else name), options),
        "rate_hz", "size", "pixel_format",
    ),
    "stream": _kind(
        "network stream by its address (rtsp://, http://, udp://)",
        lambda name: name.partition("://")[0].lower() in _NETWORK and "://" in name,
        lambda name, options: StreamSource(name, size=options.size),
        "size",
    ),
    "folder": _kind(
        "folder into which images are saved",
        lambda name: Path(name).is_dir() and recognise(Path(name)) in {None, "images"},
        lambda name, _: FolderSource(Path(name)),
    ),
    "replay": _kind(
        "video, bag or trial of a data set, replayed",
        lambda name: Path(name).exists(),
        _open_replay,
        "rate_hz", "speed", "trial",
    ),
}  # fmt: skip
SOURCES = Table("source", "sliplens.sources", _ROWS)
"""Running sources by kind; an installed package adds its own by the entry point `sliplens.sources`."""

Images: TypeAlias = UInt8[np.ndarray, "frames height width 3"]


def open_live(
    source: str | Path | Images | Capture | LiveSource = "simulated", *, options: LiveOptions | None = None
) -> LiveSource:
    """Make the source of a name; a device is opened when the source is entered.

    Parameters
    ----------
    source
        `simulated`; the number of a camera; the address of a stream; the path of a video, a bag, a data set, or a
        folder that grows; or uint8 RGB frames, a `Capture`, or a source.
    options
        Options of the source.

    Raises
    ------
    InputError
        If the name is that of no source, or the source does not take an option.

    Examples
    --------
    >>> from sliplens.live import open_live
    >>> open_live("simulated").name
    'a simulated chromatouch'
    """
    options = options or LiveOptions()
    if isinstance(source, LiveSource):
        options.require_only(what=source.name)
        return source
    if isinstance(source, Capture | np.ndarray):
        options.require_only("rate_hz", "speed", what="a replay")
        capture = source if isinstance(source, Capture) else open_source(source)[0]
        return ReplaySource(capture, speed=options.speed or 1.0, rate_hz=options.rate_hz)
    name = str(source)
    added = [row for row in SOURCES if row not in _ROWS]
    for row in (*added, *_ROWS):
        if SOURCES[row].recognises(name):
            return SOURCES[row].open(name, options)
    kinds = "; ".join(SOURCES[row].words for row in SOURCES)
    raise InputError(f"{name} is no source that is known, nor a path that exists; name a {kinds}")


__all__ = [
    "SOURCES", "Camera", "CameraMode", "CameraSource", "FolderSource", "FrameDecoder", "ReplaySource",
    "SimulatedSource", "StreamSource", "list_cameras", "open_live",
]  # fmt: skip
