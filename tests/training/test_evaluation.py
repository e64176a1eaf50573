import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sliplens.results.evaluation import LeadTimes, RegressionScores, ScoredFrames
from sliplens.training import lead_times, regression_scores
from sliplens.training.evaluation import risk_coverage


def frames(labels: np.ndarray, predictions: np.ndarray, time_s: np.ndarray | None = None) -> ScoredFrames:
    """Frames of one trial."""
    text, number, unknown = np.full(len(labels), ""), np.arange(len(labels)), np.full(len(labels), np.nan)
    time_s = number / 10 if time_s is None else time_s
    return ScoredFrames(
        trial=text, condition=text, day=number, frame=number, time_s=time_s, safety_margin=labels,
        prediction=predictions, sigma=unknown, low_90=unknown, high_90=unknown, withheld=text,
    )  # fmt: skip


def scores_of(labels: np.ndarray, predictions: np.ndarray) -> RegressionScores:
    return regression_scores(frames(labels, predictions))


def leads_of(time_s: np.ndarray, labels: np.ndarray, predictions: np.ndarray) -> LeadTimes:
    return lead_times(frames(labels, predictions, time_s))


MARGINS = arrays(np.float64, 30, elements=st.floats(0, 1))


def test_predicting_the_mean_explains_nothing():
    labels = np.linspace(0, 1, 11)
    assert scores_of(labels, np.full(11, 0.5)).r2 == pytest.approx(0)


@given(MARGINS, MARGINS)
def test_bins_share_out_every_frame_and_all_of_the_error(labels: np.ndarray, predictions: np.ndarray):
    scores = scores_of(labels, predictions)
    assert sum(one.frames for one in scores.bins) == len(labels)
    total = sum(one.frames * one.mse for one in scores.bins if one.mse is not None)
    assert total == pytest.approx(len(labels) * scores.mse)


def test_edges_of_bins_belong_to_the_bin_above_and_one_to_the_last():
    labels = np.array([0.0, 0.1, 0.3, 0.6, 0.7, 1.0])  # 0.3, 0.6 and 0.7 are not exact in binary
    scores = scores_of(labels, labels)
    assert [index for index, one in enumerate(scores.bins) if one.frames] == [0, 1, 3, 6, 7, 9]
    assert scores.bins[2].mse is None


def trial() -> tuple[np.ndarray, np.ndarray]:
    """A margin that falls evenly to 0 at 10 s and stays there for a second, 10 frames a second."""
    time = np.arange(0, 11.05, 0.1)
    # rounded: 1 - 0.8 is not 0.2 in binary, and a threshold would tell them apart
    return time, np.clip(1 - time / 10, 0, 1).round(6)


def test_a_perfect_network_warns_as_early_as_the_margin_itself():
    time, labels = trial()
    found = leads_of(time, labels, labels)
    # below 0.2 from the first frame after 8 s on, at 10 s it slips
    assert found.median_ms == pytest.approx(1900)
    assert (found.trials, found.warned, found.false_per_minute) == (1, 1, 0)


def test_a_network_that_reads_too_much_warns_late_and_one_that_always_does_never():
    time, labels = trial()
    late = leads_of(time, labels, (labels + 0.1).round(6))
    # below 0.2 where the label is below 0.1: the last second
    assert late.median_ms == pytest.approx(900)
    never = leads_of(time, labels, labels + 0.3)
    assert (never.median_ms, never.warned, never.trials) == (None, 0, 1)


def test_alarms_far_from_slip_are_false_and_counted_by_the_minute():
    time, labels = trial()
    predictions = labels.copy()
    predictions[[5, 20, 21]] = 0.1  # two stretches, at margins of 0.95 and 0.8
    found = leads_of(time, labels, predictions)
    # 9.9 s lie between the first frame and the last before the slip
    assert found.false_per_minute == pytest.approx(2 / (9.9 / 60))
    assert found.median_ms == pytest.approx(1900)


def test_what_comes_after_the_slip_and_trials_that_never_slip_count_no_lead():
    time, labels = trial()
    held = labels >= 0.5
    found = leads_of(time[held], labels[held], labels[held])
    assert (found.trials, found.median_ms) == (0, None)
    after = labels.copy()
    after[labels <= 0] = 0.9
    # an answer after the slip changes nothing
    assert leads_of(time, labels, after) == leads_of(time, labels, labels)


def test_withholding_by_the_errors_themselves_is_best_and_by_chance_gains_nothing(rng: np.random.Generator):
    errors = rng.exponential(0.1, 2000)
    spread = errors + rng.normal(0, 0.05, 2000)
    found = risk_coverage(errors, {"known": rng.uniform(size=2000), "spread": -spread, "none": None})
    assert set(found.error) == {"known", "spread", "perfect"}
    assert found.whole == pytest.approx(errors.mean())
    assert found.error["perfect"] < found.error["spread"] < found.error["known"]
    # of an exponential with mean m, what lies below its quantile q has the mean m (1 + (1 - q) ln(1 - q) / q)
    assert found.error["perfect"] == pytest.approx(0.1 * (1 + 0.2 * np.log(0.2) / 0.8), rel=0.1)
    assert found.error["known"] == pytest.approx(errors.mean(), rel=0.1)
    assert f"{100 * errors.mean():.1f} points" in str(found)
