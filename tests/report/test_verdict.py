"""Networks are judged by their errors."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sliplens.report import load_results
from sliplens.report.comparisons import compare_errors
from sliplens.report.verdict import judge_results
from sliplens.results.evaluation import ScoredFrames


@pytest.fixture
def verdict(workspace, rng):
    """Rows of the workspace as it is when called, by claim and network."""
    return lambda: {
        (row.claim, row.subject): row for table in judge_results(load_results(workspace), rng=rng) for row in table.rows
    }


def edit(path, change):
    value = json.loads(path.read_text(encoding="utf-8"))
    change(value)
    path.write_text(json.dumps(value), encoding="utf-8")


def replace(path, column, values):
    table = pq.read_table(path)
    pq.write_table(table.set_column(table.column_names.index(column), column, pa.array(values)), path)


DIFFERENCE, RAW = "Difference images", "Raw images"


def test_accuracy_has_its_numbers(workspace, verdict):
    scores = load_results(workspace).evaluations["difference"].conditions
    for condition in ("dry", "wet"):
        row = verdict()[f"Predicts the margin on {condition} objects", DIFFERENCE]
        assert row.number == f"R² {scores[condition].r2:.2f}"
        assert f"{100 * scores[condition].mae:.1f} percentage points" in row.sentence


@pytest.mark.parametrize(("r2", "outcome"), [(-0.1, "does not hold"), (0.0, "does not hold"), (None, "undecided")])
def test_a_network_no_better_than_the_mean_label_is_called_so(workspace, verdict, r2, outcome):
    edit(workspace / "test-raw" / "result.json", lambda value: value["conditions"]["wet"].update(r2=r2))
    row = verdict()["Predicts the margin on wet objects", RAW]
    assert row.outcome == outcome
    assert ("no better than the mean label" in row.sentence) == (r2 is not None)


def test_a_smaller_error_holds_only_beyond_the_interval(workspace, verdict, rng):
    claim = "Smaller error than raw images on dry objects", DIFFERENCE
    assert verdict()[claim].outcome == "holds"
    assert "over 6 trials, one day, one network" in verdict()[claim].sentence
    # the same predictions but for noise that favours neither
    path = workspace / "test-raw" / "predictions.parquet"
    predictions = pq.read_table(workspace / "test-difference" / "predictions.parquet")["prediction"].to_numpy()
    replace(path, "prediction", predictions + rng.normal(0, 1e-4, len(predictions)))
    assert verdict()[claim].outcome == "undecided"


@pytest.mark.parametrize(
    ("labels", "prediction", "expected"),
    [
        ((1.0, 0.8, 0.6, 0.4, 0.2, 0.0), None, ("holds", "0 points")),
        # the best constant is off by 30
        ((1.0, 0.8, 0.6, 0.4, 0.2, 0.0), 0.9, ("does not hold", "43 points")),
        ((None,) * 6, 0.9, ("undecided", "")),
    ],
)
def test_real_touch_is_compared_with_the_best_constant(workspace, verdict, labels, prediction, expected):
    def label(value):
        for frame, margin in zip(value["frames"], labels, strict=True):
            frame.update(safety_margin=margin, prediction=margin if prediction is None else prediction)

    edit(workspace / "maps-raw-real" / "result.json", label)
    row = verdict()["Predicts real touch better than a constant", RAW]
    assert (row.outcome, row.number) == expected


def test_fewer_than_five_trials_decide_nothing(workspace, verdict):
    def name_one_trial(value):
        for frame in value["frames"]:
            frame.update(trial="t0", safety_margin=0.5, prediction=0.5)

    edit(workspace / "maps-raw-real" / "result.json", name_one_trial)
    assert verdict()["Predicts real touch better than a constant", RAW].outcome == "undecided"
    path = workspace / "test-raw" / "predictions.parquet"
    table = pq.read_table(path)
    replace(path, "trial", ["t0" if name == "wet" else each for name, each in zip(
        table["condition"].to_pylist(), table["trial"].to_pylist(), strict=True)])  # fmt: skip
    assert verdict()["Predicts the margin on wet objects", RAW].outcome == "undecided"
    assert verdict()["Predicts the margin on dry objects", RAW].outcome == "holds"


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
