"""What the command line shows: progress bars, results, errors."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

OUT = Console()
ERR = Console(stderr=True)


def fail(message: str) -> None:
    """Print an error, in one line however narrow the terminal."""
    ERR.print(f"[bold red]sliplens:[/] {escape(message)}", soft_wrap=True, highlight=False)


def say(message: str) -> None:
    """Print a line of plain text."""
    OUT.print(escape(message), soft_wrap=True, highlight=False)


def wrote(path: Path, what: str) -> None:
    """Say what was written where."""
    OUT.print(f"[green]wrote[/] {escape(str(path))}  [dim]{escape(what)}[/]", soft_wrap=True, highlight=False)


def unchanged(path: Path) -> None:
    """Say that a result is there already."""
    OUT.print(
        f"[green]kept[/] {escape(str(path))}  [dim]made before with the same settings; --overwrite makes it again[/]",
        soft_wrap=True,
        highlight=False,
    )


@contextmanager
def progress_bar(title: str) -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar; yields a function of how many are done and how many there are."""
    with _progress() as bar:
        task = bar.add_task(title, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


class Bar:
    """One of several progress bars that are shown at the same time; there while it is begun."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._task: TaskID | None = None

    def begin(self, title: str) -> None:
        """Show it, from nothing."""
        self.finish()
        self._task = self._progress.add_task(title, total=None)

    def count(self, done: int, total: int) -> None:
        """Show how many are done, and how many there are."""
        if self._task is not None:
            self._progress.update(self._task, completed=done, total=total)

    def finish(self) -> None:
        """Take it away."""
        if self._task is not None:
            self._progress.remove_task(self._task)
            self._task = None


@contextmanager
def progress_bars() -> Iterator[Callable[[], Bar]]:
    """Show progress bars under each other; yields what makes one more."""
    with _progress() as progress:
        yield lambda: Bar(progress)


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=30),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=OUT,
    )


def print_table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table, numbers to the right."""
    table = Table(title=title, title_justify="left")
    for index, name in enumerate(header):
        table.add_column(name, justify="left" if index == 0 else "right")
    for row in rows:
        table.add_row(*row)
    OUT.print(table)


class Terminal:
    """Progress of a command, as `sliplens.progress.Stages`: a bar a stage, what was written, notes."""

    def __call__(self, done: int, total: int, /) -> None:
        """Show nothing: each stage has a bar of its own."""

    @contextmanager
    def stage(self, title: str, /) -> Iterator[Callable[[int, int], None]]:
        """Show a bar while the stage is open."""
        with progress_bar(title) as count:
            yield count

    def wrote(self, path: Path, what: str, /, *, kept: bool = False) -> None:
        """Say what was written where, or that it was there already."""
        if kept:
            unchanged(path)
        else:
            wrote(path, what)

    def note(self, message: str, /) -> None:
        """Print a sentence."""
        say(f"  note: {message}")
