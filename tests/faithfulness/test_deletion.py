import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sliplens.errors import InputError, SaliencyError
from sliplens.faithfulness import (
    deletion_curves,
    deletion_images,
    deletion_order,
    deletion_score,
    get_fill,
    random_order,
    summarise_deletion,
)
from sliplens.faithfulness.deletion import deletion_steps, saliency_orders


def mean_of_pixels(images: torch.Tensor) -> torch.Tensor:
    return images.mean(dim=(1, 2, 3))


def test_the_most_salient_pixels_go_first():
    saliency = np.array([[0.1, 0.9], [0.5, 0.3]])
    assert deletion_order(saliency).tolist() == [1, 2, 3, 0]


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


def test_masked_images_are_the_image_where_pixels_stay_and_the_fill_where_they_go(rng: np.random.Generator):
    image, fill = torch.rand(3, 6, 5), torch.full((3, 6, 5), 0.5)
    order = random_order((6, 5), rng=rng)
    images = deletion_images(image, fill, order, pixels_removed=np.array([0, 7, 30]))
    assert torch.equal(images[0], image)
    assert torch.equal(images[2], fill)
    for flat in range(30):  # one pixel at a time, the slow way
        row, column = divmod(flat, 5)
        expected = fill if flat in order[:7] else image
        assert torch.equal(images[1, :, row, column], expected[:, row, column])


def test_curves_of_a_network_that_averages_pixels_have_a_closed_form(rng: np.random.Generator):
    # image of ones filled with black: the answer falls from 1 to 0 in a straight line whatever the order
    images = torch.ones(2, 3, 8, 8)
    orders = np.stack([random_order((8, 8), rng=rng) for _ in range(2)])
    curves = deletion_curves(mean_of_pixels, images, orders, fill=get_fill("black"))
    expected = 1 - np.arange(1, 9) / 8
    # means of 192 float32 numbers
    np.testing.assert_allclose(curves.predictions, np.stack([expected, expected]), atol=1e-6)
    np.testing.assert_allclose(curves.auc, np.mean(expected**2), atol=1e-6)


def test_the_chunk_size_does_not_change_the_curve(rng: np.random.Generator):
    images = torch.rand(2, 3, 8, 8)
    orders = np.stack([random_order((8, 8), rng=rng) for _ in range(2)])
    small, large = (
        deletion_curves(mean_of_pixels, images, orders, fill=get_fill("grey"), batch_size=size) for size in (3, 128)
    )
    np.testing.assert_allclose(small.predictions, large.predictions, atol=1e-6)


def test_the_summary_uses_the_population_standard_deviation():
    summary = summarise_deletion(np.array([0.1, 0.3]))
    assert summary.mean == pytest.approx(0.2)
    assert summary.sd == pytest.approx(0.1)
    with pytest.raises(InputError, match="no deletion curve to summarise"):
        summarise_deletion(np.array([]))


def test_a_map_of_another_shape_is_refused():
    with pytest.raises(SaliencyError, match=r"saliency map 0 has shape \(8, 9\) but its image is 8 x 8 pixels"):
        saliency_orders(np.zeros((1, 8, 9)), (8, 8))


def test_nan_in_a_map_is_refused():
    saliency = np.zeros((2, 8, 8))
    saliency[1, 0, 0] = np.nan
    with pytest.raises(SaliencyError, match="saliency map 1 holds NaN or infinity in 1 of 64 pixels"):
        saliency_orders(saliency, (8, 8))


@pytest.mark.parametrize(("name", "level"), [("grey", 0.5), ("black", 0.0), ("white", 1.0)])
def test_constant_fills(name: str, level: float):
    assert torch.equal(get_fill(name)(torch.rand(2, 3, 8, 8)), torch.full((2, 3, 8, 8), level))


def test_blurring_keeps_a_constant_image_and_wipes_out_a_dot():
    blur = get_fill("blur")
    constant = torch.full((1, 3, 40, 40), 0.3)
    torch.testing.assert_close(blur(constant), constant)  # a kernel that sums to 1
    dot = torch.zeros(1, 3, 40, 40)
    dot[..., 20, 20] = 1
    # peak of a Gaussian of 2 pixels: 1 / (2 pi 4), a little more for the cut tails
    assert blur(dot).max() < 1.1 / (2 * np.pi * 4)


def test_an_unknown_fill_lists_those_there_are():
    with pytest.raises(InputError, match="no fill named 'pink'; choose one of grey, black, white, blur"):
        get_fill("pink")
