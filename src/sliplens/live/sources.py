"""Running sources: cameras, network streams, growing folders, replays, and a simulated fingertip."""

import errno
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import av
import numpy as np
from av.container import InputContainer
from av.error import FFmpegError, InvalidDataError
from av.video.reformatter import VideoReformatter
from jaxtyping import UInt8

from sliplens.errors import InputError, SourceError
from sliplens.extras import Table, pick
from sliplens.images import natural_key
from sliplens.live.contract import DrawnSource, LiveOptions, LiveSource, Pace, SourceKind
from sliplens.live.reading import LiveFrame
from sliplens.recordings.capture import Capture, Frame
from sliplens.recordings.formats.video import upright
from sliplens.recordings.source import open_source
from sliplens.simulation.filming import prepare_film
from sliplens.simulation.loading import load_at_margins
from sliplens.simulation.nuisances import Day, Grasp, Nuisances, draw_unit
from sliplens.simulation.sensor import SENSORS

_CURES = {
    errno.EBUSY: "is taken by another program; close that one",
    errno.EACCES: "may not be opened; add yourself to the group video and log in again",
    errno.ENOENT: "is not there; plug it in, and see `sliplens live --list-sources`",
    errno.ENODEV: "was unplugged; plug it in again",
    errno.ENXIO: "was unplugged; plug it in again",
    errno.ENOTTY: "is no camera; see `sliplens live --list-sources`",
    errno.EINVAL: "does not take these settings; see `sliplens live --list-sources`",
}
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
_CLOCKS_S = 10.0  # stamps of a camera that differ from the monotonic clock by more are of another one


class CameraSource(LiveSource):
    """Camera at this machine (V4L2), or one in the network, as far as FFmpeg reads it: RTSP, HTTP, MPEG-TS, SRT.

    A device is asked for MJPG, and for the size nearest to that of the options; its frames carry the stamps of the
    kernel, and gaps between these count as lost frames. A larger picture of the same shape is scaled down.

    Parameters
    ----------
    address
        Device file, or address of a stream.
    options
        Rate and size; the camera's own where None.
    """

    reconnects = True

    def __init__(self, address: str, options: LiveOptions) -> None:
        self._address, self._options, self._is_device = address, options, address.startswith("/dev/")
        self.name = f"the {'camera' if self._is_device else 'stream'} {address}"

    def open(self, stack: ExitStack, /) -> None:
        """Open the device in the mode that suits the options, or connect."""
        rate_hz, size = self._options.rate_hz, self._options.size or self._options.fit_size
        if self._is_device:
            settings = {"video_size": size and f"{size[1]}x{size[0]}", "framerate": rate_hz and f"{rate_hz:g}"}
            settings = {name: value for name, value in settings.items() if value}
            try:  # compressed first: what is not compressed fills the cable, and the rate falls
                container = self._connect(format="v4l2", options={"input_format": "mjpeg"} | settings)
            except SourceError:
                container = self._connect(format="v4l2", options=settings)
        else:
            container = self._connect(options=_QUICK, timeout=(_OPEN_S, _READ_S))
        self._container = stack.enter_context(container)
        if not container.streams.video:
            raise SourceError(f"{self.name} shows no pictures; name the address of a camera")
        self._video = container.streams.video[0]
        self._video.thread_type = "SLICE"  # by frame, each thread would keep one back
        if self._is_device:
            self._video.codec_context.options = {"err_detect": "explode"}
        self.rate_hz = float(self._video.average_rate or 0) or None
        self.size = height, width = self._video.codec_context.height, self._video.codec_context.width
        self._scaled = size is not None and height * size[1] == width * size[0] and height >= size[0]
        if size is not None and self._scaled:
            self.size = size
        elif self._options.size is not None:  # a network that needs another size says so itself
            raise SourceError(
                f"{self.name} gives {width}x{height} and not {self._options.size[1]}x{self._options.size[0]}; "
                "choose a --size of the same shape and no larger"
            )

    def _connect(self, **settings: Any) -> InputContainer:
        try:
            return av.open(self._address, **settings)
        except (FFmpegError, OSError, ValueError) as error:
            raise self._explained(error) from None

    def frames(self) -> Iterator[LiveFrame]:
        """Iterate over frames as they arrive; those that cannot be decoded are missing in the numbers."""
        to_rgb, number, steps, last_s = VideoReformatter(), -1, 1, np.nan
        packets = self._container.demux(self._video)
        while not self.closed.is_set():
            try:
                packet = next(packets)
                arrived_s = time.monotonic()
                frames = packet.decode()
            except InvalidDataError:
                steps += 1
                continue
            except (FFmpegError, OSError) as error:
                if self.closed.is_set():
                    return
                raise self._explained(error) from None
            except StopIteration:
                raise SourceError(f"{self.name} has ended; start the camera again") from None
            for frame in frames:
                if frame.is_corrupt:
                    steps += 1
                    continue
                time_s = captured_s = arrived_s if frame.time is None else float(frame.time)
                if self._is_device:
                    steps = max(steps, round(np.nan_to_num(time_s - last_s) * (self.rate_hz or 0)))
                if not self._is_device or abs(arrived_s - time_s) >= _CLOCKS_S:
                    captured_s = arrived_s
                number, steps, last_s = number + steps, 1, time_s
                height, width = self.size if self._scaled else (frame.height, frame.width)
                if self._scaled and frame.rotation % 180:
                    height, width = width, height
                pixels = to_rgb.reformat(frame, width=width, height=height, format="rgb24", interpolation="AREA")
                yield LiveFrame(
                    image=upright(frame, pixels.to_ndarray(), where=self.name),
                    number=number,
                    time_s=time_s,
                    captured_s=captured_s,
                    decode_ms=1e3 * (time.monotonic() - arrived_s),
                )

    def _explained(self, error: Exception) -> SourceError:
        cure = "plug it in again" if self._is_device else "check its address and that the camera runs"
        other = f"cannot be read ({getattr(error, 'strerror', None) or error}); {cure}"
        number = getattr(error, "errno", None) if self._is_device else None
        return SourceError(f"{self.name} {_CURES.get(number or 0, other)}")


def list_cameras(folder: Path = Path("/sys/class/video4linux")) -> dict[str, str]:
    """List the cameras of this machine: the name of each by its device file."""
    paths = sorted(folder.glob("video*/name"), key=lambda path: natural_key(path.parent.name))
    return {f"/dev/{path.parent.name}": path.read_text(encoding="utf-8").strip() for path in paths}


class ReplaySource(LiveSource):
    """Trial of a data set, video or bag replayed at its own pace.

    Parameters
    ----------
    capture
        Recording, as `open_source` returns it.
    speed
        Ratio of the recorded time to that of the replay: 2 is twice as fast.
    rate_hz
        Frames a second in place of the recorded times.
    """

    def __init__(self, capture: Capture, *, speed: float = 1.0, rate_hz: float | None = None) -> None:
        self._capture, self.count = capture, len(capture)
        self.name, self.simulated = f"{capture.trial} of {capture.opened}", capture.simulated
        self.size, self.speed = capture.frame_size, speed
        self.rate_hz = speed * (rate_hz or capture.frame_rate_hz)
        self._time_s, self._first_s = np.arange(len(capture)) * speed / self.rate_hz, 0.0
        if capture.time_s is not None:
            self._first_s = float(capture.time_s[0])
            self._time_s = self._time_s if rate_hz else capture.time_s - self._first_s
        self.reference = None if capture.read_reference is None else capture.read_reference()

    def frames(self) -> Iterator[LiveFrame]:
        """Iterate over frames at their times."""
        pace, capture, before = Pace(self.closed), self._capture, time.perf_counter()
        margins = np.full(len(capture), np.nan) if capture.safety_margin is None else capture.safety_margin
        forces, ends = capture.forces, np.zeros(len(capture) + 1, dtype=int)
        if forces is not None:
            forces = replace(forces, time_s=forces.time_s - self._first_s)
            ends[1:] = np.searchsorted(forces.time_s, self._time_s, side="right")
        rows = zip(self._time_s.tolist(), margins.tolist(), capture.read_frames(), strict=False)
        for number, (time_s, margin, image) in enumerate(rows):  # a video whose header promised more ends before
            decode_ms = 1e3 * (time.perf_counter() - before)
            if not pace.wait(time_s / self.speed):
                return
            first, last = ends[number : number + 2].tolist()
            since = None  # the frame before
            if forces is not None and last > first:
                since = replace(forces, time_s=forces.time_s[first:last], force_n=forces.force_n[first:last])
            yield LiveFrame(
                image=image,
                number=number,
                time_s=time_s,
                captured_s=time.monotonic(),
                decode_ms=decode_ms,
                forces=since,
                safety_margin=None if np.isnan(margin) else margin,
            )
            before = time.perf_counter()


_GRIP_N = 1.5
_GRIP_COURSE = np.array([[0, 0.3, 1.3, 1.8, 6.8, 7.8, 8.3, 9.5], [0, 0, 1, 1, 1, 1, 0, 0], [0, 0, 0, 0, 1, 1, 0, 0]])
"""Grip that the simulated fingertip repeats until `load` is called: seconds, and shares of press and pull."""


class SimulatedSource(DrawnSource):
    """Simulated fingertip that can be pressed and pulled while it runs.

    Until `load` is called it repeats a grip by itself: touch, press, pull until it slips, let go.

    Parameters
    ----------
    sensor
        `chromatouch` or `flat-gel`.
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

    def __init__(
        self, sensor: str = "chromatouch", *, friction: float = 0.775, rate_hz: float = 30.0, seed: int = 0
    ) -> None:
        chosen = pick(SENSORS, sensor, noun="simulated sensor")
        self.name, self.rate_hz = f"a simulated {sensor}", rate_hz
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

    def draw(self, _: int, time_s: float, /) -> tuple[Frame, tuple[float, float], float | None]:
        """Draw a frame of the load at its time."""
        normal_n, pull_n = self.forces_n(time_s)
        holding_n = self._grasp.friction * normal_n
        tangential_n = min(pull_n, holding_n)
        margin = 1 - tangential_n / holding_n if normal_n > 0 else np.nan
        loading = load_at_margins(np.array([margin]), grasp=replace(self._grasp, normal_force_n=normal_n))
        image = self._film.under(loading, rng=self._rng).draw(slice(0, 1)).numpy()[0]
        return image, (normal_n, tangential_n), float(margin) if normal_n > 0 else None

    def forces_n(self, time_s: float) -> tuple[float, float]:
        """Return the force that presses and the one that pulls at a time, before friction limits the latter."""
        if (forces_n := self._forces_n) is not None:
            return forces_n
        times_s, *courses = _GRIP_COURSE
        press, pull = (float(np.interp(time_s % times_s[-1], times_s, course)) for course in courses)
        return _GRIP_N * press, pull * self._grasp.friction * _GRIP_N


Images: TypeAlias = UInt8[np.ndarray, "frames height width 3"]


def _replay(source: Path | Images | Capture, options: LiveOptions) -> LiveSource:
    capture = source if isinstance(source, Capture) else open_source(source, trial=options.trial, whole=True)[0]
    return ReplaySource(capture, speed=options.speed or 1.0, rate_hz=options.rate_hz)


_ROWS = {
    "simulated": SourceKind(
        words="simulated fingertip (simulated, or simulated:flat-gel)",
        recognises=lambda name: name.partition(":")[0] == "simulated",
        open=lambda name, options: SimulatedSource(
            name.partition(":")[2] or "chromatouch", rate_hz=options.rate_hz or 30.0
        ),
        takes=("rate_hz",),
    ),
    "camera": SourceKind(
        words="camera by its number or device file (0, or /dev/video0)",
        recognises=lambda name: name.isdecimal() or name.startswith("/dev/"),
        open=lambda name, options: CameraSource(f"/dev/video{int(name)}" if name.isdecimal() else name, options),
        takes=("rate_hz", "size"),
    ),
    "stream": SourceKind(
        words="network stream by its address (rtsp://, http://, udp://)",
        recognises=lambda name: name.partition("://")[0].lower() in _NETWORK and "://" in name,
        open=CameraSource,
        takes=("size",),
    ),
    "replay": SourceKind(
        words="video, bag, images or trial of a data set, replayed",
        recognises=lambda name: Path(name).exists(),
        open=lambda name, options: _replay(Path(name), options),
        takes=("rate_hz", "speed", "trial"),
    ),
}
SOURCES = Table("source", "sliplens.sources", _ROWS)
"""Running sources by kind; an installed package adds its own by the entry point `sliplens.sources`."""


def open_live(
    source: str | Path | Images | Capture | LiveSource = "simulated", *, options: LiveOptions | None = None
) -> LiveSource:
    """Make the source of a name; a device is opened when the source is entered.

    Parameters
    ----------
    source
        `simulated`; the number of a camera; the address of a stream; the path of a video, a bag, a data set, or a
        folder of images; or uint8 RGB frames, a `Capture`, or a source.
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
        return _replay(source, options)
    name = str(source)
    for kind in sorted(SOURCES.values(), key=list(_ROWS.values()).__contains__):  # those that were added go first
        if kind.recognises(name):
            opened = kind.open(name, options)
            options.require_only(*kind.takes, what=opened.name)
            return opened
    kinds = "; ".join(kind.words for kind in SOURCES.values())
    raise InputError(f"{name} is no source that is known, nor a path that exists; name a {kinds}")
