import numpy as np
import pytest

from sliplens.intervals import FEWEST_UNITS, paired_difference


def test_the_interval_of_a_mean_is_that_of_the_central_limit_theorem(rng: np.random.Generator):
    second = rng.normal(0, 5, 400)
    first = second + rng.normal(0.2, 1, 400)
    found = paired_difference(first, second, rng=rng)
    gap = first - second
    assert found.estimate == pytest.approx(gap.mean())
    # 2000 resamples give the ends of the interval to some 4 % of its half width; five times that
    half = 1.96 * gap.std() / 20
    assert found.low == pytest.approx(gap.mean() - half, abs=0.2 * half)
    assert found.high == pytest.approx(gap.mean() + half, abs=0.2 * half)
    assert found.units == 400


def test_frames_of_one_trial_are_not_evidence_of_their_own(rng: np.random.Generator):
    by_trial = rng.normal(0, 1, 20)
    first = np.repeat(by_trial, 50)
    alone = paired_difference(first, np.zeros(1000), rng=rng)
    together = paired_difference(first, np.zeros(1000), trials=np.repeat(np.arange(20), 50), rng=rng)
    assert together.units == 20
    assert together.estimate == pytest.approx(alone.estimate)
    # 50 copies of each: sqrt(50) = 7 times as wide
    assert together.high - together.low > 5 * (alone.high - alone.low)


def test_few_units_are_never_sure(rng: np.random.Generator):
    few = paired_difference(np.ones(FEWEST_UNITS - 1), np.zeros(FEWEST_UNITS - 1), rng=rng)
    enough = paired_difference(np.ones(FEWEST_UNITS), np.zeros(FEWEST_UNITS), rng=rng)
    assert (few.sure, enough.sure) == (False, True)
