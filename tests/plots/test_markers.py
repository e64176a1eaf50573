import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver

from sliplens.errors import InputError, SaliencyError
from sliplens.markers import interpolate_field, track_markers
from sliplens.plots.markers import (
    MarkedFrame,
    draw_fields_beside_saliency,
    plot_arrows,
    plot_field,
)

pytest.importorskip("cv2", reason="markers are found with OpenCV, of the extra `markers`")


@pytest.fixture(scope="module")
def tracked(trials):
    trial = trials["chromatouch"]
    return trial, track_markers(trial.frames, trial.reference, "chromatouch")


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


def test_frame_field_and_map_stand_side_by_side(tracked):
    trial, tracks = tracked
    field = interpolate_field(tracks.rest_px, tracks.displacement_px[10], size=(224, 224))
    rows = [MarkedFrame(title="10", frame=trial.frames[10], field=field, saliency=np.full((224, 224), 0.5))] * 2
    figure = draw_fields_beside_saliency(rows)
    assert len(figure.axes) == 2 * 3 + 2
    with pytest.raises(SaliencyError):
        draw_fields_beside_saliency(
            [MarkedFrame(title="10", frame=trial.frames[10], field=field, saliency=np.zeros((10, 10)))]
        )


def test_no_frame_is_refused():
    with pytest.raises(InputError, match="no frame to draw"):
        draw_fields_beside_saliency([])
