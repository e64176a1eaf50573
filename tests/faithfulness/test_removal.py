"""Removal curves against closed forms: a linear network, whose every pixel or marker counts for itself."""

from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from jaxtyping import Bool, Float
from torch import Tensor

from sliplens.errors import InputError, SaliencyError
from sliplens.explainers.occlusion import marker_regions, tile_regions
from sliplens.faithfulness import removal
from sliplens.faithfulness.fills import get_fill
from sliplens.faithfulness.removal import SHARES
from sliplens.models.engines import Engine
from sliplens.progress import reporting

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
    orders = np.stack(
        [[removal.unit_order(one, units, least_first=least) for one in values] for least in (False, True)]
    )
    answers = removal.removal_curves(linear(weights), images, orders, fill=get_fill("black"), areas=EVERY)
    lost = answers[..., :1] - answers
    for index, one in enumerate(values):
        falling = np.sort(one.ravel())[::-1]
        np.testing.assert_allclose(lost[0, index], np.append(0, np.cumsum(falling)), atol=1e-12)
        np.testing.assert_allclose(lost[1, index], np.append(0, np.cumsum(falling[::-1])), atol=1e-12)


def test_what_contributes_is_the_best_map_there_is(images: torch.Tensor, weights: torch.Tensor, rng):
    values = contributions(images, weights)
    units = [PIXELS] * IMAGES
    maps = {"truth": values, "noisy": values + rng.normal(0, values.std(), values.shape), "opposite": -values}
    scores = removal.score_maps(
        linear(weights), images, maps, units, fill=get_fill("black"), rng=rng, towards=UP, areas=EVERY
    )
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
    scores = removal.score_maps(linear(mixed), images, maps, units, towards=towards, **told)
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
    orders = np.stack([[removal.random_unit_order(PIXELS, rng=rng)] * IMAGES for _ in range(3)])

    def curves(fill: str, size: int) -> np.ndarray:
        engine = Engine(
            name="torch",
            batch_size=size,
            answers=lambda batches: ((linear(weights)(batch).sin(),) for batch in batches),
        )
        return removal.removal_curves(engine, images, orders, fill=get_fill(fill), seed=4)

    # noise is solved by iterations that stop when all of a batch are done: within their tolerance, times the weights
    for fill, tolerance in (("grey", 1e-12), ("noisy-linear", 1e-3)):
        for size in (7, 64):
            np.testing.assert_allclose(curves(fill, size), curves(fill, 1), atol=tolerance)


MAPS = arrays(np.float64, (6, 9), elements=st.floats(-1, 1))


def test_a_pixel_belongs_to_the_nearest_marker_or_to_none():
    centres = np.array([[2.0, 1.0], [7.0, 4.0]])  # x, y
    units = marker_regions((6, 9), torch.from_numpy(centres), radius_px=2.0).numpy()
    for row in range(6):
        for column in range(9):
            distance = np.hypot(centres[:, 0] - column, centres[:, 1] - row)
            assert units[row, column] == (distance.argmin() if distance.min() <= 2 else 2)
    with pytest.raises(InputError, match="two or more, and there are 0; choose tiles"):
        marker_regions((6, 9), torch.empty(0, 2), radius_px=2.0)


@given(MAPS, st.integers(1, 5), st.booleans())
def test_units_go_whole_and_in_the_order_of_their_means(values: np.ndarray, size: int, least_first: bool):
    units = tile_regions(values.shape, tile_px=size).numpy()
    order = removal.unit_order(values, units, least_first=least_first)
    assert sorted(order) == list(range(values.size))
    gone = units.ravel()[order]
    assert np.count_nonzero(np.diff(gone)) == units.max()  # each unit once, in one piece
    means = removal.unit_means(values, units)[gone]
    steps = np.diff(means)
    assert np.all(steps >= 0) if least_first else np.all(steps <= 0)


def test_a_random_order_takes_units_whole_and_any_of_them_first(rng: np.random.Generator):
    units = tile_regions((6, 6), tile_px=2).numpy()
    orders = [removal.random_unit_order(units, rng=rng) for _ in range(200)]
    for order in orders:
        assert sorted(order) == list(range(36))
        assert np.count_nonzero(np.diff(units.ravel()[order])) == 8
    # nine tiles: one of them never first in 200 orders has a chance of 9 (8/9)^200 = 5e-10
    assert {int(units.ravel()[order[0]]) for order in orders} == set(range(9))


def test_a_map_that_does_not_fit_is_refused():
    with pytest.raises(SaliencyError, match=r"the map to rank by has shape \(4, 4\) but its image is 6 x 6"):
        removal.unit_order(np.zeros((4, 4)), tile_regions((6, 6), tile_px=1).numpy())
    with pytest.raises(SaliencyError, match="NaN or infinity in 36 of 36 pixels"):
        removal.unit_order(np.full((6, 6), np.nan), tile_regions((6, 6), tile_px=1).numpy())


MARKERS = 40


class Toy:
    """A scene whose image is a row of markers, 1 where they are moved and 0 where they are put back."""

    def __init__(self, effects: np.ndarray) -> None:
        self.weights = torch.from_numpy(effects)
        self.drawn = 0

    def redraw(self, image: int, back: Bool[np.ndarray, "variants markers"]) -> Float[Tensor, "variants 3 1 columns"]:
        self.drawn += len(back)
        moved = torch.from_numpy(~back).double() * self.weights[image]
        return moved[:, None, None].expand(-1, 3, -1, -1)

    @staticmethod
    def predict(images: Tensor) -> Tensor:
        return images[:, 0, 0].sum(dim=1)


@pytest.fixture
def effects(rng) -> np.ndarray:
    """Positive: each marker that is put back lowers the answer."""
    return rng.uniform(0.1, 1, (IMAGES, MARKERS)) / MARKERS


def test_the_curve_is_the_sum_of_what_the_markers_did(effects, rng):
    toy = Toy(effects)
    found = removal.score_maps_by_marker(toy.predict, toy.redraw, {"truth": effects}, rng=rng, towards=UP)["truth"]
    np.testing.assert_array_equal(found.areas, SHARES)
    for image, one in enumerate(effects):
        falling = np.append(0, np.cumsum(np.sort(one)[::-1]))
        rising = np.append(0, np.cumsum(np.sort(one)))
        counts = [round(share * MARKERS) for share in SHARES]
        np.testing.assert_allclose(found.most_first[image], falling[counts], atol=1e-12)
        np.testing.assert_allclose(found.least_first[image], rising[counts], atol=1e-12)


def test_in_random_orders_the_answer_falls_evenly(effects, rng):
    toy = Toy(effects)
    found = removal.score_maps_by_marker(
        toy.predict, toy.redraw, {"truth": effects}, rng=rng, towards=UP, random_orders=400
    )["truth"]
    total = effects.sum(axis=1, keepdims=True)
    # the sum of some of 40 effects of deviation 0.26 / 40: at most 0.26 * sqrt(40) / 2 / 40, over 20 for 400 orders
    np.testing.assert_allclose(found.random, total * found.areas, atol=5 * 0.26 * np.sqrt(40) / 2 / 40 / 20)


def test_who_knows_more_gains_more(effects, rng):
    toy = Toy(effects)
    noisy = effects + rng.normal(0, effects.std(), effects.shape)
    maps = {"truth": effects, "noisy": noisy, "opposite": -effects, "flat": np.ones_like(effects)}
    found = removal.score_maps_by_marker(toy.predict, toy.redraw, maps, rng=rng, towards=UP)
    gain = {name: one.symmetric_gain for name, one in found.items()}
    assert np.all(gain["truth"] > gain["noisy"])
    assert np.all(gain["noisy"] > 0)
    np.testing.assert_allclose(gain["opposite"], -gain["truth"], atol=1e-12)
    # who tells nothing gains nothing, whatever the order in which ties fall
    np.testing.assert_array_equal(gain["flat"], 0)


def test_what_many_orders_ask_for_is_drawn_once(effects, rng):
    toy = Toy(effects)
    removal.score_maps_by_marker(
        toy.predict, toy.redraw, {"one": effects, "same": 2 * effects}, rng=rng, towards=UP, random_orders=1
    )
    # nothing back, all back, and each inner step of most first, least first and one random order
    assert toy.drawn == IMAGES * (2 + 3 * (len(SHARES) - 2))


def test_progress_is_told_in_images(effects, rng):
    toy, heard = Toy(effects), []
    with reporting(lambda *step: heard.append(step)):
        removal.score_maps_by_marker(toy.predict, toy.redraw, {"truth": effects}, rng=rng, towards=UP)
    assert heard == [(1, 3), (2, 3), (3, 3)]


def test_a_marker_without_influence_is_refused(effects, rng):
    toy = Toy(effects)
    effects[1, 2] = np.nan
    with pytest.raises(InputError, match="lime gives some marker no finite influence; leave out markers"):
        removal.score_maps_by_marker(toy.predict, toy.redraw, {"lime": effects}, rng=rng, towards=UP)


def test_a_scene_is_drawn_once_for_each_choice(effects, rng):
    toy = Toy(effects)
    answer = removal.answer_scenes(toy.predict, partial(toy.redraw, 1))
    back = rng.random((8, MARKERS)) < 0.5
    expected = (~back * effects[1]).sum(axis=1)
    np.testing.assert_allclose(answer(np.concatenate([back, back[::-1]])), [*expected, *expected[::-1]], atol=1e-12)
    assert toy.drawn == 8
    np.testing.assert_allclose(answer(back[3:5]), expected[3:5], atol=1e-12)
    assert toy.drawn == 8
