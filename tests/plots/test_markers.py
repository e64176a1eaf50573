import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver

from sliplens.markers import interpolate_field
from sliplens.plots.markers import plot_arrows, plot_field


def test_arrows_start_at_rest_and_markers_without_a_displacement_have_none():
    places, ways = np.array([[5.0, 6.0], [20.0, 8.0]]), np.array([[1.0, 2.0], [np.nan, np.nan]])
    axes = plot_arrows(np.zeros((30, 40, 3), dtype=np.uint8), places, ways, ax=Figure().subplots())
    arrows = next(one for one in axes.collections if isinstance(one, Quiver))
    np.testing.assert_array_equal(arrows.get_offsets(), [[5.0, 6.0]])
    np.testing.assert_array_equal(np.stack([np.asarray(arrows.U), np.asarray(arrows.V)]), [[1.0], [2.0]])
    assert axes.get_xlabel() == "x (px)"
    # y runs down, as in the image
    assert axes.get_ylim() == (29.5, -0.5)


def test_a_field_is_coloured_by_its_length_and_a_still_one_has_no_streamlines():
    places = np.random.default_rng(0).uniform(0, 60, (30, 2))
    moving = interpolate_field(places, np.tile([3.0, 4.0], (30, 1)), size=(60, 60))
    axes = Figure().subplots()
    mappable = plot_field(moving, size=(60, 60), ax=axes)
    assert mappable.get_clim() == pytest.approx((0, 5), abs=1e-3)
    assert any(isinstance(one, LineCollection) for one in axes.collections)
    still = Figure().subplots()
    plot_field(interpolate_field(places, np.zeros((30, 2)), size=(60, 60)), size=(60, 60), ax=still)
    assert not still.collections
