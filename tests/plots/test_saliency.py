import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from sliplens.errors import SaliencyError
from sliplens.plots.saliency import full_colour, overlay_relevance, overlay_saliency, plot_colour_bar, stretch_saliency
from sliplens.plots.style import ORANGE, SKY


def test_overlay_has_the_size_of_its_picture(rng):
    picture = rng.integers(0, 256, (20, 30, 3)).astype(np.uint8)

    assert overlay_saliency(picture, rng.random((20, 30))).shape == (20, 30, 3)


def test_relevance_is_orange_below_zero_and_blue_above():
    relevance = np.zeros((4, 4), dtype=np.float32)
    relevance[0, 0], relevance[3, 3] = -0.2, 0.2

    painted = overlay_relevance(np.full((4, 4, 3), 100, dtype=np.uint8), relevance / full_colour(relevance))

    np.testing.assert_allclose(painted[0, 0] / 255, to_rgb(ORANGE), atol=1 / 255)
    np.testing.assert_allclose(painted[3, 3] / 255, to_rgb(SKY), atol=1 / 255)
    # where nothing happens the picture is grey
    assert len(set(painted[1, 1].tolist())) == 1


def test_relevance_of_another_size_is_laid_on_its_places():
    painted = overlay_relevance(np.zeros((8, 8, 3), dtype=np.uint8), np.array([[1.0, 0.0], [0.0, 0.0]]))

    assert painted[:4, :4].any(axis=-1).all()
    assert not painted[4:].any()
    assert not painted[:, 4:].any()


def test_the_full_colour_is_seen_however_few_pixels_speak():
    alone = np.zeros((100, 100))
    assert full_colour(alone) == 1
    alone[3, 4] = -0.01
    assert full_colour(alone) == 0.01


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
