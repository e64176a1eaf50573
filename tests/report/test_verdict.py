"""Networks are judged by their errors."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sliplens.plots.style import UNKNOWN
from sliplens.report import load_results
from sliplens.report.verdict import compare_errors, judge_accuracy, judge_results
from sliplens.results.evaluation import RegressionScores, ScoredFrames

from .study_results import edit


@pytest.fixture
def verdict(workspace, rng):
    """Rows of the workspace as it is when called, by claim and network."""
    return lambda: {(row.claim, row.subject): row for row in judge_results(load_results(workspace), rng=rng)}


def replace(path, column, values):
    table = pq.read_table(path)
    pq.write_table(table.set_column(table.column_names.index(column), column, pa.array(values)), path)


DIFFERENCE, RAW = "Difference images", "Raw images"


@pytest.mark.parametrize(
    ("r2", "trials", "outcome"),
    [
        (0.1, 5, "holds"),
        (0.0, 5, "does not hold"),
        (-0.1, 5, "does not hold"),
        (None, 5, "undecided"),
        (0.9, 4, "undecided"),
    ],
)
def test_a_network_is_held_against_the_mean_label_over_five_trials(r2, trials, outcome):
    score = RegressionScores(frames=9, trials=trials, mse=0.01, r2=r2, mae=0.1, bins=())
    assert judge_accuracy(score) == outcome


def test_a_smaller_error_holds_only_beyond_the_interval(workspace, verdict, rng):
    claim = "Smaller error than raw images on dry objects", DIFFERENCE
    assert verdict()[claim].outcome == "holds"
    assert "over 6 trials, one day, one network" in verdict()[claim].why
    # the same predictions but for noise that favours neither
    path = workspace / "test-raw" / "predictions.parquet"
    predictions = pq.read_table(workspace / "test-difference" / "predictions.parquet")["prediction"].to_numpy()
    replace(path, "prediction", predictions + rng.normal(0, 1e-4, len(predictions)))
    assert verdict()[claim].outcome == "undecided"


@pytest.mark.parametrize(
    ("prediction", "trials", "expected"),
    [
        (None, 6, ("holds", "0 points")),
        # the best constant is off by 30
        (0.9, 6, ("does not hold", "43 points")),
        (0.9, 0, ("undecided", UNKNOWN)),  # without labels
        (None, 4, ("undecided", "0 points")),  # too few trials
    ],
)
def test_real_touch_is_compared_with_the_best_constant(workspace, verdict, prediction, trials, expected):
    def label(value):
        for at, (frame, margin) in enumerate(zip(value["frames"], (1.0, 0.8, 0.6, 0.4, 0.2, 0.0), strict=True)):
            told = margin if prediction is None else prediction
            frame.update(trial=f"t{at % max(1, trials)}", safety_margin=margin if trials else None, prediction=told)

    edit(workspace / "maps-raw-real" / "result.json", label)
    row = verdict()["Predicts real touch better than a constant", RAW]
    assert (row.outcome, row.ours) == expected


def predictions(error: np.ndarray, *, order: np.ndarray | None = None) -> ScoredFrames:
    trials, frames = error.shape
    rows = np.arange(error.size) if order is None else order
    return ScoredFrames(
        trial=np.repeat([f"t{index}" for index in range(trials)], frames)[rows],
        condition=np.full(error.size, "dry")[rows],
        day=np.zeros(error.size, dtype=np.int64),
        frame=np.tile(np.arange(frames), trials)[rows],
        time_s=np.zeros(error.size),
        safety_margin=np.full(error.size, 0.5),
        prediction=(0.5 + error.ravel())[rows],
        **{name: np.full(error.size, np.nan) for name in ("sigma", "low_90", "high_90")},
        withheld=np.full(error.size, ""),
    )


def test_errors_differ_by_the_means_of_their_squares_over_trials(rng):
    first, second = rng.normal(size=(2, 8, 5))
    gap = compare_errors(predictions(first), predictions(second), rng=rng)
    assert gap is not None
    assert gap.estimate == pytest.approx(np.mean(first**2) - np.mean(second**2))
    assert gap.units == 8


def test_rows_are_matched_whatever_their_order_and_other_frames_are_not_compared(rng):
    error = rng.normal(size=(8, 5))
    gap = compare_errors(predictions(error), predictions(error, order=rng.permutation(40)), rng=rng)
    assert gap is not None
    assert (gap.low, gap.estimate, gap.high) == (0, 0, 0)
    assert compare_errors(predictions(error), predictions(error[:7]), rng=rng) is None
