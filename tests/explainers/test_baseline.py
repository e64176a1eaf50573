"""Baselines: what predictions are compared with."""

from pathlib import Path

import numpy as np
import pytest
import torch
from small import network_of
from torch import Tensor, nn

import sliplens as sl
from sliplens.errors import ImageError, InputError
from sliplens.explainers.explain import network_references
from sliplens.explainers.frames import FrameSelection, find_stick_frame
from sliplens.images import write_png
from sliplens.models import Network
from sliplens.recordings import Dataset, Recording

SELECT = FrameSelection(levels=(1.0, 0.5, 0.0))
COMPLETE = ("integrated-gradients", "shapley")


class Waves(nn.Module):
    """One convolution and a curved function of it: answers that differ between frames, of no dead unit."""

    def __init__(self, colours: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(colours, 8, 5, stride=3)
        self.fc = nn.Linear(8, 1)

    def forward(self, images: Tensor) -> Tensor:
        return self.fc(torch.sin(6 * self.conv(images)).mean(dim=(2, 3)))[:, 0]


@pytest.fixture(scope="module", params=["difference", "raw", "pair"])
def run(request: pytest.FixtureRequest) -> Network:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = Waves(6 if request.param == "pair" else 3)
    return network_of(model, input=request.param, image_size=32, frame_size=48)


@pytest.fixture(scope="module")
def trial(fine_dataset: Dataset) -> Recording:
    return fine_dataset.load(fine_dataset.select(split="test", condition="dry")[0])


@pytest.mark.parametrize("baseline", ["untouched", "stick", "given"])
def test_complete_maps_add_up_to_the_change_from_the_baseline(run, fine_dataset, trial, baseline):
    frame = {"untouched": trial.reference, "stick": trial.frames[2], "given": trial.frames[20]}[baseline]
    value = frame if baseline == "given" else baseline
    maps = sl.explain(run, fine_dataset, baseline=value, select=SELECT, method=COMPLETE)
    empty = run.encode(frame[None], trial.reference)
    torch.testing.assert_close(network_references(run, maps), empty.expand(3, -1, -1, -1))
    compared = float(run.predict(empty))
    assert maps.baseline == baseline
    for method in COMPLETE:
        sums = maps.relevance[method].sum(axis=(1, 2))
        change = np.array([each.prediction - compared for each in maps.frames])
        assert np.ptp(change) > 1e-3
        np.testing.assert_allclose(sums, change, atol=0.011 * np.abs(change).max())


def test_the_map_of_the_stick_frame_from_itself_is_zero(run, fine_dataset):
    select = FrameSelection(levels=(1 - 2 / 39, 0.0))
    maps = sl.explain(run, fine_dataset, select=select, method=(*COMPLETE, "occlusion"))
    assert [each.baseline_frame for each in maps.frames] == [2, 2]
    assert maps.frames[0].id.endswith("-f0002")
    for relevance in maps.relevance.values():
        np.testing.assert_allclose(relevance[0], 0, atol=1e-7)
        assert np.abs(relevance[1]).max() > 1e-6


def test_the_default_depends_on_the_source(difference_run, fine_dataset, trial, difference_folder):
    def baseline_of(source, **options) -> str:
        return sl.explain(difference_run, source, method="grad-cam", **options).baseline

    assert baseline_of(fine_dataset) == baseline_of(fine_dataset.folder) == "stick"
    assert baseline_of(trial.frames[3:5], reference=trial.reference) == "untouched"
    assert baseline_of(difference_folder) == "untouched"


def test_a_trial_without_a_stick_frame_is_compared_with_the_untouched_sensor(difference_run, fine_dataset, trial):
    maps = sl.explain(difference_run, trial.frames, reference=trial.reference, baseline="stick", method="grad-cam")
    assert maps.baseline == "untouched"
    assert all(each.baseline_frame is None for each in maps.frames)
    assert any("last frame before the pull was not found" in text for text in maps.methods["grad-cam"].warnings)
    plain = sl.explain(difference_run, trial.frames, reference=trial.reference, method="grad-cam")
    np.testing.assert_array_equal(maps.relevance["grad-cam"], plain.relevance["grad-cam"])


@pytest.mark.parametrize(
    ("margin", "stick"),
    [
        ([np.nan, 1.0, 1.0, 0.6, 0.0, 1.0], 2),  # not after the first full slip
        ([1.0, 0.5, 0.98, 0.96, 0.1], 2),
        ([0.92, 0.9, 0.88], 1),  # a share of the largest margin
        ([0.8, 0.7, 0.0], None),  # begins in the pull
        ([0.0, 1.0, 0.5], None),
    ],
)
def test_labels_tell_the_stick_frame(margin, stick):
    frame, warnings = find_stick_frame("cup", [], None, np.array(margin))
    assert frame == stick
    assert all("no margin before the first full slip reaches 0.9" in warning for warning in warnings)
    assert len(warnings) == (stick is None)


def test_markers_tell_the_stick_frame_where_there_are_no_labels(trials):
    pytest.importorskip("cv2", reason="OpenCV, of the extra markers, is not installed")
    trial = trials["chromatouch"]
    stick, _ = find_stick_frame("cup", trial.frames, trial.reference)
    assert stick is not None
    pressed = np.flatnonzero(trial.labelled)[0]
    assert pressed <= stick
    assert trial.safety_margin[stick] > 0.9
    frame, (warning,) = find_stick_frame("cup", [trial.reference] * 3, trial.reference)
    assert frame is None
    assert "its markers show no press" in warning


def test_an_image_that_does_not_fit_is_refused(difference_run: Path, fine_dataset: Dataset, tmp_path: Path):
    with pytest.raises(InputError, match="the baseline stik is no image; give untouched, stick,"):
        sl.explain(difference_run, fine_dataset, baseline="stik")
    write_png(tmp_path / "small.png", np.zeros((9, 9, 3), dtype=np.uint8))
    with pytest.raises(ImageError, match="the baseline's frame"):
        sl.explain(difference_run, fine_dataset, baseline=tmp_path / "small.png")


def test_scores_remove_towards_the_baseline(run, fine_dataset):
    maps = sl.explain(run, fine_dataset, select=SELECT, method="integrated-gradients")
    faithful = sl.score(run, maps, random_orders=1, steps=0)
    lost = faithful.curves["reference", "pixel", "integrated-gradients"].most_first[:, -1]
    change = [each.prediction - each.reference_prediction for each in maps.frames]
    np.testing.assert_allclose(np.abs(lost), np.abs(change), atol=1e-5)
