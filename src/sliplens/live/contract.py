"""Contract of running sources, and their options."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import cached_property
from threading import Event

import numpy as np

from sliplens.errors import InputError
from sliplens.live.reading import LiveFrame, Reading
from sliplens.recordings.capture import Forces, Frame


@dataclass(frozen=True, kw_only=True)
class LiveOptions:
    """Options of a source; each takes those that apply to it and refuses the others."""

    rate_hz: float | None = None
    """Frames a second; the source's own if None."""
    speed: float | None = None
    """Ratio of the recorded time to that of the replay: 2 is twice as fast; 1 if None."""
    trial: str | None = None
    """Trial of a data set or bag; the first if None."""
    size: tuple[int, int] | None = None
    """Height and width of the frames, in pixels; larger ones are scaled down. The source's own if None."""
    fit_size: tuple[int, int] | None = None
    """Height and width that a network was trained on, in pixels: used where the source can give it, else ignored."""

    def __post_init__(self) -> None:
        least = {"rate": self.rate_hz, "speed": self.speed, "size": min(self.size or (1,))}
        for name, value in least.items():
            if value is not None and not value > 0:
                raise InputError(f"--{name} must be positive, got {value:g}")

    def require_only(self, *names: str, what: str) -> None:
        """Refuse options that do not apply to a source."""
        for name, value in vars(self).items():
            if value is not None and name not in (*names, "fit_size"):
                raise InputError(f"{what} takes no --{name.removesuffix('_hz')}; leave it out")


class LiveSource(ABC):
    """Running source of frames; a context manager that holds a device, file or connection while it is open.

    It raises `SourceError` where it fails; a source that `reconnects` is then left and entered again until it is back.
    """

    name: str
    """Name in messages, such as "the camera /dev/video0"."""
    size: tuple[int, int]
    """Height and width of its frames, in pixels; set while it is open."""
    rate_hz: float | None = None
    """Frames a second; None where unknown."""
    reference: Frame | None = None
    """The sensor untouched, where the source brings its image."""
    count: int | None = None
    """Number of its frames; None where unknown."""
    speed: float = 1.0
    """Ratio of its time to that of the world: other than 1 where something is replayed."""
    cure: str = "check its cable or connection"
    """Cure where it gives no frame."""
    simulated: bool = False
    """True where no real sensor is behind it."""
    reconnects: bool = False
    """True where it may come back after a `SourceError`."""
    _stack = ExitStack()

    @cached_property
    def closed(self) -> Event:
        """Event that `close` sets, and entering the source clears."""
        return Event()

    def __enter__(self) -> "LiveSource":
        self.closed.clear()
        with ExitStack() as stack:
            self.open(stack)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
        with suppress(OSError):  # a device may be gone already
            self._stack.close()

    def open(self, stack: ExitStack, /) -> None:  # noqa: B027 (some hold nothing open)
        """Open the device, file or connection, and leave it to the stack to close it."""

    @abstractmethod
    def frames(self) -> Iterator[LiveFrame]:
        """Iterate over frames as they come; ends when the source does, or soon after `close`."""

    def update_reading(self, reading: Reading) -> None:  # noqa: B027 (most act on nothing)
        """Take the reading of a frame: for a source that acts on it, as a gripper does."""

    def close(self) -> None:
        """Stop giving frames, soon; may be called from another thread, and again."""
        self.closed.set()


class Pace:
    """Clock of a source that makes its own frames: waits until each is due, or the source is closed."""

    def __init__(self, closed: Event) -> None:
        self._closed, self._start_s = closed, time.monotonic()

    def wait(self, due_s: float) -> bool:
        """Wait until so many seconds after the start; False if the source was closed. A late frame moves the start."""
        wait_s = self._start_s + due_s - time.monotonic()
        if wait_s > 0:
            return not self._closed.wait(wait_s)
        self._start_s -= wait_s
        return not self._closed.is_set()


class DrawnSource(LiveSource):
    """Simulated source that draws a frame at each of its times."""

    simulated = True

    @abstractmethod
    def draw(self, number: int, time_s: float, /) -> tuple[Frame, tuple[float, float], float | None]:
        """Draw the frame of a time; returns it, its normal and tangential force in newtons, and its true margin."""

    def frames(self) -> Iterator[LiveFrame]:
        """Iterate over frames at their times."""
        pace, number, rate_hz = Pace(self.closed), 0, self.rate_hz or 30.0
        while pace.wait(time_s := number / rate_hz):
            captured_s = time.monotonic()
            image, (normal_n, tangential_n), margin = self.draw(number, time_s)
            force_n = np.array([[tangential_n, 0.0, normal_n]])
            yield LiveFrame(
                image=image,
                number=number,
                time_s=time_s,
                captured_s=captured_s,
                decode_ms=1e3 * (time.monotonic() - captured_s),
                forces=Forces(time_s=np.array([time_s]), force_n=force_n, source=self.name),
                safety_margin=margin,
            )
            number += 1


@dataclass(frozen=True, kw_only=True)
class SourceKind:
    """Row of `SOURCES`: how a running source is recognised and opened."""

    words: str
    """Description in lists and messages."""
    recognises: Callable[[str], bool]
    """Returns True for the names of this kind, without opening anything."""
    open: Callable[[str, LiveOptions], LiveSource]
    """Nothing runs before the source is entered."""
    takes: tuple[str, ...] = ("rate_hz", "speed", "trial", "size")
    """Options of `LiveOptions` that apply; others are refused."""
