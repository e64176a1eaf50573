"""What the stages of long work show: on this terminal, or on that of the process that started them."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Protocol, TypeAlias, runtime_checkable

from sliplens.cli import console

Count: TypeAlias = Callable[[int, int], None]
"""Takes how many are done, and how many there are."""


@runtime_checkable
class Screen(Protocol):
    """Shows progress and what was made; its methods are those of `console`."""

    def progress_bar(self, title: str) -> AbstractContextManager[Count]:
        """Show a progress bar while it is open."""
        ...

    def say(self, message: str) -> None:
        """Print a line."""
        ...

    def wrote(self, path: Path, what: str) -> None:
        """Say what was written where."""
        ...

    def unchanged(self, path: Path) -> None:
        """Say that a result is there already."""
        ...


class Terminal:
    """The terminal of this process."""

    progress_bar = staticmethod(console.progress_bar)
    say = staticmethod(console.say)
    wrote = staticmethod(console.wrote)
    unchanged = staticmethod(console.unchanged)


class Remote:
    """The terminal at the other end of a pipe (`show`)."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe

    @contextmanager
    def progress_bar(self, title: str) -> Iterator[Count]:
        """Show a progress bar while it is open."""
        self._pipe.send(("begin", title))
        yield lambda done, total: self._pipe.send(("count", done, total))
        self._pipe.send(("finish",))

    def say(self, message: str) -> None:
        """Print a line."""
        self._pipe.send(("say", message))

    def wrote(self, path: Path, what: str) -> None:
        """Say what was written where."""
        self._pipe.send(("wrote", path, what))

    def unchanged(self, path: Path) -> None:
        """Say that a result is there already."""
        self._pipe.send(("unchanged", path))


def show(event: tuple[Any, ...], bar: console.Bar) -> None:
    """Show what a `Remote` sent; its progress on a bar of its own."""
    kind, *values = event
    match kind:
        case "begin":
            bar.begin(*values)
        case "count":
            bar.count(*values)
        case "finish":
            bar.finish()
        case "say" | "wrote" | "unchanged":
            getattr(console, kind)(*values)
