"""Exported data sets are read as any recording."""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from data_sets import save_dataset
from exportable import make_trial
from memory import held_below
from there import there

from sliplens.errors import InputError, RecordingError
from sliplens.recordings import Dataset
from sliplens.recordings.exporting import export_lerobot, export_mcap
from sliplens.recordings.formats.stored import read_stored
from sliplens.recordings.source import open_source

pytest.importorskip("rosbags")
pytest.importorskip("mcap")

KINDS: dict[str, Callable[..., object]] = {"lerobot": export_lerobot, "mcap": export_mcap}


@pytest.mark.parametrize("kind", KINDS)
def test_frames_and_forces_of_an_export_are_read_without_loss(data: Dataset, tmp_path: Path, kind: str):
    KINDS[kind](data, tmp_path / "out", trials=["full"])
    original = read_stored(data.folder)[0]
    (capture,) = open_source(next((tmp_path / "out").glob("*.mcap"), tmp_path / "out"), whole=True)
    np.testing.assert_array_equal(list(capture.read_frames()), list(original.read_frames()))
    assert capture.labels is None
    if kind == "mcap":
        np.testing.assert_array_equal(there(capture.forces).force_n, there(original.forces).force_n)
        # the clock of the bag counts whole nanoseconds from the first frame or force
        shift = capture.frame_time_s - original.frame_time_s
        np.testing.assert_allclose(shift, shift[0], atol=1.1e-9)
    else:  # (F_t, 0, F_n) at the nominal times of LeRobot, in single precision
        np.testing.assert_array_equal(capture.frame_time_s, (np.arange(40) / 30).astype(np.float32))
        np.testing.assert_array_equal(there(capture.forces).force_n[:, 2], there(original.labels).normal_force_n)


@pytest.mark.parametrize("kind", KINDS)
def test_memory_does_not_grow_with_the_length_of_a_trial(tmp_path: Path, kind: str, rng: np.random.Generator):
    count, size = 300, (120, 160)
    frames = np.broadcast_to(rng.integers(0, 256, (*size, 3), dtype=np.uint8), (count, *size, 3))
    trial = replace(make_trial("long", rng, count=count), frames=frames, reference=frames[0])
    data = save_dataset(tmp_path / "data", trial)
    # 17 MB of pixels: 16 frames and their PNG at a time, a chunk of 1 MiB a few times over
    with held_below(9e6):
        KINDS[kind](data, tmp_path / "out")
        (capture,) = open_source(next((tmp_path / "out").glob("*.mcap"), tmp_path / "out"), whole=True)
        assert sum(1 for _ in capture.read_frames()) == count


def test_trials_that_ros_or_lerobot_cannot_take_are_refused_and_nothing_stays(tmp_path: Path, rng: np.random.Generator):
    late = save_dataset(tmp_path / "late", make_trial("late", rng, start_s=3e9))
    with pytest.raises(RecordingError, match=r"trial late goes to 3e.*; import it"):
        export_mcap(late, tmp_path / "out")
    first = make_trial("a", rng)
    small = {"frames": np.zeros((9, 8, 8, 3), np.uint8), "reference": np.zeros((8, 8, 3), np.uint8)}
    for name, changes in (("frame rate", {"time_s": np.arange(9) / 60}), ("frames", small)):
        others = replace(first, trial="c"), replace(first, trial="b", **changes)
        with pytest.raises(RecordingError, match=f"trial b has .*other {name}, and a LeRobot data set has one"):
            export_lerobot(save_dataset(tmp_path / name, first, *others), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("module", ["mcap", "rosbags"])
def test_without_the_libraries_the_extra_is_named(data: Dataset, tmp_path: Path, monkeypatch, module: str):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=r'pip install "sliplens\[ros\]"'):
        export_mcap(data, tmp_path / "out")
