from collections.abc import Callable

import numpy as np
import pytest
from interval_ends import ends_of, width_of
from scipy.special import stdtrit

from sliplens.intervals import FEWEST_UNITS, Difference, mean_interval, paired_difference

DRAWS = 300
# 95 % less and plus 2.8 standard errors of a share of 300: one test in 200 fails by chance, and the seed is fixed
LEAST, MOST = 0.95 - 2.8 * np.sqrt(0.05 * 0.95 / DRAWS), 0.95 + 2.8 * np.sqrt(0.05 * 0.95 / DRAWS)


def normal(rng: np.random.Generator, *size: int) -> np.ndarray:
    return rng.normal(size=size)


def skewed(rng: np.random.Generator, *size: int) -> np.ndarray:
    return (rng.gamma(2, size=size) - 2) / np.sqrt(2)


def one_network(draw: Callable[..., np.ndarray], rng: np.random.Generator) -> tuple[np.ndarray, list[np.ndarray]]:
    """14 trials of three frames, of one day."""
    values = draw(rng, 14, 1) + 0.5 * draw(rng, 14, 3)
    return values.ravel(), [np.zeros(42), np.repeat(np.arange(14), 3)]


def three_networks(draw: Callable[..., np.ndarray], rng: np.random.Generator) -> tuple[np.ndarray, list[np.ndarray]]:
    """The same 14 trials of 4 days, seen by three networks."""
    day = np.arange(14) % 4
    trial = 0.5 * draw(rng, 4)[day] + draw(rng, 14)
    values = 0.3 * draw(rng, 3)[:, None, None] + trial[:, None] + 0.5 * draw(rng, 3, 14, 3)
    network, number, _ = (axis.ravel() for axis in np.indices(values.shape))
    return values.ravel(), [network, day[number], number]


def percentile(values: np.ndarray, trials: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The plain bootstrap, which resamples trials alone and takes quantiles of their means."""
    means = np.bincount(trials, weights=values) / np.bincount(trials)
    return np.quantile(means[rng.integers(0, len(means), (500, len(means)))].mean(axis=1), [0.025, 0.975])


@pytest.mark.parametrize("draw", [normal, skewed])
@pytest.mark.parametrize("scene", [one_network, three_networks])
def test_intervals_hold_as_often_as_they_say_and_those_of_the_plain_bootstrap_do_not(scene, draw):
    rng, held, plain = np.random.default_rng(5), 0, 0
    for _ in range(DRAWS):
        values, clusters = scene(draw, rng)
        gap = paired_difference(values, np.zeros(len(values)), clusters=clusters, rng=rng)
        low, high = ends_of(gap)
        held += low <= 0 <= high
        low, high = percentile(values, clusters[-1], rng)
        plain += low <= 0 <= high
    assert LEAST <= held / DRAWS <= MOST
    if (scene, draw) != (one_network, normal):  # the one case that it nearly holds
        assert plain / DRAWS < LEAST


def test_the_interval_of_a_mean_is_that_of_the_central_limit_theorem(rng: np.random.Generator):
    second = rng.normal(0, 5, 400)
    first = second + rng.normal(0.2, 1, 400)
    found = paired_difference(first, second, clusters=(), rng=rng)
    gap = first - second
    assert found.estimate == pytest.approx(gap.mean())
    # 2000 resamples give the ends of the interval to some 4 % of its half width; five times that
    half = 1.96 * gap.std() / 20
    assert found.low == pytest.approx(gap.mean() - half, abs=0.2 * half)
    assert found.high == pytest.approx(gap.mean() + half, abs=0.2 * half)
    assert found.units == 400


def test_the_interval_of_a_few_clusters_is_that_of_student(rng: np.random.Generator):
    days = rng.normal(1, 1, 4)
    values = np.repeat(days, 6)
    found = paired_difference(
        values, np.zeros(24), clusters=[np.repeat(np.arange(4), 6), np.repeat(np.arange(12), 2)], rng=rng
    )
    half = stdtrit(3, 0.975) * days.std(ddof=1) / 2
    assert (found.low, found.high) == pytest.approx((days.mean() - half, days.mean() + half))


def test_frames_of_one_trial_are_not_evidence_of_their_own(rng: np.random.Generator):
    by_trial = rng.normal(0, 1, 20)
    first = np.repeat(by_trial, 50)
    alone = paired_difference(first, np.zeros(1000), clusters=(), rng=rng)
    together = paired_difference(first, np.zeros(1000), clusters=[np.repeat(np.arange(20), 50)], rng=rng)
    assert together.units == 20
    assert together.estimate == pytest.approx(alone.estimate)
    # 50 copies of each: sqrt(50) = 7 times as wide
    assert width_of(together) > 5 * width_of(alone)


def test_networks_that_differ_widen_the_interval(rng: np.random.Generator):
    networks, trials = (axis.ravel() for axis in np.indices((3, 14)))
    of_trial = rng.normal(0, 1, 14)[trials]
    apart = of_trial + np.array([-2.0, 0.0, 2.0])[networks]
    alike = paired_difference(of_trial, np.zeros(42), clusters=[networks, 0 * trials, trials], rng=rng)
    differing = paired_difference(apart, np.zeros(42), clusters=[networks, 0 * trials, trials], rng=rng)
    unknown = paired_difference(apart, np.zeros(42), clusters=[trials], rng=rng)
    assert width_of(differing) > 2 * width_of(alike)
    # the same trials seen thrice are no more trials
    assert (alike.networks, alike.days, alike.units) == (3, 1, 14)
    assert width_of(unknown) < width_of(differing) / 2


def test_an_interval_tells_what_it_was_taken_over():
    gap = Difference(estimate=0.0, low=0.0, high=0.0, units=14, days=4)
    assert gap.over == "14 trials, 4 days, one network"


def test_the_order_of_the_two_turns_the_interval_round(rng: np.random.Generator):
    first, second = rng.gamma(1, size=(2, 12))
    one, other = (
        paired_difference(*pair, clusters=(), rng=np.random.default_rng(0))
        for pair in ((first, second), (second, first))
    )
    assert one.estimate == pytest.approx(-other.estimate)
    assert ends_of(one) == pytest.approx([-end for end in ends_of(other)[::-1]])


def test_a_single_trial_has_no_interval(rng: np.random.Generator):
    alone = paired_difference(rng.random(6) + 1, np.zeros(6), clusters=[np.ones(6), np.zeros(6)], rng=rng)
    assert (alone.low, alone.high) == (None, None)
    assert alone.over == "one trial, one day, one network"
    assert not alone.sure
    # of several trials that are all alike the spread is known, and nothing
    same = paired_difference(np.ones(6), np.zeros(6), clusters=[np.arange(6) // 2], rng=rng)
    assert (same.low, same.estimate, same.high) == (1, 1, 1)


@pytest.mark.parametrize("sign", [1, -1])
def test_the_interval_of_a_correlation_ends_where_correlations_do(sign, rng: np.random.Generator):
    values, trials = sign * np.array([0.95, 0.99, 0.6, 0.97, 0.98, 0.2]), [np.arange(6)]
    free = mean_interval(values, clusters=trials, rng=rng)
    found = mean_interval(values, clusters=trials, rng=rng, limits=(-1.0, 1.0))
    # the mean may be anywhere within: what is cut off held it in no case
    low, high = ends_of(free)
    assert max(-low, high) > 1
    assert ends_of(found) == ((low, 1) if sign > 0 else (-1, high))
    assert found.estimate == free.estimate


def test_few_units_are_never_sure(rng: np.random.Generator):
    few = paired_difference(np.ones(FEWEST_UNITS - 1), np.zeros(FEWEST_UNITS - 1), clusters=(), rng=rng)
    enough = paired_difference(np.ones(FEWEST_UNITS), np.zeros(FEWEST_UNITS), clusters=(), rng=rng)
    assert (few.sure, enough.sure) == (False, True)


@pytest.mark.parametrize("trials", [6, 12])
def test_of_several_comparisons_all_intervals_hold_together(trials: int, rng: np.random.Generator):
    values, clusters = rng.normal(size=trials), [np.arange(trials)]

    def width(comparisons: int) -> float:
        draws = np.random.default_rng(0)
        return width_of(paired_difference(values, 0 * values, clusters=clusters, rng=draws, comparisons=comparisons))

    assert width(5) > width(2) > width(1)
    if trials == 6:  # Student's, at a fifth of the error
        wider = stdtrit(5, 1 - 0.025 / 5) / stdtrit(5, 0.975)
        assert width(5) == pytest.approx(wider * width(1))
