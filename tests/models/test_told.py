"""The margin once friction is told."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from there import there

from sliplens.errors import InputError
from sliplens.friction import Friction, as_friction
from sliplens.models import Network
from sliplens.models.calibration import condition_on_friction

EDGES, RATIO_EDGES = np.linspace(-0.1, 1.1, 61), np.linspace(-0.1, 1.5, 81)
MARGINS = np.clip((EDGES[1:] + EDGES[:-1]) / 2, 0, 1)
TRAINED = np.linspace(0.15, 1.2, 11)
EVEN = np.where((EDGES[:-1] >= -1e-9) & (EDGES[1:] <= 1 + 1e-9), 1 / 50, 0.0)[None]


def ratio_about(mean: float, sigma: float) -> np.ndarray:
    share = np.diff(stats.norm.cdf(RATIO_EDGES, mean, sigma))
    return share[None] / share.sum()


def told(margin: np.ndarray, ratio: np.ndarray, friction: Friction) -> np.ndarray:
    return condition_on_friction(
        margin, ratio, edges=EDGES, ratio_edges=RATIO_EDGES, friction=friction, trained_friction=TRAINED
    )


@pytest.mark.parametrize(("ratio", "friction"), [(0.3, 0.6), (0.1, 0.5), (0.05, 0.2), (0.7, 0.4)])
def test_a_sure_ratio_and_a_sure_friction_are_the_closed_form(ratio: float, friction: float):
    found = told(EVEN, ratio_about(ratio, 0.005), Friction(friction))
    assert found.sum() == pytest.approx(1)
    # a bin of either answer is 0.02 wide
    assert (found @ MARGINS)[0] == pytest.approx(max(0, 1 - ratio / friction), abs=0.02 + 0.01 / friction)


def test_told_what_the_training_had_the_margin_stays():
    margin = np.diff(stats.norm.cdf(EDGES, 0.5, 0.06))[None]
    margin /= margin.sum()
    # a ratio of 0.3 and margins from 0.3 to 0.7 mean frictions from 0.43 to 1, all within the training's
    found = told(margin, ratio_about(0.3, 0.02), Friction.between(0.15, 1.2, values=400))
    # but for the tenth of doubt, in which the ratio and the range alone decide
    alone = told(np.zeros_like(margin), ratio_about(0.3, 0.02), Friction.between(0.15, 1.2, values=400))
    np.testing.assert_allclose(found, (margin + 0.1 * alone) / 1.1, atol=2e-3)


@pytest.mark.parametrize("friction", [(0.4, 0.8), (0.7, 0.75), (0.2, 0.6)])
def test_a_range_is_as_drawing_many_frictions(friction: tuple[float, float], rng: np.random.Generator):
    low, high = friction
    margin = np.diff(stats.norm.cdf(EDGES, 0.45, 0.2))[None] * EVEN
    margin /= margin.sum()
    ratio = ratio_about(0.3, 0.05)
    # drawn as the network answers, then weighed by how much likelier what is told makes the friction of each draw
    count = 400_000
    margins = rng.choice(MARGINS, count, p=margin[0]) + rng.uniform(-0.01, 0.01, count)
    ratios = rng.choice((RATIO_EDGES[1:] + RATIO_EDGES[:-1]) / 2, count, p=ratio[0]) + rng.uniform(-0.01, 0.01, count)
    frictions = ratios / (1 - margins)
    density = ((frictions > low) & (frictions < high)) / (high - low)
    expected_density = np.where((frictions > 0.15) & (frictions < 1.2), 1 / 1.05, 0.05 / 1.05)
    weights = density / expected_density
    alone = np.clip(1 - ratios / rng.uniform(low, high, count), 0, 1)
    expected = (np.mean(weights * margins) + 0.1 * alone.mean()) / (weights.mean() + 0.1)
    found = told(margin, ratio, Friction.between(low, high, values=400))
    # the mass of the bins is taken at their middles
    assert (found @ MARGINS)[0] == pytest.approx(expected, abs=0.01)


def test_a_network_of_two_answers_takes_friction(networks: dict[str, Network], images):
    trained = networks["margin-and-ratio"]
    untold, exact = trained.estimate(images), trained.estimate(images, friction=0.6)
    assert there(untold.ratio).probabilities.shape == (5, 80)
    low, high = there(exact.interval(0.9))
    assert np.all((low >= 0) & (high <= 1))
    assert str(exact.friction) == "0.6, exact"
    again = trained.estimate(images, friction="0.6")
    np.testing.assert_array_equal(exact.margin, again.margin)
    assert np.all((exact.margin >= 0) & (exact.margin <= 1))
    assert np.abs(exact.margin - untold.margin).max() > 1e-3


@pytest.mark.parametrize("head", ["point", "histogram"])
def test_a_network_of_one_answer_refuses_friction(head: str, networks: dict[str, Network], images):
    with pytest.raises(InputError, match=r"predicts the margin alone .*ratio`"):
        networks[head].estimate(images, friction=0.6)


@pytest.mark.parametrize(
    ("told", "doubted"), [(0.6, False), (5.0, True), (0.05, True), ((0.5, 1.5), False), ((0.5, 9.0), True)]
)
def test_friction_that_is_mostly_beyond_the_training_is_doubted(
    told: float | tuple[float, float], doubted: bool, networks: dict[str, Network]
):
    kept, friction = networks["margin-and-ratio"].manifest, as_friction(told)
    manifest = replace(kept, traction=replace(there(kept.traction), friction=tuple(TRAINED)))
    doubts = replace(networks["margin-and-ratio"], manifest=manifest).doubts(friction=friction)
    assert ["0.15 to 1.2" in words for words in doubts] == [True] * doubted
    assert networks["histogram"].doubts(friction=friction) == ()
