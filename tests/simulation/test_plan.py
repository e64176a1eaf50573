from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplens.errors import ContactError, InputError
from sliplens.simulation import (
    FLAT_GEL,
    PRESETS,
    Nuisances,
    Pulls,
    SimulationRecipe,
    make_recipe,
    plan_trials,
)
from sliplens.simulation.nuisances import draw_grasp


@settings(max_examples=30, deadline=None)
@given(st.integers(3, 40), st.integers(0, 5), st.integers(2, 6), st.data())
def test_splits_are_disjoint_and_none_is_empty(dry, wet, days, data):
    test_day = data.draw(st.integers(2, days))
    plans = plan_trials(SimulationRecipe(dry_trials=dry, wet_trials=wet, days=days, test_day=test_day))
    assert len({plan.trial for plan in plans}) == len(plans) == dry + wet
    assert {plan.split for plan in plans} == {"train", "validation", "test"}
    assert {plan.day for plan in plans if plan.split == "test"} == {test_day}
    assert all(plan.split == "test" for plan in plans if plan.condition == "wet")
    assert any(plan.split == "test" and plan.condition == "dry" for plan in plans)


@settings(max_examples=30, deadline=None)
@given(st.integers(3, 40), st.integers(0, 9), st.integers(2, 9), st.data())
def test_several_days_may_test(dry, wet, days, data):
    test_days = data.draw(st.integers(1, days - 1))
    plans = plan_trials(SimulationRecipe(dry_trials=dry, wet_trials=wet, days=days, test_days=test_days))
    assert len({plan.trial for plan in plans}) == len(plans) == dry + wet
    assert {plan.split for plan in plans} == {"train", "validation", "test"}
    tested = range(days - test_days + 1, days + 1)
    assert all((plan.split == "test") == (plan.day in tested) for plan in plans)
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


def test_more_trials_leave_the_others_as_they_were():
    few, many = ({plan.trial: plan for plan in plan_trials(SimulationRecipe(dry_trials=count))} for count in (8, 20))
    for name, plan in few.items():
        assert replace(many[name], split=plan.split, recipe=plan.recipe, recipe_hash=plan.recipe_hash) == plan


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
    recipe = SimulationRecipe()
    assert recipe.hash == SimulationRecipe().hash
    others = (
        replace(recipe, seed=1),
        replace(recipe, release=True),
        replace(recipe, displacement="half-space"),
        replace(recipe, sensor=FLAT_GEL),
        replace(recipe, nuisances=Nuisances(gain=(1.0, 1.0))),
    )
    assert len({recipe.hash, *(other.hash for other in others)}) == 6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dry_trials": (2, 2)}, "dry_trials has 2 days but there are 4; give one number a day"),
        ({"dry_trials": (0, 2, 2, 2)}, "but the first day trains; give it more trials"),
        ({"dry_trials": (3, 0, 0, -1)}, "no day has fewer than 0 trials"),
        ({"displacement": "magic"}, "displacement is 'magic', which sensor chromatouch does not have; choose calib"),
        ({"sensor": FLAT_GEL, "displacement": "calibrated"}, "sensor flat-gel does not have; choose half-space"),
        ({"dry_trials": 2}, "dry_trials is 2, at least 3 is needed: training, validation and test need one each"),
        ({"wet_trials": -1}, "wet_trials is -1, at least 0"),
        ({"frames_per_trial": 5}, "frames_per_trial is 5, at least 20 is needed"),
        ({"days": 1}, "days is 1, at least 2 is needed: the test needs a day of its own"),
        ({"test_day": 1}, "test_day is 1, but the first of 4 days trains; choose a day from 2 to 4"),
        ({"test_days": 4}, "test_days is 4, but of 4 days the first trains"),
        ({"test_days": 0}, "test_days is 0, but of 4 days"),
        ({"test_days": 2, "test_day": 3}, "test_day tests alone; ask for fewer"),
        ({"validation_share": 1.0}, "validation_share must lie between 0 and 1, got 1"),
        ({"seed": -1}, "seed is -1, at least 0"),
    ],
)
def test_impossible_recipes_are_refused(change, message):
    with pytest.raises(InputError, match=message):
        SimulationRecipe(**change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"normal_force_n": (2.0, 0.5)},
            r"the range of normal_force_n is \(2.0, 0.5\); give a finite low, then a high",
        ),
        ({"dry_friction": (0.0, 1.0)}, "dry_friction must be positive, got 0; raise its lower end"),
        ({"marker_depth": (-0.1, 0.1)}, "marker_depth must not be negative, got -0.1; raise its lower end"),
        ({"kinetic_ratio": (0.8, 1.2)}, "kinetic_ratio must be at most 1, got 1.2; lower its upper end"),
    ],
)
def test_impossible_ranges_are_refused(change, message):
    with pytest.raises(ContactError, match=message):
        Nuisances(**change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"duration_s": (0.0, 8.0)}, r"the range of duration_s is \(0.0, 8.0\); give a positive low, then a high"),
        ({"let_back": (0.2, 1.2)}, "let_back must be at most 1, got 1.2; lower its upper end"),
        ({"most_events": 9}, "9 jerks of 0.1 s leave no time in a pull of 0.8 s; make pulls longer or jerks shorter"),
        ({"rate": 0.5}, "a rate of 1 or more, got 3 and 0.5"),
    ],
)
def test_impossible_pulls_are_refused(change, message):
    with pytest.raises(ContactError, match=message):
        Pulls(**change)
