import numpy as np
import pytest
from matplotlib.figure import Figure

from sliplens.errors import SaliencyError
from sliplens.plots.saliency import overlay_saliency, plot_colour_bar, stretch_saliency


def test_overlay_has_the_size_of_its_picture(rng):
    picture = rng.integers(0, 256, (20, 30, 3)).astype(np.uint8)

    assert overlay_saliency(picture, rng.random((20, 30))).shape == (20, 30, 3)


def test_without_saliency_the_picture_shines_through_in_grey(rng):
    picture = rng.integers(0, 256, (8, 8, 3)).astype(np.uint8)

    shown = overlay_saliency(picture, np.zeros((8, 8)))

    assert np.all(np.ptp(shown, axis=-1) == 0)
    assert np.corrcoef(shown[..., 0].ravel(), (picture @ [0.299, 0.587, 0.114]).ravel())[0, 1] > 0.999


def test_saliency_colours_the_very_pixel_it_belongs_to():
    saliency = np.zeros((16, 16))
    saliency[3, 11] = 1.0

    shown = overlay_saliency(np.full((16, 16, 3), 128, dtype=np.uint8), saliency)

    coloured = np.argwhere(np.ptp(shown.astype(int), axis=-1) > 0)
    np.testing.assert_array_equal(coloured, [[3, 11]])


def test_colours_grow_lighter_with_saliency_over_a_dark_picture():
    value = np.linspace(0, 1, 64)[None]

    shown = overlay_saliency(np.zeros((1, 64, 3), dtype=np.uint8), value)

    assert np.all(np.diff((shown @ [0.299, 0.587, 0.114])[0]) > -1)


@pytest.mark.parametrize("saliency", [np.zeros((4, 5)), np.full((8, 8), np.nan)])
def test_map_that_does_not_fit_is_refused(saliency):
    with pytest.raises(SaliencyError):
        overlay_saliency(np.zeros((8, 8, 3), dtype=np.uint8), saliency)


def test_colour_bar_says_what_its_ends_mean():
    ax = plot_colour_bar(ax=Figure().subplots())

    assert "99.5th percentile" in ax.get_xlabel()
    assert ax.images[0].get_extent() == [0, 1, 0, 1]


def test_stretching_gives_the_upper_half_percent_full_colour_and_keeps_the_order():
    saliency = np.linspace(0, 0.5, 1000).reshape(20, 50)
    stretched = stretch_saliency(saliency)
    assert np.count_nonzero(stretched == 1) == 5
    assert (np.diff(stretched.ravel()) >= 0).all()


def test_stretching_leaves_an_empty_map_empty_and_shows_a_single_pixel():
    assert not stretch_saliency(np.zeros((20, 50))).any()
    dot = np.zeros((20, 50))
    dot[3, 4] = 0.1
    assert stretch_saliency(dot)[3, 4] == 1
