from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sliplens.errors import RecordingError
from sliplens.models import load_checkpoint
from sliplens.models.encodings import ENCODINGS
from sliplens.recordings import Dataset
from sliplens.training import evaluate_frames, regression_scores
from sliplens.training.data import load_frames

MARGINS = arrays(np.float64, 30, elements=st.floats(0, 1))


def test_predicting_the_mean_explains_nothing():
    labels = np.linspace(0, 1, 11)
    assert regression_scores(labels, np.full(11, 0.5)).r2 == pytest.approx(0)


@given(MARGINS, MARGINS)
def test_bins_share_out_every_frame_and_all_of_the_error(labels: np.ndarray, predictions: np.ndarray):
    scores = regression_scores(labels, predictions)
    assert sum(one.frames for one in scores.bins) == len(labels)
    total = sum(one.frames * one.mse for one in scores.bins if one.mse is not None)
    assert total == pytest.approx(len(labels) * scores.mse)


def test_edges_of_bins_belong_to_the_bin_above_and_one_to_the_last():
    labels = np.array([0.0, 0.1, 0.3, 0.6, 0.7, 1.0])  # 0.3, 0.6 and 0.7 are not exact in binary
    scores = regression_scores(labels, labels)
    assert [index for index, one in enumerate(scores.bins) if one.frames] == [0, 1, 3, 6, 7, 9]
    assert scores.bins[2].mse is None


def test_labels_in_percent_are_refused():
    with pytest.raises(RecordingError, match=r"labels must lie in \[0, 1\]; give the safety margin as a fraction"):
        regression_scores(np.array([80.0]), np.array([0.8]))


def test_every_condition_is_scored_on_its_own_frames(small_dataset: Dataset, difference_run: Path):
    trained = load_checkpoint(difference_run)
    frames = load_frames(
        small_dataset, small_dataset.select(split="test"), encoding=ENCODINGS["difference"], image_size=32
    )
    evaluation = evaluate_frames(trained, frames, batch_size=5)
    table = evaluation.frame().to_pydict()
    for condition in ("dry", "wet"):
        rows = [index for index, name in enumerate(table["condition"]) if name == condition]
        squares = [(table["prediction"][row] - table["safety_margin"][row]) ** 2 for row in rows]
        assert evaluation.conditions[condition].mse == pytest.approx(np.mean(squares))
        assert evaluation.conditions[condition].trials == 1
