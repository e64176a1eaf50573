"""`sliplens simulate`: data sets, and what it says to mistakes."""

import json
from pathlib import Path

import pytest
from command_line import refused, run

from sliplens.recordings import load_dataset
from sliplens.simulation import PRESETS, make_recipe

SMALL = ("--dry-trials", "3", "--wet-trials", "1", "--days", "2", "--frames-per-trial", "20")


def test_a_data_set_is_written_whole_and_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    command = ("simulate", tmp_path / "data", *SMALL, "--sensor", "flat-gel", "--release")
    assert run(*command) == 0
    data = load_dataset(tmp_path / "data")
    assert [trial.split for trial in data.trials] == ["train", "validation", "test", "test"]
    assert {trial.sensor for trial in data.trials} <= {"flat-gel-1", "flat-gel-2"}
    recipe = json.loads((tmp_path / "data" / "run.json").read_text())["config"]["recipe"]
    assert recipe["release"] is True
    assert recipe["sensor"]["name"] == "flat-gel"
    assert {path.name for path in tmp_path.iterdir()} == {"data"}
    assert run(*command) == 0
    assert "kept" in capsys.readouterr().out
    assert "other settings" in refused(capsys, *command, "--seed", 1)


def test_options_change_a_preset_and_drop_its_totals():
    assert make_recipe("thesis", release=False, seed=0) == PRESETS["thesis"]
    assert make_recipe() == PRESETS["small"]
    changed = make_recipe("thesis", days=6)
    assert (changed.days, changed.dry_trials, changed.frame_totals) == (6, 191, None)
