import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sliplens.errors import InputError
from sliplens.faithfulness.scoring import delete_pixels, deletion_score, deletion_steps


def mean_of_pixels(images: torch.Tensor) -> torch.Tensor:
    return images.mean(dim=(1, 2, 3))


@given(st.floats(0, 1), st.floats(0, 1))
def test_deletion_score_is_symmetric_and_one_where_nothing_changed(base: float, masked: float):
    one, other = np.array([base]), np.array([masked])
    score = deletion_score(one, other)
    assert score == deletion_score(other, one)
    assert deletion_score(one, one) == 1
    assert 0 <= score <= 1


def test_the_thesis_removes_224_pixels_at_each_of_224_steps():
    steps = deletion_steps((224, 224))
    np.testing.assert_array_equal(steps, 224 * np.arange(1, 225))


def test_impossible_numbers_of_steps_are_refused():
    with pytest.raises(InputError, match="deletion in 17 steps is impossible with 16 pixels; choose 1 to 16"):
        deletion_steps((4, 4), steps=17)


def test_so_many_pixels_of_an_order_are_gone(rng: np.random.Generator):
    order = rng.permutation(30)
    images = torch.rand(1, 3, 6, 5)
    seen: list[torch.Tensor] = []

    def look(batch: torch.Tensor) -> torch.Tensor:
        seen.extend(batch)
        return batch.mean(dim=(1, 2, 3))

    delete_pixels(look, images, order[None], fill="black", steps=30)
    for step, image in enumerate(seen[:30], start=1):
        for flat in range(30):  # one pixel at a time, the slow way
            row, column = divmod(flat, 5)
            expected = torch.zeros(3) if flat in order[:step] else images[0, :, row, column]
            assert torch.equal(image[:, row, column], expected)


def test_curves_of_a_network_that_averages_pixels_have_a_closed_form(rng: np.random.Generator):
    # image of ones filled with black: the answer falls from 1 to 0 in a straight line whatever the order
    images = torch.ones(2, 3, 8, 8)
    orders = np.stack([rng.permutation(64) for _ in range(2)])
    curves = delete_pixels(mean_of_pixels, images, orders, fill="black")
    expected = 1 - np.arange(1, 9) / 8
    # means of 192 float32 numbers
    np.testing.assert_allclose(curves[:, 1:], np.stack([expected, expected]), atol=1e-6)
    np.testing.assert_allclose(curves[:, 0], 1, atol=1e-6)
