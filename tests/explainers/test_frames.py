from pathlib import Path

import numpy as np
import pytest
import torch

from sliplens.errors import InputError
from sliplens.explainers.frames import FrameSelection, frames_from_dataset, frames_from_folder
from sliplens.images import write_png
from sliplens.models import Network, load
from sliplens.recordings import Dataset


@pytest.fixture
def difference(difference_run: Path) -> Network:
    return load(difference_run)


def test_frames_are_those_nearest_to_the_levels(difference: Network, small_dataset: Dataset):
    chosen = frames_from_dataset(difference, small_dataset, FrameSelection(levels=(1.0, 0.6, 0.0)))
    recording = small_dataset.load(small_dataset.select(split="test", condition="dry")[0])
    for level, label in zip((1.0, 0.6, 0.0), chosen.safety_margin, strict=True):
        assert abs(label - level) == pytest.approx(np.nanmin(np.abs(recording.safety_margin - level)), abs=1e-6)
    assert chosen.source == "simulated"
    assert not chosen.references.any()


def test_a_selection_that_cannot_be_is_refused():
    with pytest.raises(InputError, match=r"levels must lie in \[0, 1\], got 100, 80"):
        FrameSelection(levels=(100.0, 80.0))
    with pytest.raises(InputError, match="--trials must be at least 1, got 0"):
        FrameSelection(trials=0)


def test_difference_images_of_a_folder_are_what_the_data_set_gives(
    difference: Network, small_dataset: Dataset, difference_folder: Path
):
    chosen = frames_from_folder(difference, difference_folder, labels_in_names=True)
    recording = small_dataset.load(small_dataset.select(split="test", condition="dry")[0])
    expected = difference.encode(recording.frames[[1, 6, 11]], recording.reference)
    assert torch.equal(difference.encoding.normalise(chosen.images), expected)
    np.testing.assert_allclose(chosen.safety_margin, recording.safety_margin[[1, 6, 11]], atol=0.005)


def test_camera_frames_with_a_reference_give_the_same(difference: Network, small_dataset: Dataset, tmp_path: Path):
    recording = small_dataset.load(small_dataset.select(split="test", condition="dry")[0])
    (tmp_path / "frames").mkdir()
    write_png(tmp_path / "frames" / "a.png", recording.frames[6])
    write_png(tmp_path / "untouched.png", recording.reference)
    chosen = frames_from_folder(difference, tmp_path / "frames", reference=tmp_path / "untouched.png")
    expected = difference.encode(recording.frames[[6]], recording.reference)
    assert torch.equal(difference.encoding.normalise(chosen.images), expected)
    assert np.isnan(chosen.safety_margin).all()


def test_a_raw_network_needs_the_untouched_sensor(raw_run: Path, difference_folder: Path):
    with pytest.raises(InputError, match=r"is as dark as a difference image .*, and this network takes camera frames"):
        frames_from_folder(load(raw_run), difference_folder)


@pytest.mark.parametrize("name", ["frame_120.png", "frame_007.png", "frame.png"])
def test_a_name_without_a_label_is_refused_when_labels_are_asked_for(difference: Network, tmp_path: Path, name: str):
    write_png(tmp_path / name, np.zeros((48, 48, 3), np.uint8))
    with pytest.raises(InputError, match=r"carries no label; its name must end in the safety margin in percent"):
        frames_from_folder(difference, tmp_path, labels_in_names=True)
