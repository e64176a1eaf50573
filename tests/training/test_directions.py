"""Directions of the pulls that a network is trained on, as its manifest keeps them."""

from dataclasses import replace

import pytest
from there import there

import sliplens as sl
from sliplens.recordings import Dataset, TrialInfo
from sliplens.simulation.nuisances import Nuisances
from sliplens.training.config import RECIPES
from sliplens.training.fitting import trained_directions

PLAIN = replace(RECIPES["default"], augmentation="none")


@pytest.fixture(scope="module", params=[90.0, 355.0])
def pulled(request: pytest.FixtureRequest) -> tuple[float, Dataset, tuple[TrialInfo, ...]]:
    """Direction of the pulls, within 15 degrees, and a data set of a few trials."""
    middle = request.param
    nuisances = Nuisances(shear_direction_deg=(middle - 15, middle + 15))
    data = sl.simulate(dry_trials=10, wet_trials=0, days=3, frames_per_trial=20, nuisances=nuisances)
    return middle, data, data.select(split="train")


def test_the_directions_are_those_of_the_training_trials(pulled: tuple[float, Dataset, tuple[TrialInfo, ...]]):
    middle, data, trials = pulled
    low, high = there(trained_directions(PLAIN, data, trials, None))
    # trials drawn from 30 degrees, a camera that is turned by 3, an estimate that errs by 12 in nine of ten frames and
    # by less in the mean of five, and the 10 degrees that are added at both ends
    assert 20 <= high - low <= 30 + 2 * (3 + 12 + 10)
    assert abs((middle - (low + high) / 2 + 180) % 360 - 180) < 15
    turned = there(trained_directions(replace(PLAIN, augmentation="default"), data, trials, None))
    assert turned[1] - turned[0] == pytest.approx(high - low + 2 * 5)  # degrees that it turns images by


def test_images_turned_by_any_angle_know_all_directions(pulled: tuple[float, Dataset, tuple[TrialInfo, ...]]):
    _, data, trials = pulled
    assert trained_directions(replace(PLAIN, augmentation="all-directions"), data, trials, None) == (0.0, 360.0)


def test_a_network_that_stays_as_it_is_keeps_its_directions(pulled: tuple[float, Dataset, tuple[TrialInfo, ...]]):
    _, data, trials = pulled
    start = sl.load("chromatouch-pair")
    start = replace(start, manifest=replace(start.manifest, pull_direction_deg=(10.0, 20.0)))
    assert trained_directions(RECIPES["ratio"], data, trials, start) == (10.0, 20.0)
    adapted = there(trained_directions(replace(RECIPES["adapt"], augmentation="none"), data, trials, start))
    assert adapted == trained_directions(PLAIN, data, trials, None)


@pytest.mark.parametrize("trials", [0, 2])
def test_too_few_trials_leave_the_directions_unknown(pulled: tuple[float, Dataset, tuple[TrialInfo, ...]], trials: int):
    _, data, some = pulled
    assert trained_directions(PLAIN, data, some[:trials], None) is None
