"""`sliplens split`: what it shows, what it writes, and what it refuses."""

import json
import shutil
from pathlib import Path

import pytest
from command_line import refused, run
from data_sets import contents

from sliplens.recordings import Dataset, load_dataset
from sliplens.recordings.splits import SPLITS_FILE

RULES = """
[[split]]
name = "test"
day = 4
[[split]]
name = "validation"
trial = "*-5"
[[split]]
name = "train"
"""


def cells(out: str) -> list[list[str]]:
    """Rows of the tables that were shown."""
    return [[cell.strip() for cell in line.strip("│").split("│")] for line in out.splitlines() if "│" in line]


@pytest.fixture
def folder(tmp_path: Path, small_dataset: Dataset) -> Path:
    """Eight trials on four days in turn: 0 to 3 train, 4 and 5 validate, 6 and 7 test."""
    return shutil.copytree(small_dataset.folder, tmp_path / "data")


@pytest.fixture
def rules(tmp_path: Path) -> Path:
    path = tmp_path / "rules.toml"
    path.write_text(RULES)
    return path


def test_the_trials_go_where_the_rules_say(folder: Path, rules: Path, capsys: pytest.CaptureFixture[str]):
    assert run("split", folder, "--rules", rules) == 0
    found = {info.trial: info.split for info in load_dataset(folder).trials}
    # days 1 2 3 4 1 2 3 4: trials 3 and 7 are of day 4
    assert found == {
        "train-dry-0": "train",
        "train-dry-1": "train",
        "train-dry-2": "train",
        "train-dry-3": "test",
        "validation-dry-4": "train",
        "validation-dry-5": "validation",
        "test-dry-6": "train",
        "test-wet-7": "test",
    }
    out = capsys.readouterr().out
    assert ["train", "5", "60", "1-3", "-", "dry"] in cells(out)
    assert ["validation", "1", "12", "2", "-", "dry"] in cells(out)
    assert ["test", "2", "24", "4", "-", "dry, wet"] in cells(out)
    assert ["test", "train", "1", "test-dry-6"] in cells(out)
    assert ["train", "test", "1", "train-dry-3"] in cells(out)
    assert ["validation", "train", "1", "validation-dry-4"] in cells(out)
    assert "3 of 8 trials moved" in out
    assert "train anew" in out
    assert json.loads((folder / SPLITS_FILE).read_text())["source"] == str(rules)
    assert run("check", folder) == 0


def test_the_same_rules_move_nothing_twice(folder: Path, rules: Path, capsys: pytest.CaptureFixture[str]):
    run("split", folder, "--rules", rules)
    before = contents(folder)
    capsys.readouterr()
    assert run("split", folder, "--rules", rules) == 0
    assert contents(folder) == before
    out = capsys.readouterr().out
    assert "every trial is in its split already" in out
    assert "train anew" not in out


def test_a_dry_run_writes_nothing(folder: Path, rules: Path, capsys: pytest.CaptureFixture[str]):
    before = contents(folder)
    assert run("split", folder, "--rules", rules, "--dry-run") == 0
    assert contents(folder) == before
    out = capsys.readouterr().out
    assert ["train", "test", "1", "train-dry-3"] in cells(out)
    assert "nothing is written" in out


def test_names_with_brackets_are_shown_as_they_are(folder: Path, rules: Path, capsys: pytest.CaptureFixture[str]):
    table = json.loads((folder / "dataset.json").read_text())
    for trial in table["trials"]:
        trial["object"] = "mug [blue]"
    (folder / "dataset.json").write_text(json.dumps(table))
    assert run("split", folder, "--rules", rules, "--dry-run") == 0
    assert {row[4] for row in cells(capsys.readouterr().out) if len(row) == 6} == {"mug [blue]"}


def test_a_preset_splits_and_leaks_are_told(folder: Path, capsys: pytest.CaptureFixture[str]):
    assert run("split", folder, "--preset", "trials") == 0
    # 5.6, 1.2 and 1.2 of eight trials
    splits = [info.split for info in load_dataset(folder).trials]
    assert [splits.count(name) for name in ("train", "validation", "test")] == [6, 1, 1]
    assert "in train and test: the test does not tell of a new day" in capsys.readouterr().out
    assert run("split", folder, "--preset", "thesis") == 0
    tests = {info.day for info in load_dataset(folder).select(split="test")}
    assert tests == {4}
    assert "note:" not in capsys.readouterr().out


@pytest.mark.parametrize("options", [(), ("--rules", "rules.toml", "--preset", "trials")])
def test_rules_or_a_preset_are_needed(folder: Path, options: tuple[str, ...], capsys: pytest.CaptureFixture[str]):
    assert "give the file of rules with --rules, or a --preset" in refused(capsys, "split", folder, *options)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[[split]]\nname = "test"\ndays = 4', "rule 1: 'days' is no key of a rule"),
        ('[[split]]\nname = "test"\nday = 4', "train-dry-0, train-dry-1, train-dry-2, validation-dry-4, "),
        ('[[split]]\nname = "test"\nday = ', "not valid TOML"),
    ],
)
def test_a_mistake_leaves_all_as_it_was(
    folder: Path, rules: Path, text: str, message: str, capsys: pytest.CaptureFixture[str]
):
    rules.write_text(text)
    before = contents(folder)
    assert message in refused(capsys, "split", folder, "--rules", rules)
    assert contents(folder) == before


def test_what_is_not_there_is_told(folder: Path, rules: Path, capsys: pytest.CaptureFixture[str]):
    assert "does not exist" in refused(capsys, "split", folder / "nothing", "--rules", rules)
    assert "does not exist" in refused(capsys, "split", folder, "--rules", folder / "nothing.toml")
    assert "deals by object" in refused(capsys, "split", folder, "--preset", "objects")
