"""Work in processes of its own: it is done and shown, and a failure ends all of it in one sentence."""

import multiprocessing
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest
from pieces_of_work import break_down, die, refuse, write

from sliplens.errors import InputError, SliplensError
from sliplens.progress import OnProgress
from sliplens.study.processes import run_together


class Shown(list):
    """What the processes told, in order."""

    def __call__(self, done: int, total: int, /) -> None:
        self.append((done, total))

    @contextmanager
    def stage(self, title: str, /) -> Iterator[OnProgress]:
        self.append(f"begin {title}")
        yield self
        self.append(f"end {title}")

    def wrote(self, path: Path, what: str, /, *, kept: bool = False) -> None:
        self.append(f"{path.name}: {what}{' (kept)' if kept else ''}")

    def note(self, message: str, /) -> None:
        self.append(message)


def test_every_name_is_done_in_a_process_of_its_own_and_shown_here(tmp_path: Path):
    shown = Shown()
    run_together(partial(write, tmp_path), ["one", "two"], threads=1, on_progress=shown)
    told = [(tmp_path / name).read_text().split() for name in ("one", "two")]
    assert len({process for process, _ in told} | {str(os.getpid())}) == 3
    assert [threads for _, threads in told] == ["1", "1"]
    for name in ("one", "two"):
        own = [
            shown.index(line)
            for line in (f"begin Writing {name}", f"end Writing {name}", f"{name}: the file of {name}")
        ]
        assert own == sorted(own)
    assert shown.count((1, 1)) == 2


def test_a_mistake_in_one_is_raised_here_and_ends_the_others():
    shown = Shown()
    with pytest.raises(InputError, match="quick cannot be used; use another"):
        run_together(refuse, ["slow", "quick"], threads=1, on_progress=shown)
    assert shown == ["quick begins"]
    assert not multiprocessing.active_children()


def test_a_process_that_is_killed_is_told_with_the_cure():
    with pytest.raises(SliplensError, match=r"was ended from outside, .* with --jobs 1"):
        run_together(die, ["one"], threads=1, on_progress=None)


def test_an_interruption_ends_all():
    class Interrupt(Shown):
        def note(self, message: str, /) -> None:
            raise KeyboardInterrupt(message)

    with pytest.raises(KeyboardInterrupt):
        run_together(refuse, ["slow", "quick"], threads=1, on_progress=Interrupt())
    assert not multiprocessing.active_children()


def test_a_fault_of_the_program_is_not_taken_for_the_users():
    with pytest.raises(ZeroDivisionError):
        run_together(break_down, ["one"], threads=1, on_progress=None)
