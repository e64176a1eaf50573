import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sliplens.errors import InputError, SaliencyError
from sliplens.explainers.occlusion import marker_regions, tile_regions
from sliplens.faithfulness.removal import random_unit_order, unit_means, unit_order

MAPS = arrays(np.float64, (6, 9), elements=st.floats(-1, 1))


def test_tiles_cover_the_image_and_may_be_smaller_at_its_border():
    units = tile_regions((5, 7), tile_px=3).numpy()
    assert units.tolist()[0] == [0, 0, 0, 1, 1, 1, 2]
    assert units.tolist()[4] == [3, 3, 3, 4, 4, 4, 5]
    with pytest.raises(InputError, match="tiles of 0 pixels are impossible"):
        tile_regions((5, 7), tile_px=0).numpy()


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
    order = unit_order(values, units, least_first=least_first)
    assert sorted(order) == list(range(values.size))
    gone = units.ravel()[order]
    assert np.count_nonzero(np.diff(gone)) == units.max()  # each unit once, in one piece
    means = unit_means(values, units)[gone]
    steps = np.diff(means)
    assert np.all(steps >= 0) if least_first else np.all(steps <= 0)


@given(MAPS)
def test_single_pixels_go_by_their_value(values: np.ndarray):
    order = unit_order(values, tile_regions(values.shape, tile_px=1).numpy())
    np.testing.assert_array_equal(values.ravel()[order], np.sort(values.ravel())[::-1])


def test_a_random_order_takes_units_whole_and_any_of_them_first(rng: np.random.Generator):
    units = tile_regions((6, 6), tile_px=2).numpy()
    orders = [random_unit_order(units, rng=rng) for _ in range(200)]
    for order in orders:
        assert sorted(order) == list(range(36))
        assert np.count_nonzero(np.diff(units.ravel()[order])) == 8
    # nine tiles: one of them never first in 200 orders has a chance of 9 (8/9)^200 = 5e-10
    assert {int(units.ravel()[order[0]]) for order in orders} == set(range(9))


def test_a_map_that_does_not_fit_is_refused():
    with pytest.raises(SaliencyError, match=r"the map to rank by has shape \(4, 4\) but its image is 6 x 6"):
        unit_order(np.zeros((4, 4)), tile_regions((6, 6), tile_px=1).numpy())
    with pytest.raises(SaliencyError, match="NaN or infinity in 36 of 36 pixels"):
        unit_order(np.full((6, 6), np.nan), tile_regions((6, 6), tile_px=1).numpy())
