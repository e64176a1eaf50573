import pytest
import torch
from quick import Linear

from sliplens.explainers.gradients import IntegratedGradients
from sliplens.explainers.occlusion import Occlusion, marker_regions


@pytest.fixture
def linear():
    return Linear(torch.randn(3, 12, 12, generator=torch.Generator().manual_seed(4), dtype=torch.float64) / 144)


@pytest.fixture
def small(images):
    return images[..., ::5, ::5][..., :12, :12].contiguous()


def test_a_pixel_of_a_linear_model_loses_what_it_adds(linear, small):
    occluded = Occlusion(tile_px=1)(linear, small, reference=small[0])
    expected = (linear.weights * (small - small[0])).sum(dim=1).detach().float()
    torch.testing.assert_close(occluded.relevance, expected, atol=1e-6, rtol=1e-5)
    integrated = IntegratedGradients()(linear, small, reference=small[0])
    torch.testing.assert_close(occluded.relevance, integrated.relevance, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("tile_px", [5, 7, 100])  # none divides 12
def test_tiles_are_replaced_one_by_one(tile_px, network, small):
    model = network("gap")
    occluded = Occlusion(tile_px=tile_px)(model, small[:1], reference=small[1])
    expected = torch.zeros(12, 12)
    with torch.no_grad():
        for row in range(0, 12, tile_px):
            for column in range(0, 12, tile_px):
                tile = (slice(row, row + tile_px), slice(column, column + tile_px))
                changed = small[:1].clone()
                changed[0, :, *tile] = small[1, :, *tile]
                expected[tile] = float(model(small[:1]) - model(changed)) / expected[tile].numel()
    torch.testing.assert_close(occluded.relevance[0], expected, atol=1e-8, rtol=1e-5)


def test_markers_of_a_linear_model_add_up(linear, small):
    markers = torch.tensor([[2.0, 2.0], [9.0, 3.0], [5.0, 9.0]])
    occluded = Occlusion(markers_px=markers)(linear, small)
    torch.testing.assert_close(occluded.relevance.sum(dim=(1, 2)), occluded.change, atol=1e-6, rtol=1e-5)
    for region in marker_regions((12, 12), markers).unique():
        inside = marker_regions((12, 12), markers) == region
        assert float(occluded.relevance[0][inside].std()) < 1e-7
