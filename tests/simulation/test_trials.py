from dataclasses import replace
from typing import cast

import numpy as np
import pytest
from realism.scene import film_of

from sliplens.errors import InputError
from sliplens.images import absolute_difference
from sliplens.progress import reporting
from sliplens.simulation import CHROMATOUCH, FLAT_GEL, SimulationRecipe, plan_trials, simulate_dataset, simulate_trial
from sliplens.simulation.nuisances import Grasp
from sliplens.simulation.sensor import FlatPad

PAD = cast("FlatPad", FLAT_GEL.geometry)
RECIPE = SimulationRecipe(dry_trials=3, wet_trials=1, frames_per_trial=30, seed=5)


@pytest.fixture(scope="module")
def recordings():
    return [simulate_trial(plan) for plan in plan_trials(RECIPE)]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return simulate_dataset(tmp_path_factory.mktemp("simulated") / "whole", replace(RECIPE, frames_per_trial=20))


@pytest.mark.parametrize("sensor", [CHROMATOUCH, FLAT_GEL])
def test_without_load_a_frame_is_the_reference_frame(sensor):
    film = film_of([np.nan], grasp=Grasp(), sensor=sensor)
    np.testing.assert_array_equal(film.draw_all()[0], film.draw_reference())


def centred(sensor):
    lamps = tuple(replace(lamp, direction_deg=90.0) for lamp in sensor.lights)
    return replace(
        sensor,
        geometry=replace(sensor.geometry, centre_px=(111.5, 111.5)),
        # focus, lamps and their reflections know left from right
        look=replace(sensor.look, focus_tilt=(0.0, 0.0)),
        lights=lamps,
        glare=None,
    )


@pytest.mark.parametrize(
    ("sensor", "displacement"),
    [(CHROMATOUCH, "calibrated"), (CHROMATOUCH, "half-space"), (FLAT_GEL, "half-space")],
)
def test_a_mirrored_pull_gives_the_mirrored_image(sensor, displacement):
    left = Grasp(shear_direction_rad=np.radians(70), contact_offset=(0.05, 0.02), skin_grain=0.0)
    right = Grasp(shear_direction_rad=np.radians(110), contact_offset=(-0.05, 0.02), skin_grain=0.0)
    margins = [1.0, 0.5, 0.0]
    films = [
        film_of(margins, grasp=grasp, sensor=centred(sensor), displacement=displacement) for grasp in (left, right)
    ]
    seen, mirrored = (film.draw(slice(0, 3)).numpy() for film in films)
    assert np.max(absolute_difference(seen, seen[0])) > 50
    # single precision may round one level apart
    np.testing.assert_allclose(seen.astype(int), mirrored[:, :, ::-1].astype(int), atol=1)
    maps, twins = (film.contact_map(slice(0, 3)) for film in films)
    # a pixel on the very edge may fall on either side
    assert np.mean(maps != twins[:, :, ::-1]) < 1e-3


def test_frames_do_not_depend_on_which_are_drawn_together():
    film = film_of(np.linspace(1, 0, 23), grasp=Grasp(blur_px=0.5), noise=True)
    together = film.draw(slice(0, 23)).numpy()
    for start, stop in ((0, 1), (5, 6), (22, 23), (3, 10)):
        np.testing.assert_array_equal(film.draw(slice(start, stop)).numpy(), together[start:stop])


def test_contact_map_has_the_areas_of_contact_and_stick_zone():
    film = film_of([np.nan, 1.0, 0.5, 0.2, 0.0], grasp=Grasp(contact_offset=(0.0, 0.0)), sensor=FLAT_GEL)
    maps = film.contact_map(slice(0, 5))
    assert not maps[0].any()
    assert np.all(maps[1] != 1)
    assert np.all(maps[4] != 2)
    stick, contact = (maps == 2).sum(axis=(1, 2))[1:], (maps > 0).sum(axis=(1, 2))[1:]
    # counting pixels of a circle of radius r errs by some r^(2/3): less than 1 % of areas this large
    np.testing.assert_allclose(stick / contact, np.array([1.0, 0.5, 0.2, 0.0]) ** (2 / 3), atol=0.01)
    contact_m = film.motion.contact_radius_m[1]
    depth_m = contact_m**2 / PAD.ball_radius_m / 2
    radius_px = contact_m * PAD.focal_px / (PAD.camera_distance_m - depth_m)
    np.testing.assert_allclose(contact, np.pi * radius_px**2, rtol=0.01)


def test_a_flank_that_leans_towards_a_lamp_brightens():
    lamp = replace(FLAT_GEL.lights[0], direction_deg=0.0, share=(1.0, 1.0, 1.0))
    sensor = replace(FLAT_GEL, lights=(lamp,), look=replace(FLAT_GEL.look, contrast=(0.0, 0.0, 0.0)), vignette=0.0)
    film = film_of([1.0], grasp=Grasp(contact_offset=(0.0, 0.0)), sensor=sensor)
    change = film.draw_all()[0].astype(int) - film.draw_reference().numpy()
    edge = round(film.motion.contact_radius_m[0] * PAD.focal_px / PAD.camera_distance_m)
    assert np.all(change[111, 111 + edge - 2 : 111 + edge] > 10)
    assert np.all(change[111, 112 - edge : 114 - edge] < -10)


def test_every_frame_carries_its_truth(recordings):
    for plan, recording in zip(plan_trials(RECIPE), recordings, strict=True):
        truth = recording.truth
        assert truth.recipe == RECIPE.hash
        assert truth.displacement == "calibrated"
        assert (recording.day, recording.condition) == (plan.day, plan.condition)
        assert truth.marker_px.shape == (30, CHROMATOUCH.geometry.markers, 2)
        touched = np.isfinite(recording.safety_margin)
        np.testing.assert_array_equal(truth.contact_radius_m > 0, touched)
        np.testing.assert_array_equal(truth.contact_map.any(axis=(1, 2)), touched)
        np.testing.assert_allclose(
            (truth.stick_radius_m[touched] / truth.contact_radius_m[touched]) ** 2,
            recording.stick_ratio[touched],
            atol=1e-12,
        )
        assert np.all(truth.marker_px[~touched] == truth.marker_rest_px)


@pytest.mark.parametrize("change", [{"frames_per_trial": 25}, {"frames_per_trial": 20, "seed": 6}])
def test_resuming_another_recipe_is_refused(dataset, change):
    with pytest.raises(InputError, match=r"day1-dry-001.parquet was made by another recipe; choose another folder"):
        simulate_dataset(dataset.folder, replace(RECIPE, **change))


def test_an_interrupted_data_set_resumes_to_the_same_bytes(dataset, tmp_path):
    recipe = replace(RECIPE, frames_per_trial=20)

    def interrupt(done, _):
        if done > 50:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), reporting(interrupt):
        simulate_dataset(tmp_path, recipe)
    assert len(list((tmp_path / "trials").glob("*.parquet"))) == 2
    assert not (tmp_path / "dataset.json").exists()
    resumed = simulate_dataset(tmp_path, recipe)
    assert resumed.hash == dataset.hash
