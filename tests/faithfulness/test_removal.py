"""Removal curves against closed forms: a linear network, whose every pixel counts for itself."""

import numpy as np
import pytest
import torch

from sliplens.explainers.occlusion import tile_regions
from sliplens.faithfulness.fills import get_fill
from sliplens.faithfulness.removal import lost_evidence, random_unit_order, removal_curves, score_maps, unit_order
from sliplens.models.engines import Engine

SIZE = 20
IMAGES = 3
PIXELS = tile_regions((SIZE, SIZE), tile_px=1).numpy()
EVERY = tuple(np.linspace(0, 1, SIZE * SIZE + 1))
UP = np.ones(IMAGES)


@pytest.fixture
def images() -> torch.Tensor:
    return torch.rand(IMAGES, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(5), dtype=torch.float64)


@pytest.fixture
def weights() -> torch.Tensor:
    """Positive: with a black fill each pixel that goes lowers the answer."""
    return torch.rand(3, SIZE, SIZE, generator=torch.Generator().manual_seed(6), dtype=torch.float64) / (3 * SIZE**2)


def linear(weights: torch.Tensor):
    return lambda batch: (batch * weights).sum(dim=(1, 2, 3))


def contributions(images: torch.Tensor, weights: torch.Tensor) -> np.ndarray:
    return (images * weights).sum(dim=1).numpy()


def test_the_curve_of_a_linear_network_is_the_sum_of_what_went(images: torch.Tensor, weights: torch.Tensor):
    values = contributions(images, weights)
    units = PIXELS
    orders = np.stack([[unit_order(one, units, least_first=least) for one in values] for least in (False, True)])
    lost = lost_evidence(removal_curves(linear(weights), images, orders, fill=get_fill("black"), areas=EVERY), UP)
    for index, one in enumerate(values):
        falling = np.sort(one.ravel())[::-1]
        np.testing.assert_allclose(lost[0, index], np.append(0, np.cumsum(falling)), atol=1e-12)
        np.testing.assert_allclose(lost[1, index], np.append(0, np.cumsum(falling[::-1])), atol=1e-12)


def test_what_contributes_is_the_best_map_there_is(images: torch.Tensor, weights: torch.Tensor, rng):
    values = contributions(images, weights)
    units = [PIXELS] * IMAGES
    maps = {"truth": values, "noisy": values + rng.normal(0, values.std(), values.shape), "opposite": -values}
    scores = score_maps(linear(weights), images, maps, units, fill=get_fill("black"), rng=rng, towards=UP, areas=EVERY)
    truth, noisy, opposite = (scores[name] for name in maps)
    assert np.all(truth.symmetric_gain > noisy.symmetric_gain)
    assert np.all(noisy.symmetric_gain > 0)
    # turned round, the curves change places
    np.testing.assert_allclose(opposite.symmetric_gain, -truth.symmetric_gain, atol=1e-12)
    # in every random order the answer falls evenly, on average: half of all that there is to lose
    total = values.sum(axis=(1, 2))
    # 20 orders of pixels whose contributions vary: standard error of each mean below total / sqrt(12 * 400 * 20)
    random = np.trapezoid(truth.random, truth.areas, axis=-1)
    np.testing.assert_allclose(random, total / 2, atol=5 * float(total.max()) / np.sqrt(12 * 400 * 20))
    # the two halves of the gain are the same for a linear network: what goes first on one side goes last on the other
    most, least = (np.trapezoid(curve, truth.areas, axis=-1) for curve in (truth.most_first, truth.least_first))
    np.testing.assert_allclose(most - total / 2, total / 2 - least, atol=1e-12)


def test_along_the_target_a_signed_map_is_scored_as_what_it_is(images: torch.Tensor, weights: torch.Tensor, rng):
    # both signs, and the sum below zero: the target lies below the untouched, black sensor
    mixed = weights - 0.7 * weights.mean() - 0.5 * weights.max()
    values = contributions(images, mixed)
    towards = np.sign(values.sum(axis=(1, 2)))
    assert np.all(towards == -1)
    units = [PIXELS] * IMAGES
    shuffled = values.reshape(IMAGES, -1).copy()
    half = rng.permutation(SIZE**2)[: SIZE**2 // 2]
    shuffled[:, half] = shuffled[:, rng.permutation(half)]
    maps = {"truth": -values, "half": -shuffled.reshape(values.shape)}
    told = {"fill": get_fill("black"), "rng": rng, "areas": EVERY, "random_orders": 2}
    scores = score_maps(linear(mixed), images, maps, units, towards=towards, **told)
    falling = -np.sort((-values).reshape(IMAGES, -1), axis=1)[:, ::-1]
    lost = np.concatenate([np.zeros((IMAGES, 1)), np.cumsum(-falling, axis=1)], axis=1)
    np.testing.assert_allclose(scores["truth"].most_first, lost, atol=1e-12)
    # a linear network loses evenly whatever the order of the rest: no order beats that of the contributions
    assert np.all(scores["truth"].symmetric_gain > scores["half"].symmetric_gain)
    assert np.all(scores["half"].symmetric_gain > 0)
    # at the end all that there was to explain is gone, whatever the map
    half = scores["half"]
    for curve in (half.most_first, half.least_first, half.random):
        np.testing.assert_allclose(curve[:, -1], -values.sum(axis=(1, 2)), atol=1e-12)


def test_the_batch_size_changes_nothing(images: torch.Tensor, weights: torch.Tensor, rng):
    orders = np.stack([[random_unit_order(PIXELS, rng=rng)] * IMAGES for _ in range(3)])

    def curves(fill: str, size: int) -> np.ndarray:
        engine = Engine(
            name="torch",
            batch_size=size,
            answers=lambda batches: ((linear(weights)(batch).sin(),) for batch in batches),
        )
        return removal_curves(engine, images, orders, fill=get_fill(fill), seed=4)

    # noise is solved by iterations that stop when all of a batch are done: within their tolerance, times the weights
    for fill, tolerance in (("grey", 1e-12), ("noisy-linear", 1e-3)):
        for size in (7, 64):
            np.testing.assert_allclose(curves(fill, size), curves(fill, 1), atol=tolerance)


def test_a_network_that_answers_always_alike_moves_by_nothing(images: torch.Tensor, rng):
    orders = np.stack([[random_unit_order(PIXELS, rng=rng)] * IMAGES])
    answers = removal_curves(lambda batch: torch.full((len(batch),), 0.3), images, orders, fill=get_fill("grey"))
    assert np.all(lost_evidence(answers, UP) == 0)
