import pytest
import torch

from sliplens.faithfulness.controls import CONTROLS, brightness, centre, edges


@pytest.mark.parametrize("name", CONTROLS)
def test_a_control_gives_a_finite_map_for_each_image(name: str):
    images = torch.rand(2, 3, 12, 15)
    maps = CONTROLS[name](images)
    assert maps.shape == (2, 12, 15)
    assert torch.isfinite(maps).all()
    assert (maps >= 0).all()


def test_edges_are_the_slope_of_a_plane_wherever_it_has_one():
    rows, columns = torch.arange(9.0)[:, None], torch.arange(11.0)
    images = (0.03 * columns + 0.04 * rows).expand(1, 3, 9, 11)
    inside = edges(images)[0, 1:-1, 1:-1]
    torch.testing.assert_close(inside, torch.full_like(inside, 0.05))  # 3, 4, 5
    assert edges(torch.full((1, 3, 9, 9), 0.7)).max() < 1e-6


def test_a_turned_image_has_turned_edges():
    images = torch.rand(1, 3, 8, 8)
    torch.testing.assert_close(edges(images.rot90(1, (2, 3))), edges(images).rot90(1, (1, 2)))


def test_brightness_is_the_mean_of_the_channels_and_the_centre_is_in_the_middle():
    images = torch.rand(2, 3, 9, 9)
    torch.testing.assert_close(brightness(images), images.mean(dim=1))
    bump = centre(images)[0]
    assert bump.flatten().argmax() == 4 * 9 + 4
    torch.testing.assert_close(bump, bump.flip(0))
    torch.testing.assert_close(bump, bump.T)
