import shutil
from dataclasses import replace

import numpy as np
import pytest

from sliplens.errors import ContactError, InputError
from sliplens.images import absolute_difference
from sliplens.mechanics import stick_ratio
from sliplens.recordings import ContactState
from sliplens.simulation import CHROMATOUCH, SimulationRecipe, plan_trials, simulate_dataset, simulate_trial
from sliplens.simulation.filming import film
from sliplens.simulation.loading import load_at_margins, load_grasp
from sliplens.simulation.nuisances import Day, Grasp, nominal_unit

RECIPE = SimulationRecipe(dry_trials=3, wet_trials=1, frames_per_trial=30, seed=5)
MARKERS = sum(CHROMATOUCH.ring_counts)


@pytest.fixture(scope="module")
def recordings():
    return [simulate_trial(plan) for plan in plan_trials(RECIPE)]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return simulate_dataset(tmp_path_factory.mktemp("simulated") / "whole", replace(RECIPE, frames_per_trial=20))


def clean_film(margins, *, grasp, sensor=CHROMATOUCH):
    return film(
        sensor,
        loading=load_at_margins(np.array(margins), grasp=grasp),
        grasp=grasp,
        day=Day(),
        unit=nominal_unit(MARKERS),
        rng=np.random.default_rng(0),
        noise=None,
    )


def test_without_load_a_frame_is_the_reference_frame():
    reference, frames = clean_film([np.nan], grasp=Grasp())
    np.testing.assert_array_equal(frames[0], reference)


def test_a_mirrored_pull_gives_the_mirrored_image():
    sensor = replace(CHROMATOUCH, centre_px=(111.5, 111.5))
    left = Grasp(shear_direction_rad=np.radians(70), contact_offset=(0.05, 0.02))
    right = Grasp(shear_direction_rad=np.radians(110), contact_offset=(-0.05, 0.02))
    _, seen = clean_film([1.0, 0.5, 0.0], grasp=left, sensor=sensor)
    _, mirrored = clean_film([1.0, 0.5, 0.0], grasp=right, sensor=sensor)
    assert np.max(absolute_difference(seen, seen[0])) > 50
    # single precision may round one level apart
    np.testing.assert_allclose(seen.astype(int), mirrored[:, :, ::-1].astype(int), atol=1)


def test_image_tells_more_pull_by_more_change():
    _, frames = clean_film([1.0, 0.8, 0.6, 0.4, 0.2, 0.0], grasp=Grasp())
    change = absolute_difference(frames, frames[0]).mean(axis=(1, 2, 3))
    assert np.all(np.diff(change) > 0)


def test_margins_are_those_of_the_forces(recordings):
    for recording in recordings:
        touched = recording.normal_force_n > 0
        capacity = recording.friction_coefficient[touched] * recording.normal_force_n[touched]
        np.testing.assert_allclose(
            recording.safety_margin[touched], 1 - recording.tangential_force_n[touched] / capacity, atol=1e-6
        )
        assert np.all(np.isnan(recording.safety_margin[~touched]))
        np.testing.assert_array_equal(recording.stick_ratio, stick_ratio(recording.safety_margin))


def test_margin_falls_through_the_pull_and_stays_at_zero():
    grasp = Grasp(kinetic_ratio=0.7, friction_drift=-0.15, normal_force_drift=0.05)
    for seed in range(20):
        loading = load_grasp(grasp, frames=400, rng=np.random.default_rng(seed))
        margin = loading.safety_margin[~np.isnan(loading.safety_margin)]
        assert np.all(np.diff(margin) <= 1e-12)
        assert margin[0] == 1
        assert np.all(margin[-20:] == 0)
        assert 0 < np.isnan(loading.safety_margin).mean() <= 0.1
        # evenly spread: each fifth of (0, 1) has between half and twice its share
        counts, _ = np.histogram(margin[(margin > 0) & (margin < 1)], bins=5, range=(0, 1))
        assert counts.min() > 0.1 * counts.sum()
        assert counts.max() < 0.4 * counts.sum()


def test_states_follow_the_margin(recordings):
    for recording in recordings:
        states = np.array(recording.contact_state)
        assert np.array_equal(states == ContactState.NO_CONTACT, np.isnan(recording.safety_margin))
        assert np.array_equal(states == ContactState.FULL_SLIP, recording.safety_margin == 0)
        assert np.array_equal(states == ContactState.CONTACT, recording.safety_margin == 1)
        assert set(states) == set(ContactState)


def test_same_plan_gives_the_same_bytes_whatever_else_runs(recordings):
    plan = plan_trials(RECIPE)[-1]
    again = simulate_trial(plan)
    assert again.frames.tobytes() == recordings[-1].frames.tobytes()
    assert again.reference.tobytes() == recordings[-1].reference.tobytes()


def test_different_trials_differ(recordings):
    assert len({recording.frames.tobytes() for recording in recordings}) == len(recordings)


def test_progress_is_told_in_frames():
    heard = []
    simulate_trial(plan_trials(RECIPE)[0], on_frames=lambda done, total: heard.append((done, total)))
    assert heard == [(16, 30), (30, 30)]


def test_resuming_skips_what_is_there_and_gives_the_same_bytes(dataset, tmp_path):
    shutil.copytree(dataset.folder, tmp_path / "part")
    recipe, heard = replace(RECIPE, frames_per_trial=20), []
    kept = tmp_path / "part" / "trials" / "day1-dry-001.parquet"
    stamp = kept.stat().st_mtime_ns
    (tmp_path / "part" / "trials" / "day4-wet-001.parquet").unlink()
    (tmp_path / "part" / "dataset.json").unlink()
    resumed = simulate_dataset(tmp_path / "part", recipe, on_trial=lambda done, total: heard.append((done, total)))
    assert kept.stat().st_mtime_ns == stamp
    assert [info.sha256 for info in resumed.trials] == [info.sha256 for info in dataset.trials]
    assert heard == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert len(dataset.select(split="test", condition="wet")) == 1


def test_resuming_another_recipe_is_refused(dataset):
    with pytest.raises(InputError, match="has 20 frames but the recipe asks for 25; choose another folder"):
        simulate_dataset(dataset.folder, replace(RECIPE, frames_per_trial=25))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: load_at_margins(np.array([80.0]), grasp=Grasp()), "give them as fractions, not in percent"),
        (lambda: load_grasp(Grasp(), frames=5, rng=np.random.default_rng(0)), "a trial of 5 frames cannot hold all"),
        (lambda: replace(CHROMATOUCH, camera_offset=1.5), "the camera lies 1.5 dome radii behind the centre"),
        (lambda: replace(CHROMATOUCH, focal_px_per_rad=0.0), "focal length must be positive, got 0"),
        (lambda: replace(CHROMATOUCH, ring_scale=(1.0,)), "has 6 rings but 1 marker sizes"),
    ],
)
def test_impossible_sensors_and_loads_are_refused(call, message):
    with pytest.raises(ContactError, match=message):
        call()
