"""Markers put back one after another: closed forms for a network to which every marker counts for itself."""

from functools import partial

import numpy as np
import pytest
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sliplens.errors import InputError
from sliplens.faithfulness.removal import SHARES, answer_scenes, score_maps_by_marker
from sliplens.progress import reporting

IMAGES, MARKERS = 3, 40
UP = np.ones(IMAGES)


class Toy:
    """A scene whose image is a row of markers, 1 where they are moved and 0 where they are put back."""

    def __init__(self, weights: np.ndarray) -> None:
        self.weights = torch.from_numpy(weights)
        self.drawn = 0

    def redraw(self, image: int, back: Bool[np.ndarray, "variants markers"]) -> Float[Tensor, "variants 3 1 columns"]:
        self.drawn += len(back)
        moved = torch.from_numpy(~back).double() * self.weights[image]
        return moved[:, None, None].expand(-1, 3, -1, -1)

    @staticmethod
    def predict(images: Tensor) -> Tensor:
        return images[:, 0, 0].sum(dim=1)


@pytest.fixture
def weights(rng) -> np.ndarray:
    """Positive: each marker that is put back lowers the answer."""
    return rng.uniform(0.1, 1, (IMAGES, MARKERS)) / MARKERS


def test_the_curve_is_the_sum_of_what_the_markers_did(weights, rng):
    toy = Toy(weights)
    found = score_maps_by_marker(toy.predict, toy.redraw, {"truth": weights}, rng=rng, towards=UP)["truth"]
    np.testing.assert_array_equal(found.areas, SHARES)
    for image, one in enumerate(weights):
        falling = np.append(0, np.cumsum(np.sort(one)[::-1]))
        rising = np.append(0, np.cumsum(np.sort(one)))
        counts = [round(share * MARKERS) for share in SHARES]
        np.testing.assert_allclose(found.most_first[image], falling[counts], atol=1e-12)
        np.testing.assert_allclose(found.least_first[image], rising[counts], atol=1e-12)


def test_in_random_orders_the_answer_falls_evenly(weights, rng):
    toy = Toy(weights)
    found = score_maps_by_marker(toy.predict, toy.redraw, {"truth": weights}, rng=rng, towards=UP, random_orders=400)[
        "truth"
    ]
    total = weights.sum(axis=1, keepdims=True)
    # the sum of some of 40 weights of deviation 0.26 / 40: at most 0.26 * sqrt(40) / 2 / 40, over 20 for 400 orders
    np.testing.assert_allclose(found.random, total * found.areas, atol=5 * 0.26 * np.sqrt(40) / 2 / 40 / 20)


def test_who_knows_more_gains_more(weights, rng):
    toy = Toy(weights)
    noisy = weights + rng.normal(0, weights.std(), weights.shape)
    maps = {"truth": weights, "noisy": noisy, "opposite": -weights, "flat": np.ones_like(weights)}
    found = score_maps_by_marker(toy.predict, toy.redraw, maps, rng=rng, towards=UP)
    gain = {name: one.symmetric_gain for name, one in found.items()}
    assert np.all(gain["truth"] > gain["noisy"])
    assert np.all(gain["noisy"] > 0)
    np.testing.assert_allclose(gain["opposite"], -gain["truth"], atol=1e-12)
    # who tells nothing gains nothing, whatever the order in which ties fall
    np.testing.assert_array_equal(gain["flat"], 0)


def test_what_many_orders_ask_for_is_drawn_once(weights, rng):
    toy = Toy(weights)
    score_maps_by_marker(
        toy.predict, toy.redraw, {"one": weights, "same": 2 * weights}, rng=rng, towards=UP, random_orders=1
    )
    # nothing back, all back, and each inner step of most first, least first and one random order
    assert toy.drawn == IMAGES * (2 + 3 * (len(SHARES) - 2))


def test_progress_is_told_in_images(weights, rng):
    toy, heard = Toy(weights), []
    with reporting(lambda *step: heard.append(step)):
        score_maps_by_marker(toy.predict, toy.redraw, {"truth": weights}, rng=rng, towards=UP)
    assert heard == [(1, 3), (2, 3), (3, 3)]


def test_a_marker_without_influence_is_refused(weights, rng):
    toy = Toy(weights)
    weights[1, 2] = np.nan
    with pytest.raises(InputError, match="lime gives some marker no finite influence; leave out markers"):
        score_maps_by_marker(toy.predict, toy.redraw, {"lime": weights}, rng=rng, towards=UP)


def test_a_scene_is_drawn_once_for_each_choice(weights, rng):
    toy = Toy(weights)
    answer = answer_scenes(toy.predict, partial(toy.redraw, 1))
    back = rng.random((8, MARKERS)) < 0.5
    expected = (~back * weights[1]).sum(axis=1)
    np.testing.assert_allclose(answer(np.concatenate([back, back[::-1]])), [*expected, *expected[::-1]], atol=1e-12)
    assert toy.drawn == 8
    np.testing.assert_allclose(answer(back[3:5]), expected[3:5], atol=1e-12)
    assert toy.drawn == 8
