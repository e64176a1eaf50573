from itertools import islice

import numpy as np
import pytest
from dots import draw_dots, make_grid

from sliplens.errors import ImageError, RecordingError
from sliplens.markers import MarkerStatus, Tracker, detect_markers, track_markers, tracker
from sliplens.recordings.source import open_source

KIND = {"chromatouch": "chromatouch", "flat-gel": "gelsight-mini"}


def never_wrong(tracks, truth, rest):
    """Followed markers lie where their own truth is; returns the marker of each track, and where it is well in view."""
    distance = np.linalg.norm(tracks.rest_px[:, None] - rest[None], axis=-1)
    assert np.all(distance.min(axis=1) < 1)
    own = distance.argmin(axis=1)
    places, (height, width) = truth[:, own], tracks.size
    assert np.all(np.linalg.norm(tracks.position_px - places, axis=-1)[tracks.followed] < 1)
    return own, np.all((places > 9) & (places < [width - 10, height - 10]), axis=-1)


@pytest.mark.parametrize("name", ["chromatouch", "flat-gel"])
def test_markers_are_followed_to_full_slip_and_back(name, trials):
    trial = trials[name]
    tracks = track_markers(trial.frames, trial.reference, KIND[name])
    _, inside = never_wrong(tracks, trial.truth.marker_px, trial.truth.marker_rest_px)
    assert tracks.followed.mean() > 0.9
    assert tracks.followed[inside].mean() > 0.995


def test_a_marker_that_goes_is_missing_and_comes_back_as_itself(rng):
    places = make_grid(jitter=0.5, rng=rng)
    frames = [draw_dots(np.delete(places + np.array([0.5 * step, 0]), 14, axis=0)) for step in range(1, 5)]
    tracks = track_markers([*frames, draw_dots(places + np.array([2.5, 0]))], draw_dots(places), "gelsight-mini")
    own = int(np.linalg.norm(tracks.rest_px - places[14], axis=1).argmin())
    np.testing.assert_array_equal(tracks.status[:, own], [MarkerStatus.MISSING] * 4 + [MarkerStatus.FOLLOWED])
    assert np.isnan(tracks.displacement_px[:4, own]).all()
    np.testing.assert_allclose(tracks.displacement_px[4, own], (2.5, 0), atol=0.1)
    assert np.all(np.delete(tracks.status, own, axis=1) == MarkerStatus.FOLLOWED)


def test_a_marker_that_changes_its_size_is_broken_and_has_no_displacement(rng):
    places, radius = make_grid(jitter=0.5, rng=rng), np.full(30, 5.0)
    radius[8] = 8.5
    tracks = track_markers([draw_dots(places, radius=radius)], draw_dots(places), "gelsight-mini")
    own = int(np.linalg.norm(tracks.rest_px - places[8], axis=1).argmin())
    assert tracks.status[0, own] in {MarkerStatus.BROKEN, MarkerStatus.MISSING}
    assert np.isnan(tracks.displacement_px[0, own]).all()
    assert np.delete(tracks.followed[0], own).all()


def test_a_marker_that_appears_is_left_out(rng):
    places = make_grid(jitter=0.5, rng=rng)
    tracks = track_markers([draw_dots(places)] * 5, draw_dots(np.delete(places, 14, axis=0)), "gelsight-mini")
    assert tracks.status.shape == (5, 29)
    assert tracks.followed.all()


@pytest.mark.parametrize("pitches", [0.6, 0.8, 1.0])
@pytest.mark.parametrize("jitter", [0.0, 0.5])
def test_a_jump_of_more_than_half_a_pitch_is_never_matched_wrongly(pitches, jitter, rng):
    places = make_grid(jitter=jitter, rng=rng)
    truth = np.stack([places + np.array([26.0 * pitches, 0]) + 0.2 * step for step in range(4)])
    never_wrong(track_markers(map(draw_dots, truth), draw_dots(places), "gelsight-mini"), truth, places)


@pytest.mark.parametrize("pitches", [0.6, 0.8, 1.0])
def test_a_printed_grid_that_fills_the_view_is_found_again_after_a_jump(pitches, rng):
    # it goes on beyond the view: only the print's small irregularities tell which marker is which
    places = make_grid(columns=12, rows=9, at=(-36.0, -32.0), jitter=0.5, rng=rng)
    truth = np.stack([places, *[places + np.array([26.0 * pitches, 0])] * 2])
    tracks = track_markers(map(draw_dots, truth), draw_dots(places), "gelsight-mini")
    _, inside = never_wrong(tracks, truth, places)
    assert tracks.followed[2][inside[2]].mean() > 0.95


def shows_again(tracks, truth, shown):
    """Markers that show again are followed within five frames under their own names; returns where each is in view."""
    own, inside = never_wrong(tracks, truth, truth[0])
    shown = shown[:, own]
    again = shown[1:] & ~shown[:-1]
    assert again.any()
    for at, marker in np.argwhere(again):
        assert tracks.followed[at + 1 : at + 6, marker].any() or not inside[at + 1 : at + 6, marker].all()
    return shown & inside


@pytest.mark.parametrize("reach_px", [60, 110])
def test_what_stands_plainly_is_followed_beside_a_heavy_object_from_the_border(reach_px, rng):
    rest = make_grid(columns=9, rows=7, pitch=22.0, at=(14.0, 14.0), jitter=0.5, rng=rng)
    course = []
    for depth in [0, 0.3, 0.7, 1, 1, 1, 0.5, 0, 0, 0, 0, 0]:
        edge = depth * reach_px  # of what lies on the gel, from the left
        places = rest + np.array([9.0, 0]) * depth * np.exp(-np.maximum(rest[:, :1] - edge, 0) / 40)
        seen = places[:, 0] > edge + 6
        frame = draw_dots(places[seen], noise=1.0, rng=rng)
        frame[:, : int(edge)] = (70, 75, 80)
        course.append((frame, places, seen))
    frames, truth, shown = map(np.array, zip(*course, strict=True))
    tracks = track_markers(frames, frames[0], "gelsight-mini")
    assert tracks.followed[shows_again(tracks, truth, shown)].mean() > 0.95


@pytest.mark.parametrize("pitches", [0.3, 1.6])
def test_after_a_knock_and_after_two_seconds_of_darkness_every_marker_has_its_name(pitches, rng):
    rest = make_grid(columns=9, rows=7, pitch=22.0, at=(14.0, 14.0), jitter=0.5, rng=rng)
    dark = 60 if pitches < 1 else 1  # a knock is blurred for a moment, and swings back
    after = [pitches, 0.4 * pitches, 0, 0, 0, 0] if pitches > 1 else [pitches] * 6
    truth = np.array([rest, *[rest] * dark, *[rest + np.array([22.0, 6.6]) * share for share in after]])
    night = [np.clip(rng.normal(4, 1.0, (160, 200, 3)), 0, 255).astype(np.uint8) for _ in range(min(dark, 3))]
    lit = [draw_dots(places, noise=1.0, rng=rng) for places in (rest, *truth[dark + 1 :])]
    tracks = track_markers(
        [lit[0], *(night[step % len(night)] for step in range(dark)), *lit[1:]], lit[0], "gelsight-mini"
    )
    shown = np.ones(truth.shape[:2], dtype=bool)
    shown[1 : 1 + dark] = False
    assert np.all(tracks.status[1 : 1 + dark] == MarkerStatus.LOST)
    shows_again(tracks, truth, shown)


def test_windows_around_the_last_places_give_what_a_search_of_every_frame_gives(trials, monkeypatch):
    trial = trials["chromatouch"]
    searched = []
    monkeypatch.setattr(
        tracker, "detect_markers", lambda *own, **named: searched.append(1) or detect_markers(*own, **named)
    )
    windows = track_markers(trial.frames, trial.reference, "chromatouch")
    assert len(searched) < 0.5 * len(trial.frames)
    monkeypatch.setattr(tracker, "_WHOLE_EVERY", 1)
    whole = track_markers(trial.frames, trial.reference, "chromatouch")
    assert np.mean(windows.status == whole.status) > 0.99
    both = windows.followed & whole.followed
    # a window that begins on another pixel weights the noise of 2 grey levels differently
    assert np.abs(windows.position_px - whole.position_px)[both].max() < 0.3


def test_what_cannot_be_followed_is_refused_in_one_sentence():
    reference = draw_dots(make_grid())
    with pytest.raises(ImageError, match="frame of 100 x 120 pixels against a reference of 160 x 200"):
        Tracker(reference, "gelsight-mini").update(np.zeros((100, 120, 3), dtype=np.uint8))
    with pytest.raises(RecordingError, match="there is no frame"):
        track_markers([], reference, "gelsight-mini")


@pytest.mark.real
def test_dots_of_a_real_gel_stay_where_they_are_while_nothing_moves(reference_folder):
    path = reference_folder / "gelsight_mini_slip" / "noslip" / "tennis_ball__exp_num_6" / "camera_0.avi"
    if not path.is_file():
        pytest.skip(f"the real clip is not at {path}")
    (clip,) = open_source(path)
    frames = list(islice(clip.read_frames(), 12))
    tracks = track_markers(frames[1:], frames[0], "gelsight-mini")
    assert len(tracks.rest_px) > 50
    assert tracks.followed.mean() > 0.99
    step = np.diff(tracks.position_px, axis=0)
    assert np.sqrt(np.nanmean(step**2)) < 0.15
