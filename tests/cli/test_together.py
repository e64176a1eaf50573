"""Work in processes of its own: it is done and shown, and a failure ends all of it in one sentence."""

import multiprocessing
import os
from functools import partial
from pathlib import Path

import pytest
from pieces_of_work import break_down, die, refuse, write

from sliplens.cli.together import run_together
from sliplens.errors import InputError, SliplensError


def test_every_name_is_done_in_a_process_of_its_own_and_shown_here(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    run_together(partial(write, tmp_path), ["one", "two"], threads=1)
    told = [(tmp_path / name).read_text().split() for name in ("one", "two")]
    assert len({process for process, _ in told} | {str(os.getpid())}) == 3
    assert [threads for _, threads in told] == ["1", "1"]
    shown = capsys.readouterr().out
    assert "the file of one" in shown
    assert "the file of two" in shown


def test_a_mistake_in_one_is_raised_here_and_ends_the_others(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(InputError, match="quick cannot be used; use another"):
        run_together(refuse, ["slow", "quick"], threads=1)
    assert "quick begins" in capsys.readouterr().out
    assert not multiprocessing.active_children()


def test_a_process_that_is_killed_is_told_with_the_cure():
    with pytest.raises(SliplensError, match=r"one was ended by signal 9, .* with --jobs 1"):
        run_together(die, ["one"], threads=1)


def test_a_fault_of_the_program_is_not_taken_for_the_users():
    with pytest.raises(SliplensError, match="fault of sliplens"):
        run_together(break_down, ["one"], threads=1)
