"""A trial whose file was damaged after it was written: every command says so in one sentence."""

import shutil
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from command_line import refused, run

from sliplens.recordings import Dataset, load_dataset
from sliplens.recordings.dataset import trial_path


def damage_page(path: Path, column: str) -> None:
    """Overwrite the head of a column's first page: what it holds can no longer be read."""
    group = pq.read_metadata(path).row_group(0)
    chunks = [group.column(index) for index in range(group.num_columns)]
    place = next(chunk.data_page_offset for chunk in chunks if chunk.path_in_schema == column)
    with path.open("r+b") as file:
        file.seek(place)
        file.write(b"\xff" * 40)


@pytest.fixture
def damaged(tmp_path: Path, small_dataset: Dataset) -> Path:
    folder = tmp_path / "data"
    shutil.copytree(small_dataset.folder, folder)
    return folder


def test_a_damaged_page_is_told_by_every_command(
    capsys: pytest.CaptureFixture[str], damaged: Path, difference_run: Path, tmp_path: Path
):
    data = load_dataset(damaged)
    for split in ("train", "test"):
        damage_page(trial_path(damaged, data.select(split=split)[0].trial), "image")
    trial = data.select(split="test")[0].trial
    commands = (
        ("train", damaged, "-o", tmp_path / "run", "--image-size", "32", "--batch-size", "4"),
        ("evaluate", difference_run, damaged, "-o", tmp_path / "scores"),
        ("view", damaged, "--trial", trial, "-o", tmp_path / "trial.rrd"),
    )
    for words in commands:
        line = refused(capsys, *words)
        assert "is not a readable Parquet file" in line
        assert line.endswith("make the data set again")
        assert not Path(words[words.index("-o") + 1]).exists()


def test_a_damaged_page_leaves_all_other_trials_predicted(
    capsys: pytest.CaptureFixture[str], damaged: Path, difference_run: Path, tmp_path: Path
):
    trial = load_dataset(damaged).select(split="test")[0].trial
    damage_page(trial_path(damaged, trial), "image")
    assert run("predict", difference_run, damaged, "-o", tmp_path / "margins.parquet") == 1
    head, line = (line for line in capsys.readouterr().err.splitlines() if "note:" not in line)
    assert "1 of 8 could not be done" in head
    assert line.startswith(f"  {trial}: ")
    assert "is not a readable Parquet file" in line
    assert not (tmp_path / "margins.parquet").exists()
