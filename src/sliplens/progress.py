"""Progress of long work, reported to the caller.

Whatever takes long takes `on_progress`, called with how many are done and how many there are. Work of several stages
also names them where the callback can show that (`Stages`), as the command line's can.
"""

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeAlias, TypeVar, runtime_checkable

OnProgress: TypeAlias = Callable[[int, int], None]
"""Takes how many are done, and how many there are."""
Item = TypeVar("Item")


def visible(text: str) -> str:
    r"""Text in one line, with all that cannot be seen written out: a terminal would obey what names in files may hold.

    Examples
    --------
    >>> from sliplens.progress import visible
    >>> visible("cup" + chr(27) + "[2J")
    'cup\\x1b[2J'
    """
    printable = (letter.isprintable() or letter == "\N{NO-BREAK SPACE}" for letter in text)
    return "".join(letter if shows else repr(letter)[1:-1] for letter, shows in zip(text, printable, strict=True))


def number_of(count: int, noun: str) -> str:
    """How many there are of what a noun names that takes an s.

    Examples
    --------
    >>> from sliplens.progress import number_of
    >>> number_of(1, "trial"), number_of(1204, "trial")
    ('1 trial', '1,204 trials')
    """
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"


@runtime_checkable
class Stages(Protocol):
    """A callback for progress that also shows stages, what they wrote, and what a reader should know."""

    def __call__(self, done: int, total: int, /) -> None:
        """Show how many are done, and how many there are."""

    def stage(self, title: str, /) -> AbstractContextManager[OnProgress]:
        """Show a stage while it is open; gives the callback for its own progress."""
        ...

    def wrote(self, path: Path, what: str, /, *, kept: bool = False) -> None:
        """Show what was written where, or that it was there already."""

    def note(self, message: str, /) -> None:
        """Show a sentence."""


def fold_equal(messages: Iterable[str]) -> list[str]:
    """Fold messages that differ in their numbers and in the name they begin with into the first of them.

    Examples
    --------
    >>> from sliplens.progress import fold_equal
    >>> fold_equal(["cup-1: 3 s are missing", "dark", "cup-2: 4 s are missing", "dark"])
    ['cup-1: 3 s are missing (and 1 more with other names or numbers)', 'dark (2 times)']
    """
    alike: dict[str, list[str]] = {}
    for message in messages:
        alike.setdefault(re.sub(r"^\S+: |[-\u2212]?\d+(?:[.,]\d+)?", "#", message), []).append(message)
    folded = []
    for first, *others in alike.values():
        different = {*others} - {first}
        count = f"and {len(different)} more with other names or numbers" if different else f"{len(others) + 1} times"
        folded.append(f"{first} ({count})" if others else first)
    return folded


@dataclass(frozen=True, kw_only=True, slots=True)
class _Span:
    """Part of a progress bar that the running loop fills."""

    listener: OnProgress
    first: int = 0
    size: int = 0
    total: int | None = None
    """Length of the whole bar; None until the outermost loop sets it."""

    def show(self, done: int, total: int) -> None:
        if self.total is None:
            self.listener(done, total)
        elif total:
            self.listener(self.first + self.size * done // total, self.total)


_SPAN: ContextVar[_Span | None] = ContextVar("sliplens_progress", default=None)


@contextmanager
def reporting(listener: OnProgress | None) -> Iterator[None]:
    """Report progress, stages, files and notes of the enclosed work to a callback.

    Public functions enclose their work in it and pass their parameter `on_progress`; None keeps the callback of the
    caller. Functions below them call `report_each`, `open_stage`, `add_note` and `report_file` and take no callback.

    Examples
    --------
    >>> from sliplens.progress import reporting, report_each
    >>> with reporting(lambda done, total: print(f"{done} of {total}")):
    ...     squares = [number**2 for number in report_each([1, 2])]
    1 of 2
    2 of 2
    """
    before = _SPAN.get()
    if listener is not None:
        _SPAN.set(_Span(listener=listener))
    try:
        yield
    finally:
        _SPAN.set(before)


def report_each(items: Collection[Item], *, sizes: Sequence[int] | None = None) -> Iterator[Item]:
    """Iterate over items and report each as done when the next one is requested.

    Loops nest: a loop within an item fills the item's part of the bar. `sizes` gives the length of each item's part
    (its frames, for example), 1 by default.
    """
    span = _SPAN.get()
    if span is None:
        yield from items
        return
    lengths = [1] * len(items) if sizes is None else list(sizes)
    total, done = sum(lengths), 0
    try:
        for item, length in zip(items, lengths, strict=True):
            if span.total is None:
                inner = _Span(listener=span.listener, first=done, size=length, total=total)
            else:
                first, end = (span.first + span.size * place // max(total, 1) for place in (done, done + length))
                inner = _Span(listener=span.listener, first=first, size=end - first, total=span.total)
            _SPAN.set(inner)
            yield item
            done += length
            span.show(done, total)
    finally:
        _SPAN.set(span)


def report_progress(done: int, total: int) -> None:
    """Report how many items of the running loop are done, where `report_each` does not fit."""
    if (span := _SPAN.get()) is not None:
        span.show(done, total)


@contextmanager
def open_stage(title: str) -> Iterator[None]:
    """Show a progress bar of its own for the enclosed work."""
    listener = current_listener()
    if isinstance(listener, Stages):
        with listener.stage(title) as count, counting(count):
            yield
    else:
        yield


@contextmanager
def counting(count: OnProgress) -> Iterator[None]:
    """Report the progress of the enclosed work to `count`; stages, files and notes as before."""
    with reporting(_Counter(current_listener(), count)):
        yield


def report_file(path: Path, what: str, *, kept: bool = False) -> None:
    """Report a file or folder that was written, or `kept` because it was complete already."""
    if isinstance(listener := current_listener(), Stages):
        listener.wrote(path, what, kept=kept)


def add_note(message: str) -> None:
    """Report a sentence that the user should know."""
    if isinstance(listener := current_listener(), Stages):
        listener.note(message)


def current_listener() -> OnProgress | None:
    """Return the callback that the running work reports to; None without one."""
    span = _SPAN.get()
    return None if span is None else span.listener


def current_reporter() -> OnProgress:
    """Return the function that reports the progress of the running loop, to be called from anywhere."""
    span = _SPAN.get()
    return ignore if span is None else span.show


class _Counter:
    """Callback with a bar of its own; everything else goes to the callback around it."""

    def __init__(self, outer: OnProgress | None, count: OnProgress) -> None:
        self._count = count
        if isinstance(outer, Stages):
            self.stage, self.wrote, self.note = outer.stage, outer.wrote, outer.note

    def __call__(self, done: int, total: int, /) -> None:
        self._count(done, total)


def ignore(_done: int, _total: int) -> None:
    """Show nothing."""
