import numpy as np
import pytest
from interval_ends import ends_of

from sliplens.report.comparisons import compare_deletion, compare_errors
from sliplens.results.evaluation import ScoredFrames
from sliplens.results.faithfulness import DeletionCurve


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


def test_difference_is_that_of_the_means(rng):
    first, second = rng.normal(size=(2, 8, 5))

    gap = compare_errors(predictions(first), predictions(second), rng=rng)

    assert gap is not None
    assert gap.estimate == pytest.approx(np.mean(first**2) - np.mean(second**2))
    assert gap.units == 8
    low, high = ends_of(gap)
    assert low <= gap.estimate <= high


def test_rows_are_matched_whatever_their_order(rng):
    error = rng.normal(size=(8, 5))

    gap = compare_errors(predictions(error), predictions(error, order=rng.permutation(40)), rng=rng)

    assert gap is not None
    assert (gap.low, gap.estimate, gap.high) == (0, 0, 0)


def test_other_frames_are_not_compared(rng):
    error = rng.normal(size=(8, 5))

    assert compare_errors(predictions(error), predictions(error[:7]), rng=rng) is None


def curve(ids: str, scores: np.ndarray, trials: str) -> DeletionCurve:
    return DeletionCurve(
        frame_ids=tuple(ids),
        clusters=np.array([["1"] * len(ids), list(trials)]),
        pixels_removed=np.array([1, 2]),
        scores=np.repeat(scores[:, None], 2, axis=1),
        predictions=np.ones((len(ids), 2)),
    )


def test_curves_of_other_frames_are_not_compared(rng):
    one, other = (curve(name, np.ones(1), "t") for name in "ab")

    assert compare_deletion(one, other, rng=rng) is None


def test_deletion_is_compared_over_trials_not_frames(rng):
    scores = rng.random(12)
    one, other = (curve("abcdefghijkl", values, "sstttuuuvvww") for values in (scores, 0 * scores))

    gap = compare_deletion(one, other, rng=rng)

    assert gap is not None
    assert gap.units == 5
