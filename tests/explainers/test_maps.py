import numpy as np
import pytest
import torch
from torch.nn import functional

from sliplens.explainers.attribution import pearson_r, spread, to_masks, top_overlap


@pytest.mark.parametrize("shape", [(1, 1), (7, 7), (5, 9), (112, 112)])
def test_percentiles_equal_numpys(shape, rng):
    maps = 5 + rng.normal(size=(3, *shape))
    low, high = np.quantile(maps, (0.001, 0.999), axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(to_masks(torch.from_numpy(maps)), np.clip((maps - low) / high, 0, 1), atol=1e-12)


@pytest.mark.parametrize("size", [(64, 64), (50, 37), (7, 5), (224, 225)])
def test_spread_keeps_the_total_of_signed_maps(size, rng):
    maps = torch.from_numpy(rng.normal(size=(2, 7, 5)))
    torch.testing.assert_close(spread(maps, size).sum(dim=(1, 2)), maps.sum(dim=(1, 2)))


def test_spread_is_plain_bilinear_where_the_sizes_divide(rng):
    maps = torch.from_numpy(rng.normal(size=(2, 7, 7)))
    plain = functional.interpolate(maps[None], size=(224, 224), mode="bilinear", align_corners=False)[0] / 32**2
    torch.testing.assert_close(spread(maps, (224, 224)), plain)


def test_mask_of_a_constant_or_an_all_negative_channel_is_empty():
    generator = torch.Generator().manual_seed(0)
    maps = torch.stack([torch.full((4, 4), 2.0), torch.zeros(4, 4), -1 - torch.rand(4, 4, generator=generator)])
    assert not to_masks(maps).any()


def test_mask_keeps_nan():
    maps = torch.ones(1, 3, 3)
    maps[0, 0, 0] = torch.nan
    assert bool(to_masks(maps).isnan().any())


def test_correlation_is_that_of_numpy_and_blind_to_scale(rng):
    one, other = (torch.from_numpy(rng.normal(size=(5, 7))) for _ in range(2))
    assert pearson_r(one, other) == pytest.approx(np.corrcoef(one.flatten(), other.flatten())[0, 1])
    assert pearson_r(one, 3 * one + 2) == pytest.approx(1)
    assert np.isnan(pearson_r(one, torch.zeros(5, 7)))


def test_overlap_counts_the_strongest_pixels_that_are_shared():
    one = torch.arange(20.0).reshape(4, 5)
    # of 20 pixels the strongest tenth are two, 18 and 19; the other map's are 19 and 0
    other = torch.where(one == 0, 50.0, one)
    assert top_overlap(one, other) == 0.5
    assert top_overlap(one, one) == 1
    assert top_overlap(one, -one) == 0
    assert top_overlap(one, other, share=1.0) == 1
