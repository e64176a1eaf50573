"""What a running source is, and what a user may wish of it."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from threading import Event

from sliplens.errors import InputError
from sliplens.live.reading import LiveFrame, Reading
from sliplens.recordings.capture import Frame


@dataclass(frozen=True, kw_only=True)
class LiveOptions:
    """Wishes of a user for a source; each takes those that it understands and refuses the others."""

    rate_hz: float | None = None
    """Frames a second; the source's own if None."""
    speed: float | None = None
    """Ratio of the recorded time to that of the replay: 2 is twice as fast; 1 if None."""
    trial: str | None = None
    """Trial of a data set or bag; the first if None."""
    size: tuple[int, int] | None = None
    """Height and width of the frames, in pixels; larger ones are scaled down. The source's own if None."""
    pixel_format: str | None = None
    """Format of a camera, four letters such as MJPG or YUYV; MJPG where the camera has it if None."""

    fit_size: tuple[int, int] | None = None
    """Height and width that a network was trained on, in pixels: taken where the source can give it, else let be."""

    def __post_init__(self) -> None:
        for name, value in (
            ("rate", self.rate_hz),
            ("speed", self.speed),
            *(("size", side) for side in self.size or ()),
        ):
            if value is not None and not value > 0:
                raise InputError(f"--{name} must be positive, got {value:g}")

    def require_only(self, *names: str, what: str) -> None:
        """Refuse wishes that a source does not understand."""
        for name, value in vars(self).items():
            if value is not None and name not in (*names, "fit_size"):
                option = name.removesuffix("_hz").replace("_", "-")
                raise InputError(f"{what} takes no --{option}; leave it out")


def parse_size(text: str | None) -> tuple[int, int] | None:
    """Height and width of a text such as 640x480, which names the width first; None stays None."""
    if text is None:
        return None
    width, times, height = text.lower().partition("x")
    if not (times and width.isdecimal() and height.isdecimal()):
        raise InputError(f"--size is {text!r}; give width and height as 640x480")
    return int(height), int(width)


class LiveSource(ABC):
    """Running source of frames; a context manager that holds a device, file or connection while it is open.

    It says what is wrong by a `SourceError`: a source that `reconnects` is then left and entered again until it comes
    back.
    """

    name: str
    """What it is, for people."""
    size: tuple[int, int]
    """Height and width of its frames, in pixels; known when it is open."""
    rate_hz: float | None = None
    """Frames a second that it gives, as far as it knows."""
    reference: Frame | None = None
    """The sensor untouched, where the source brings its image."""
    count: int | None = None
    """Frames that it will give; None where nobody knows."""
    speed: float = 1.0
    """Ratio of its time to that of the world: other than 1 where something is replayed."""
    cure: str = "check its cable or connection"
    """What to do where it gives no frame."""
    simulated: bool = False
    """Whether no real sensor is behind it."""
    reconnects: bool = False
    """Whether it may come back after a `SourceError`."""

    def __enter__(self) -> "LiveSource":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def frames(self) -> Iterator[LiveFrame]:
        """Frames as they come; it ends when the source does, or soon after `close`."""

    def hear(self, reading: Reading) -> None:  # noqa: B027 (most act on nothing)
        """Take what was read of a frame: for a source that acts on it, as a gripper does."""

    def close(self) -> None:  # noqa: B027 (most have nothing to give back)
        """Stop giving frames, soon; may be called from another thread, and again."""


class Pace:
    """Clock of a source that makes its own frames: waits until each is due, or the source is closed."""

    def __init__(self, closed: Event) -> None:
        self._closed, self._start_s = closed, time.monotonic()

    def wait(self, due_s: float) -> bool:
        """Wait until so many seconds after the start; False if the source was closed.

        What comes late moves the start: a source that is slow falls behind once, and does not hurry afterwards.
        """
        left_s = self._start_s + due_s - time.monotonic()
        if left_s > 0:
            return not self._closed.wait(left_s)
        self._start_s -= left_s
        return not self._closed.is_set()


@dataclass(frozen=True, kw_only=True)
class SourceKind:
    """How a running source is recognised and opened."""

    words: str
    """What it is, for people."""
    recognises: Callable[[str], bool]
    """Told by the name that the user gave, without opening anything."""
    open: Callable[[str, LiveOptions], LiveSource]
    """Nothing runs before the source is entered."""


__all__ = ["LiveOptions", "LiveSource", "SourceKind"]
