"""Scenes drawn anew: what is put back changes, what is left alone does not, to the byte."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from realism.scene import film_of
from simulated_data import simulate_recipe

from sliplens.errors import InputError
from sliplens.files import output_folder
from sliplens.recordings import Dataset, Recording
from sliplens.simulation import CHROMATOUCH, FLAT_GEL, PRESETS, Nuisances, SimulationRecipe
from sliplens.simulation.filming import Film
from sliplens.simulation.nuisances import Day, Grasp
from sliplens.simulation.plan import read_recipe
from sliplens.simulation.trials import put_markers_back, rebuild_trial

RECIPE = SimulationRecipe(dry_trials=3, wet_trials=1, frames_per_trial=24, seed=5)


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Dataset:
    return simulate_recipe(tmp_path_factory.mktemp("simulated") / "data", RECIPE)


@pytest.fixture(scope="module")
def recordings(data: Dataset) -> list[Recording]:
    return [data.load(info) for info in data.trials]


@pytest.fixture(scope="module")
def films(data: Dataset, recordings: list[Recording]) -> list[Film]:
    return [rebuild_trial(data.folder, recording) for recording in recordings]


def nobody(film: Film, variants: int = 1) -> np.ndarray:
    return np.zeros((variants, len(film.marker_rest_px)), dtype=bool)


def in_pull(recording: Recording) -> int:
    return int(np.nanargmin(np.abs(recording.safety_margin - 0.4)))


def test_with_no_marker_put_back_a_frame_has_the_stored_bytes(films, recordings):
    for film, recording in zip(films, recordings, strict=True):
        for frame in (0, in_pull(recording), len(film) - 1):
            drawn = put_markers_back(film, frame, nobody(film, 5)).draw_all()
            np.testing.assert_array_equal(drawn, np.broadcast_to(recording.frames[frame], drawn.shape))


def test_markers_moved_to_where_they_are_change_no_byte(films, recordings):
    for film, recording in zip(films, recordings, strict=True):
        frame, all_markers = in_pull(recording), ~nobody(film)
        stored = recording.frames[frame]
        for back, to in ((all_markers, frame), (nobody(film), 0)):
            np.testing.assert_array_equal(put_markers_back(film, frame, back, to=to).draw_all()[0], stored)
        # moved elsewhere, they have the places and sizes of the other frame
        moved = put_markers_back(film, frame, all_markers, to=0)
        np.testing.assert_array_equal(moved.marker_px[0], film.marker_px[0])
        np.testing.assert_array_equal(moved.motion.scale[0], film.motion.scale[0])


@pytest.mark.parametrize("sensor", [CHROMATOUCH, FLAT_GEL])
def test_all_markers_back_and_no_touch_is_the_untouched_sensor(sensor):
    day = Day(camera_shift_px=(2.0, -1.0), camera_rotation_rad=0.02)
    film = film_of([0.3], grasp=Grasp(), sensor=sensor, day=day)
    changed = put_markers_back(film, 0, np.ones((1, sensor.geometry.markers), dtype=bool))
    nothing = np.zeros(1)
    motion = replace(changed.motion, touch=nothing, contact_radius_m=nothing, stick_radius_m=nothing)
    untouched = replace(changed, motion=replace(motion, indentation_m=nothing)).draw(slice(0, 1)).numpy()[0]
    np.testing.assert_array_equal(untouched, film.draw_reference().numpy())
    # the touch alone, its veil and sharper focus, is what is left of a frame whose markers are all put back
    assert np.any(changed.draw(slice(0, 1)).numpy()[0] != untouched)


def test_outlines_are_the_drawn_circles(films, recordings):
    film = films[0]
    rest, radius = film.outlines(None)
    scale = film.sensor.geometry.marker_scale() * film.unit.radius_factor
    np.testing.assert_allclose(radius, scale * max(film.sensor.look.radius_px))
    np.testing.assert_array_equal(rest, film.marker_rest_px)
    np.testing.assert_allclose(film.outlines(0)[1], radius)
    _, pressed = film.outlines(in_pull(recordings[0]))
    # the apex comes nearer and is squeezed, the rim of the dome does neither
    assert pressed[0] > 1.03 * radius[0]
    assert pressed[-1] == pytest.approx(radius[-1], rel=0.02)


@pytest.mark.parametrize(
    "recipe",
    [
        *PRESETS.values(),
        replace(RECIPE, sensor=FLAT_GEL, nuisances=Nuisances(dry_friction=(0.2, 0.9)), displacement="half-space"),
        replace(RECIPE, pulls="varied"),
        replace(RECIPE, frame_totals={"train": 40, "validation": 20, "test": 40}, release=True, test_days=1),
    ],
)
def test_a_recipe_comes_back_from_its_folder(recipe: SimulationRecipe, tmp_path: Path):
    with output_folder(tmp_path / "data", stage="simulate", config={"recipe": recipe.to_json()}):
        pass
    assert read_recipe(tmp_path / "data") == recipe


def test_a_folder_that_tells_no_recipe_needs_one(data: Dataset, recordings, tmp_path: Path):
    with pytest.raises(InputError, match=r"run\.json holds no recipe .*; choose a data set"):
        rebuild_trial(tmp_path, recordings[0])
    own = replace(RECIPE, sensor=replace(CHROMATOUCH, name="of my own"))
    with output_folder(tmp_path / "own", stage="simulate", config={"recipe": own}):
        pass
    with pytest.raises(InputError, match="holds no recipe"):
        read_recipe(tmp_path / "own")


def test_what_was_not_simulated_so_is_refused(data: Dataset, recordings):
    with pytest.raises(InputError, match=r"was simulated by another recipe, or by another version .*; simulate"):
        rebuild_trial(data.folder, replace(recordings[0], truth=replace(recordings[0].truth, recipe="another")))
    with pytest.raises(InputError, match="has no simulated truth and cannot be drawn again"):
        rebuild_trial(data.folder, replace(recordings[0], truth=None))
    frames = recordings[0].frames.copy()
    frames[-1, 100, 100] ^= 64
    with pytest.raises(InputError, match="is drawn differently from its stored frames"):
        rebuild_trial(data.folder, replace(recordings[0], frames=frames))
