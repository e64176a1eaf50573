import json
from dataclasses import fields
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from sliplens.errors import InputError, RecordingError
from sliplens.recordings import Dataset, Recording
from sliplens.recordings.dataset import write_dataset_table
from sliplens.recordings.store import load_recording, save_recording


def test_a_trial_comes_back_without_loss(tmp_path: Path, recording: Recording):
    save_recording(recording, tmp_path / "a.parquet")
    back = load_recording(tmp_path / "a.parquet")
    for field in fields(Recording):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(recording, field.name))


def test_the_same_trial_gives_the_same_bytes(tmp_path: Path, recording: Recording):
    save_recording(recording, tmp_path / "a.parquet")
    save_recording(recording, tmp_path / "b.parquet")
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()


def test_a_truncated_trial_is_refused(tmp_path: Path, recording: Recording):
    path = tmp_path / "a.parquet"
    save_recording(recording, path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(RecordingError, match=r"a\.parquet is not a readable Parquet file"):
        load_recording(path)


def test_an_empty_stored_trial_is_refused(tmp_path: Path, recording: Recording):
    path = tmp_path / "a.parquet"
    save_recording(recording, path)
    pq.write_table(pq.read_table(path).slice(0, 0), path)
    with pytest.raises(RecordingError, match="trial trial has no frames"):
        load_recording(path)


def test_a_parquet_file_of_something_else_is_refused(tmp_path: Path, recording: Recording):
    path = tmp_path / "a.parquet"
    save_recording(recording, path)
    pq.write_table(pq.read_table(path).drop_columns(["image", "time_s"]), path)
    with pytest.raises(RecordingError, match=r"a\.parquet lacks image, time_s"):
        load_recording(path)


def test_a_data_set_lists_its_trials_by_split_and_condition(small_dataset: Dataset):
    assert len(small_dataset.trials) == 8
    assert [trial.condition for trial in small_dataset.select(split="test")] == ["dry", "wet"]
    assert small_dataset.simulated


def test_a_condition_that_is_not_there_is_refused(small_dataset: Dataset):
    with pytest.raises(RecordingError, match=r"no trial with split train and condition wet; it has test/dry, test/wet"):
        small_dataset.select(split="train", condition="wet")


def test_a_missing_data_set_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match=r"the data set .*nothing does not exist"):
        Dataset.open(tmp_path / "nothing")


def test_a_data_set_without_trials_is_refused(tmp_path: Path):
    write_dataset_table(tmp_path, [])
    with pytest.raises(RecordingError, match="lists no trials"):
        Dataset.open(tmp_path)


def test_a_data_set_of_another_schema_is_refused(tmp_path: Path):
    (tmp_path / "dataset.json").write_text(json.dumps({"schema_version": 99}))
    with pytest.raises(RecordingError, match="is not a sliplens data set of schema 1"):
        Dataset.open(tmp_path)
