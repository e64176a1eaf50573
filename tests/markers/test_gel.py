"""The gel in a camera's frames: places that are known are found."""

import numpy as np
import pytest
from dots import draw_dots, make_grid

from sliplens.errors import ImageError
from sliplens.markers.gel import propose_profile
from sliplens.plots.figure import write_proposal
from sliplens.recordings.sensor import save_profile


def camera(gel: np.ndarray, *, at: tuple[int, int], size: tuple[int, int] = (240, 320)) -> np.ndarray:
    """Three frames of a dark camera with the gel at (left, top)."""
    frame = np.full((*size, 3), 10, dtype=np.uint8)
    left, top = at
    frame[top : top + gel.shape[0], left : left + gel.shape[1]] = gel
    return np.stack([frame] * 3)


@pytest.mark.parametrize(
    ("marker", "background", "kind"),
    [
        ((120, 20, 100), (212, 208, 128), "chromatouch"),
        ((30, 25, 20), (180, 170, 160), "gelsight-mini"),
        ((245, 245, 240), (110, 110, 105), "tactip"),
    ],
)
def test_gel_markers_and_their_kind_are_found(tmp_path, marker, background, kind):
    places = make_grid(columns=6, rows=6, pitch=24.0, at=(28.0, 28.0))
    gel = draw_dots(places, size=(176, 176), marker=marker, background=background)
    found = propose_profile(camera(gel, at=(90, 30)), name="tip")
    assert found.profile.markers == kind
    assert found.profile.camera_size_px == (320, 240)
    assert len(found.markers_px) == len(places)
    order = np.lexsort(found.markers_px.round().T)
    known = places + np.array([90, 30])
    np.testing.assert_allclose(found.markers_px[order], known[np.lexsort(known.T)], atol=0.5)
    # the crop is square, keeps every marker whole, and lies in the gel
    left, top, width, height = found.profile.crop_px or (0, 0, 0, 0)
    assert width == height
    assert np.all(found.markers_px - 5 > [left, top])
    assert np.all(found.markers_px + 5 < [left + width, top + height])
    assert min(left - 90, top - 30, 90 + 176 - left - width, 30 + 176 - top - height) >= -2
    assert found.profile.output_size((240, 320)) == (224, 224)
    assert found.spacing_px == pytest.approx(24 * 224 / width, rel=0.01)
    save_profile(found.profile, tmp_path / "tip.toml", notes=found.notes)
    assert "[" in (tmp_path / "tip.toml").read_text()
    write_proposal(found, tmp_path / "tip.png")
    assert (tmp_path / "tip.png").stat().st_size > 10_000


def test_a_gel_that_fills_the_frame_is_kept_whole_and_one_without_markers_has_none():
    rng = np.random.default_rng(0)
    frames = np.clip(150 + rng.normal(0, 2, (3, 120, 160, 3)), 0, 255).astype(np.uint8)
    found = propose_profile(frames, name="tip", size_px=None)
    assert (found.profile.crop_px, found.profile.resize_px, found.profile.markers) == (None, None, None)
    assert found.gel_px == (0, 0, 160, 120)
    assert np.isnan(found.spacing_px)


def test_black_frames_are_refused():
    with pytest.raises(ImageError, match="black"):
        propose_profile(np.zeros((3, 40, 40, 3), dtype=np.uint8), name="tip")


def test_dark_frames_of_a_starting_camera_are_not_taken_for_the_untouched_sensor():
    gel = draw_dots(make_grid(columns=6, rows=6, pitch=24.0, at=(28.0, 28.0)), size=(176, 176))
    frames = np.repeat(camera(gel, at=(90, 30)), 5, axis=0)
    frames[:4] //= 3
    assert propose_profile(frames, name="tip").profile.reference_frame == 4
