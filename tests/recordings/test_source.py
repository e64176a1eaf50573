"""One way to open frames: the same trial, wherever it lies."""

import numpy as np
import pytest
from own_recording import write_images
from there import there

from sliplens.errors import ImageError, InputError
from sliplens.recordings import Dataset
from sliplens.recordings.formats import ReadOptions
from sliplens.recordings.source import open_source


@pytest.fixture
def folder(tmp_path, rng):
    """Three images and what they show."""
    frames = rng.integers(0, 256, (3, 24, 32, 3), dtype=np.uint8)
    return write_images(tmp_path / "frames", frames), frames


def test_a_folder_and_an_array_give_the_same_frames(folder):
    path, frames = folder
    for source in (path, str(path), frames):
        (trial,) = open_source(source, reference_frame=1)
        assert (len(trial), trial.frame_size) == (3, (24, 32))
        for _ in range(2):  # reading begins anew
            np.testing.assert_array_equal(np.stack(list(trial.read_frames())), frames)
        np.testing.assert_array_equal(there(trial.read_reference)(), frames[1])
        assert trial.time_s is None


def test_images_and_frames_in_memory_have_times_where_their_rate_is_told(folder):
    for source in folder:
        (trial,) = open_source(source, options=ReadOptions(frame_rate=4.0))
        np.testing.assert_allclose(there(trial.time_s), [0, 0.25, 0.5])
        assert trial.frame_rate_hz == pytest.approx(4.0)


def test_a_data_set_brings_references_times_and_trusted_labels(small_dataset: Dataset):
    trials = open_source(small_dataset, split="test")
    assert [trial.trial for trial in trials] == [info.trial for info in small_dataset.select(split="test")]
    recording = small_dataset.load(small_dataset.select(split="test")[0])
    np.testing.assert_array_equal(there(trials[0].read_reference)(), recording.reference)
    np.testing.assert_array_equal(next(trials[0].read_frames()), recording.frames[0])
    np.testing.assert_array_equal(there(trials[0].time_s), recording.time_s)
    np.testing.assert_array_equal(np.isfinite(there(trials[0].safety_margin)), recording.labelled)
    (one,) = open_source(small_dataset.folder, trial=trials[-1].trial)
    assert one.trial == trials[-1].trial


def test_what_does_not_fit_is_told(folder, small_dataset: Dataset):
    path, frames = folder
    with pytest.raises(ImageError, match="the reference is 12 x 32 pixels but the frames of frames are 24 x 32"):
        open_source(path, reference=frames[0, :12])
    with pytest.raises(InputError, match="named twice"):
        open_source(frames, reference=frames[0], reference_frame=0)
    with pytest.raises(InputError, match=r"no frame 3; name one from 0 to 2"):
        open_source(frames, reference_frame=3)
    with pytest.raises(InputError, match="there is no frame; give one or more"):
        open_source(frames[:0])
    with pytest.raises(InputError, match="frames in memory do not take --skip-frames; leave it out"):
        open_source(frames, options=ReadOptions(frame_rate=4.0, skip_frames=1))
    with pytest.raises(InputError, match=r"has no trial nothing; it has"):
        open_source(small_dataset, trial="nothing")
