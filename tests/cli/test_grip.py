"""`sliplens grip`: what it writes, and what is said to mistakes."""

from pathlib import Path

import pytest
from command_line import run

import sliplens as sl
from sliplens.codec import load_result
from sliplens.grip.records import Grip


def test_many_episodes_make_a_record_and_a_picture_and_are_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    words = ("grip", "-o", tmp_path, "--controller", "fixed", "--episodes", 4, "--set", "force_n=3.5")
    assert run(*words) == 0
    told = capsys.readouterr().out
    assert "0 of 4" in told
    assert "4 episodes" in told
    grip = load_result(tmp_path / "grip", Grip, command="sliplens grip")
    assert grip.setup.settings == {"force_n": 3.5}
    assert (tmp_path / "grip.png").is_file()
    assert len(sl.plot(grip).axes[0].lines) >= 2
    assert run(*words) == 0
    assert "kept" in capsys.readouterr().out
