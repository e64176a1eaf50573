"""`sliplens split`: what it shows, what it writes, and what it refuses."""

import json
import shutil
from pathlib import Path

import pytest
from command_line import run, table_cells
from data_sets import contents

from sliplens.recordings import Dataset, load_dataset


@pytest.fixture
def folder(tmp_path: Path, small_dataset: Dataset) -> Path:
    """Eight trials on four days in turn: 0 to 3 train, 4 and 5 validate, 6 and 7 test."""
    return shutil.copytree(small_dataset.folder, tmp_path / "data")


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "splits.csv"
    path.write_text("trial,split\n*-[37],test\n*-5,validation\n*,train\n")
    return path


def test_the_trials_go_where_the_table_says(folder: Path, table: Path, capsys: pytest.CaptureFixture[str]):
    before = contents(folder)
    assert run("split", folder, "--splits", table, "--dry-run") == 0
    assert "nothing is written" in capsys.readouterr().out
    assert contents(folder) == before
    assert run("split", folder, "--splits", table) == 0
    splits = {info.trial[-1]: info.split for info in load_dataset(folder).trials}
    assert splits == {**dict.fromkeys("01246", "train"), "5": "validation", **dict.fromkeys("37", "test")}
    out = capsys.readouterr().out
    assert ["train", "5", "60", "1, 2, 3", "-", "dry"] in table_cells(out)
    assert ["test", "2", "24", "4", "-", "dry, wet"] in table_cells(out)
    assert ["test", "train", "1", "test-dry-6"] in table_cells(out)
    assert ["train", "test", "1", "train-dry-3"] in table_cells(out)
    assert "3 of 8 trials moved" in out
    assert "train again" in out
    assert run("check", folder) == 0
    # and nothing moves twice
    after = contents(folder)
    capsys.readouterr()
    assert run("split", folder, "--splits", table) == 0
    assert contents(folder) == after
    out = capsys.readouterr().out
    assert "every trial is in its split already" in out
    assert "train again" not in out


def test_names_with_brackets_are_shown_as_they_are(folder: Path, table: Path, capsys: pytest.CaptureFixture[str]):
    rows = json.loads((folder / "dataset.json").read_text())
    for trial in rows["trials"]:
        trial["object"] = "mug [blue]"
    (folder / "dataset.json").write_text(json.dumps(rows))
    assert run("split", folder, "--splits", table, "--dry-run") == 0
    assert {row[4] for row in table_cells(capsys.readouterr().out) if len(row) == 6} == {"mug [blue]"}


def test_trials_are_dealt_by_a_fact_and_leaks_are_noted(folder: Path, capsys: pytest.CaptureFixture[str]):
    assert run("split", folder, "--splits", "trial") == 0
    # 5.6, 1.2 and 1.2 of eight trials
    splits = [info.split for info in load_dataset(folder).trials]
    assert [splits.count(name) for name in ("train", "validation", "test")] == [6, 1, 1]
    assert "in both train and test" in capsys.readouterr().out
    assert run("split", folder, "--splits", "day", "--shares", 0.5, 0.25, 0.25) == 0
    data = load_dataset(folder)
    days = [{info.day for info in data.select(split=name)} for name in ("train", "validation", "test")]
    assert [len(each) for each in days] == [2, 1, 1]
    assert "note:" not in capsys.readouterr().out
