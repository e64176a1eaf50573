from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplens.errors import ContactError, InputError
from sliplens.simulation import FLAT_GEL, PRESETS, Nuisances, SimulationRecipe, make_recipe, plan_trials
from sliplens.simulation.filming import move_camera
from sliplens.simulation.nuisances import CameraSetup, Day, draw_grasp, mount_camera
from sliplens.simulation.trials import prepare_trial


@settings(max_examples=60, deadline=None)
@given(st.integers(3, 40), st.integers(0, 9), st.integers(2, 9), st.data())
def test_splits_are_disjoint_none_is_empty_and_the_days_asked_for_test(dry, wet, days, data):
    if data.draw(st.booleans()):
        test = {"test_day": data.draw(st.integers(2, days))}
        tested = range(test["test_day"], test["test_day"] + 1)
    else:
        test = {"test_days": data.draw(st.integers(1, days - 1))}
        tested = range(days - test["test_days"] + 1, days + 1)
    plans = plan_trials(SimulationRecipe(dry_trials=dry, wet_trials=wet, days=days, **test))
    assert len({plan.trial for plan in plans}) == len(plans) == dry + wet
    assert {plan.split for plan in plans} == {"train", "validation", "test"}
    assert all((plan.split == "test") == (plan.day in tested) for plan in plans)
    assert any(plan.split == "test" and plan.condition == "dry" for plan in plans)
    count = [sum(plan.day == day for plan in plans if plan.condition == "wet") for day in tested]
    assert sum(count) == wet
    assert max(count) - min(count) <= 1
    if dry >= days:
        assert {plan.day for plan in plans if plan.condition == "dry"} == set(range(1, days + 1))


@pytest.mark.parametrize("days", [4, 5, 6])
def test_every_day_between_validates_a_quarter_of_its_trials(days: int):
    for dry in ((100, *[40] * (days - 2), 11), 24 * days):
        plans = plan_trials(make_recipe("thesis", days=days, dry_trials=dry))
        for day in range(2, days):
            splits = [plan.split for plan in plans if plan.day == day]
            assert abs(splits.count("validation") - len(splits) / 4) <= 1
            assert set(splits) == {"train", "validation"}


def test_the_camera_of_the_thesis_preset_belongs_to_the_sensor():
    recipe = make_recipe("thesis", days=6, dry_trials=60)
    cameras = {plan.day: plan.day_draw for plan in plan_trials(recipe)}.values()
    shifts = np.array([camera.camera_shift_px for camera in cameras])
    turns = np.degrees([camera.camera_rotation_rad for camera in cameras])
    # days differ by twice the largest daily change at most, sensors by pixels and degrees
    assert np.ptp(shifts, axis=0).max() <= 2 * 0.15
    assert np.ptp(turns) <= 2 * 0.15
    assert len({tuple(shift) for shift in shifts}) == 6


def test_mounting_adds_seats_and_multiplies_light():
    day = Day(gain=1.1, gradient=0.02, gradient_direction_rad=0.0, camera_shift_px=(0.1, -0.1), glare=0.5)
    camera = CameraSetup(gain=0.9, gradient=0.2, gradient_direction_rad=np.pi, camera_shift_px=(1.0, 2.0), glare=0.8)
    mounted = mount_camera(day, camera)
    assert mounted.gain == pytest.approx(0.99)
    assert mounted.glare == pytest.approx(0.4)
    assert mounted.gradient == pytest.approx(0.18)
    assert mounted.camera_shift_px == pytest.approx((1.1, 1.9))
    assert mount_camera(day, CameraSetup()) == day


def test_a_moved_camera_turns_and_magnifies_markers_about_the_middle():
    _, film = prepare_trial(plan_trials(make_recipe("small"))[0])
    turned = move_camera(
        film, Nuisances(frame_turn_deg=(1.0, 1.0), frame_zoom=(1.02, 1.02)), rng=np.random.default_rng(0)
    )
    before, after = (one.marker_px - np.asarray(film.sensor.geometry.centre_px) for one in (film, turned))
    expected = 1.02 * np.exp(1j * np.radians(1.0)) * (before[..., 0] + 1j * before[..., 1])
    np.testing.assert_allclose(after[..., 0] + 1j * after[..., 1], expected)
    np.testing.assert_array_equal(turned.marker_rest_px, film.marker_rest_px)


def test_more_trials_leave_the_others_as_they_were():
    few, many = ({plan.trial: plan for plan in plan_trials(SimulationRecipe(dry_trials=count))} for count in (8, 20))
    for name, plan in few.items():
        assert replace(many[name], split=plan.split, recipe=plan.recipe) == plan


def test_presets_share_no_trial_no_sensor_and_no_day():
    plans = {
        (preset, seed): plan_trials(replace(recipe, seed=seed)) for preset, recipe in PRESETS.items() for seed in (0, 1)
    }
    seen = [{plan.seed for plan in own} | {plan.unit_seed for plan in own} for own in plans.values()]
    days = [{plan.day_draw for plan in own} for own in plans.values()]
    for groups in (seen, days):
        assert len(set().union(*groups)) == sum(map(len, groups))


@pytest.mark.parametrize("preset", PRESETS)
def test_in_every_preset_the_margin_cannot_be_read_from_the_normal_force(preset):
    # the recipe as it is, with more days and trials: correlations of a few would say little
    recipe = replace(PRESETS[preset], days=40, dry_trials=800, wet_trials=400, frame_totals=None)
    grasps = [
        draw_grasp(
            recipe.nuisances, day=plan.day_draw, wet=plan.condition == "wet", rng=np.random.default_rng(plan.seed)
        )
        for plan in plan_trials(recipe)
    ]
    force, friction = np.array([(grasp.normal_force_n, grasp.friction) for grasp in grasps]).T
    # 1200 independent pairs correlate by 0.029 (one standard deviation); 4 of them happen once in 16,000 draws
    assert abs(np.corrcoef(force, friction)[0, 1]) < 4 / np.sqrt(len(grasps))
    # nor do the mean and the spread of the friction change from light to firm grasps
    light, firm = friction[force < np.median(force)], friction[force >= np.median(force)]
    deviation = friction.std() * np.sqrt(2 / len(light))
    assert abs(light.mean() - firm.mean()) < 4 * deviation
    assert abs(light.std() - firm.std()) < 4 * deviation


def test_thesis_preset_has_the_frames_of_the_thesis():
    plans = plan_trials(PRESETS["thesis"])
    frames = {
        split: sum(plan.frames for plan in plans if plan.split == split) for split in ("train", "validation", "test")
    }
    assert frames == {"train": 128_043, "validation": 15_839, "test": 16_875}
    between = [plan for plan in plans if plan.day in (2, 3)]
    assert {plan.day for plan in plans} == {1, 2, 3, 4}
    assert {plan.split for plan in plans if plan.day == 1} == {"train"}
    assert sum(plan.split == "validation" for plan in between) == len(between) / 4
    assert {(plan.split, plan.condition) for plan in plans if plan.day == 4} == {("test", "dry"), ("test", "wet")}
    assert {plan.condition for plan in plans if plan.day != 4} == {"dry"}
    lengths = np.array([plan.frames for plan in plans])
    assert abs(lengths.mean() - 800) < 10
    assert lengths.min() >= 650
    assert lengths.max() <= 950


def test_recipes_have_the_same_hash_only_if_they_are_the_same():
    changes = {"seed": 1, "release": True, "displacement": "half-space", "sensor": FLAT_GEL}
    changes["nuisances"] = Nuisances(gain=(1.0, 1.0))
    hashes = {SimulationRecipe(**{name: value}).hash for name, value in changes.items()}
    assert len(hashes | {SimulationRecipe().hash, SimulationRecipe().hash}) == 6


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        (SimulationRecipe, {"dry_trials": (2, 2)}, "there are 4 days; give one number a day"),
        (SimulationRecipe, {"dry_trials": ()}, "there are 4 days; give one number a day"),
        (SimulationRecipe, {"dry_trials": (0, 2, 2, 2)}, "but the first day trains; give it more trials"),
        (SimulationRecipe, {"dry_trials": (1, 0, 0, 2)}, "but the first day trains; give it more trials"),
        (SimulationRecipe, {"dry_trials": (3, 0, 0, -1)}, "no day has fewer than 0 trials"),
        (SimulationRecipe, {"displacement": "magic"}, "but sensor chromatouch has calibrated and half-space"),
        (SimulationRecipe, {"sensor": FLAT_GEL, "displacement": "calibrated"}, "sensor flat-gel has half-space"),
        (SimulationRecipe, {"dry_trials": 2}, "dry_trials is 2, but at least 3 are needed"),
        (SimulationRecipe, {"wet_trials": -1}, "wet_trials is -1"),
        (SimulationRecipe, {"frames_per_trial": 5}, "frames_per_trial is 5, but at least 20"),
        (SimulationRecipe, {"days": 1}, "days is 1, but at least 2 are needed"),
        (SimulationRecipe, {"test_day": 1}, "test_day is 1, but choose from 2 to 4"),
        (SimulationRecipe, {"test_days": 4}, "test_days is 4, but of 4 days the first trains"),
        (SimulationRecipe, {"test_days": 0}, "test_days is 0, but of 4 days"),
        (SimulationRecipe, {"test_days": 2, "test_day": 3}, "test_day tests alone"),
        (SimulationRecipe, {"validation_share": 1.0}, "validation_share is 1.0, but it must lie between 0 and 1"),
        (SimulationRecipe, {"seed": -1}, "seed is -1"),
        (Nuisances, {"normal_force_n": (2.0, 0.5)}, "normal_force_n is .*; give a low, then a high, from"),
        (Nuisances, {"dry_friction": (0.0, 1.0)}, "dry_friction is .* from 1e-06 to"),
        (Nuisances, {"marker_depth": (-0.1, 0.1)}, "marker_depth is .* from 0 to 0.5"),
        (Nuisances, {"kinetic_ratio": (0.8, 1.2)}, "kinetic_ratio is .* to 1"),
        (Nuisances, {"gain": (0.9, np.inf)}, "gain is .* to 1e"),
        (SimulationRecipe, {"pulls": "sideways"}, "pulls is 'sideways', but choose steady or varied"),
    ],
)
def test_impossible_settings_are_refused(kind, change, message):
    with pytest.raises(ContactError if kind is not SimulationRecipe else InputError, match=message):
        kind(**change)
