"""The ground truth of simulated trials: kept without loss, and checked."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from sliplens.errors import RecordingError
from sliplens.recordings import GroundTruth, Recording
from sliplens.recordings.store import load_recording, save_recording


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


def test_truth_that_contradicts_itself_is_refused(truth: GroundTruth):
    with pytest.raises(RecordingError, match="frame 0 sticks beyond its contact"):
        replace(truth, stick_radius_m=2 * truth.contact_radius_m)
