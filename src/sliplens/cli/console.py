"""Output of the command line: progress bars, results, errors."""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import RLock

from rich import progress as rich_progress
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sliplens.progress import OnProgress, fold_equal, visible

OUT, ERR = Console(), Console(stderr=True)


def _shown(text: str) -> str:
    return escape(visible(text))


def fail(message: str, *each: str) -> None:
    """Print an error, in one line however narrow the terminal, and below it a line for each of what it is about."""
    ERR.print(f"[bold red]sliplens:[/] {_shown(message)}", soft_wrap=True, highlight=False)
    for line in each:
        ERR.print(f"  {_shown(line)}", soft_wrap=True, highlight=False)


def say(message: str, *, aside: bool = False) -> None:
    """Print a line of plain text, as a result or aside from it, where errors go."""
    (ERR if aside else OUT).print(_shown(message), soft_wrap=True, highlight=False)


def print_file(path: Path, what: str, *, kept: bool = False) -> None:
    """Print what was written where, or that it was complete already."""
    verb, what = ("kept", "made before with the same settings; --overwrite makes it again") if kept else ("wrote", what)
    OUT.print(f"[green]{verb}[/] {_shown(str(path))}  [dim]{_shown(what)}[/]", soft_wrap=True, highlight=False)


class Terminal:
    """Progress of a command on the terminal: a bar for each stage that is open, what was written, and notes.

    Give it as `on_progress` to any call of the library. Notes that come while a stage is open are printed when the last
    one ends, equal ones once, with their number.
    """

    def __init__(self) -> None:
        counters = [
            getattr(rich_progress, f"{name}Column")() for name in ("MofNComplete", "TimeElapsed", "TimeRemaining")
        ]
        columns = rich_progress.TextColumn("{task.description}"), rich_progress.BarColumn(bar_width=30), *counters
        self._bars = rich_progress.Progress(*columns, console=OUT)
        self._open: list[rich_progress.TaskID] = []
        self._notes: Counter[str] = Counter()
        self._lock = RLock()

    def __call__(self, done: int, total: int, /) -> None:
        """Show how far the newest open stage is; nothing where none is open."""
        with self._lock:
            if self._open:
                self._bars.update(self._open[-1], completed=done, total=total)

    @contextmanager
    def stage(self, title: str, /) -> Iterator[OnProgress]:
        """Show a bar while the stage is open; stages may be open side by side."""
        with self._lock:
            if not self._open:
                self._bars.start()
            task = self._bars.add_task(_shown(title), total=None)
            self._open.append(task)
        try:
            yield lambda done, total: self._bars.update(task, completed=done, total=total)
        finally:
            with self._lock:
                self._open.remove(task)
                if not self._open:
                    # stopped before its bar goes: the last frame of the screen keeps it
                    self._bars.stop()
                    self._tell_notes()
                self._bars.remove_task(task)

    wrote = staticmethod(print_file)

    def note(self, message: str, /) -> None:
        """Print a sentence; one that is repeated is printed once, with a count."""
        with self._lock:
            self._notes[message] += 1
            if not self._open:
                self._tell_notes()

    def _tell_notes(self) -> None:
        for message in fold_equal(self._notes.elements()):
            ERR.print(f"  note: {_shown(message)}", soft_wrap=True, highlight=False)
        self._notes.clear()


def _cell(value: str | int | float | None) -> str:
    if isinstance(value, float):
        return f"{value:.3g}"
    return "-" if value is None else f"{value:,}" if isinstance(value, int) else visible(value)


def print_table(title: str, rows: Sequence[Mapping[str, str | int | float | None]]) -> None:
    """Print a table, numbers to the right, without columns of None; a narrow terminal shows a line for each cell."""
    table = Table(title=_shown(title), title_justify="left")
    names = [name for name in rows[0] if any(row[name] is not None for row in rows)]
    columns = {visible(name): [_cell(row[name]) for row in rows] for name in names}
    widest = 1
    for place, (name, cells) in enumerate(columns.items()):
        widest += 3 + max(map(len, [name, *cells]))
        numbers = place and any(re.match(r"[-+]?\d", cell) for cell in cells)
        table.add_column(escape(name), justify="right" if numbers else "left", no_wrap=True)
    for cells in zip(*columns.values(), strict=True):
        table.add_row(*map(escape, cells))
    if widest <= OUT.width:
        OUT.print(table)
        return
    say(title)
    for cells in zip(*columns.values(), strict=True):
        for place, (name, cell) in enumerate(zip(columns, cells, strict=True)):
            say(f"{'  ' if place else ''}{name}: {cell}")
