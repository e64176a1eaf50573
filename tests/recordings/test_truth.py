"""The ground truth of simulated trials: kept without loss, and checked."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from sliplens.errors import RecordingError
from sliplens.recordings import GroundTruth, Recording
from sliplens.recordings.store import load_recording, read_header, save_recording


@pytest.fixture
def truth(recording: Recording, rng: np.random.Generator) -> GroundTruth:
    frames, height, width = recording.frames.shape[:3]
    radius = rng.uniform(0.001, 0.002, frames)
    return GroundTruth(
        recipe="0123456789abcdef",
        displacement="half-space",
        marker_rest_px=rng.uniform(0, 48, (7, 2)).astype(np.float32),
        marker_px=rng.uniform(0, 48, (frames, 7, 2)).astype(np.float32),
        static_friction=rng.uniform(0.2, 1.0, frames),
        contact_radius_m=radius,
        stick_radius_m=radius * rng.uniform(0, 1, frames),
        contact_map=rng.integers(0, 3, (frames, height, width), dtype=np.uint8),
    )


def test_truth_comes_back_without_loss(tmp_path: Path, recording: Recording, truth: GroundTruth):
    save_recording(replace(recording, truth=truth), tmp_path / "a.parquet")
    back = load_recording(tmp_path / "a.parquet")
    assert back.truth is not None
    for field in fields(GroundTruth):
        np.testing.assert_array_equal(getattr(back.truth, field.name), getattr(truth, field.name))
    np.testing.assert_array_equal(back.frames, recording.frames)


def test_training_does_without_the_truth(tmp_path: Path, recording: Recording, truth: GroundTruth):
    save_recording(replace(recording, truth=truth), tmp_path / "a.parquet")
    back = load_recording(tmp_path / "a.parquet", truth=False)
    assert back.truth is None
    np.testing.assert_array_equal(back.frames, recording.frames)


def test_header_tells_a_trial_without_its_frames(tmp_path: Path, recording: Recording, truth: GroundTruth):
    for kept, recipe in ((None, None), (truth, "0123456789abcdef")):
        save_recording(replace(recording, truth=kept), tmp_path / "a.parquet")
        header = read_header(tmp_path / "a.parquet")
        assert (header.trial, header.frames, header.height, header.width) == ("trial", 12, 48, 48)
        assert (header.truth and header.truth.recipe) == recipe


def test_a_file_that_lost_a_column_of_its_truth_is_refused(tmp_path: Path, recording: Recording, truth: GroundTruth):
    path = tmp_path / "a.parquet"
    save_recording(replace(recording, truth=truth), path)
    pq.write_table(pq.read_table(path).drop_columns(["contact_map"]), path)
    with pytest.raises(RecordingError, match=r"a\.parquet lacks the column 'contact_map'; make the data set again"):
        load_recording(path)


@pytest.mark.parametrize("name", ["load_recording", "read_header"])
def test_a_missing_trial_is_refused(tmp_path: Path, name: str):
    read = {"load_recording": load_recording, "read_header": read_header}[name]
    with pytest.raises(RecordingError, match=r"a\.parquet does not exist; make the data set again"):
        read(tmp_path / "a.parquet")


def test_truth_that_contradicts_itself_is_refused(recording: Recording, truth: GroundTruth):
    with pytest.raises(RecordingError, match="12 frames of markers but 11 of contact_radius_m"):
        replace(truth, contact_radius_m=truth.contact_radius_m[1:])
    with pytest.raises(RecordingError, match="6 markers at rest but 7 in its frames"):
        replace(truth, marker_rest_px=truth.marker_rest_px[1:])
    with pytest.raises(RecordingError, match="frame 0 sticks beyond its contact"):
        replace(truth, stick_radius_m=2 * truth.contact_radius_m)
    shorter = replace(
        truth,
        marker_px=truth.marker_px[1:],
        static_friction=truth.static_friction[1:],
        contact_radius_m=truth.contact_radius_m[1:],
        stick_radius_m=truth.stick_radius_m[1:],
        contact_map=truth.contact_map[1:],
    )
    with pytest.raises(RecordingError, match="trial trial has 12 frames but the truth of 11"):
        replace(recording, truth=shorter)
