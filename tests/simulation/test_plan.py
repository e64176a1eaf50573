from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplens.errors import ContactError, InputError
from sliplens.simulation import Nuisances, SimulationRecipe, plan_trials
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


def test_days_and_splits_follow_the_thesis():
    plans = plan_trials(SimulationRecipe(dry_trials=32, wet_trials=4))
    split = {day: [plan.split for plan in plans if plan.day == day] for day in (1, 2, 3, 4)}
    assert split[1] == ["train"] * 8
    assert split[4] == ["test"] * 12
    assert (split[2] + split[3]).count("validation") == 4
    assert (split[2] + split[3]).count("train") == 12


def test_names_say_day_condition_and_number():
    plans = plan_trials(SimulationRecipe(dry_trials=8, wet_trials=1))
    assert [plan.trial for plan in plans][-3:] == ["day4-dry-001", "day4-dry-002", "day4-wet-001"]


def test_more_trials_leave_the_others_as_they_were():
    few, many = ({plan.trial: plan for plan in plan_trials(SimulationRecipe(dry_trials=count))} for count in (8, 20))
    assert all(replace(many[name], split=plan.split) == plan for name, plan in few.items())


def test_every_trial_has_its_own_seed():
    plans = plan_trials(SimulationRecipe(dry_trials=60, wet_trials=20))
    assert len({plan.seed for plan in plans}) == len(plans)


def test_another_seed_gives_other_trials():
    one, other = (plan_trials(SimulationRecipe(seed=seed)) for seed in (0, 1))
    assert not {plan.seed for plan in one} & {plan.seed for plan in other}


def test_friction_does_not_depend_on_the_normal_force():
    plans = plan_trials(SimulationRecipe(dry_trials=3, wet_trials=1500))
    grasps = [
        draw_grasp(plan.nuisances, day=plan.day_draw, wet=True, rng=np.random.default_rng(plan.seed))
        for plan in plans
        if plan.condition == "wet"
    ]
    drawn = np.array([(grasp.friction, grasp.normal_force_n) for grasp in grasps])
    # 1500 independent pairs correlate by 0.026 on average
    assert abs(np.corrcoef(drawn.T)[0, 1]) < 0.09
    assert drawn[:, 0].min() >= 0.15
    assert drawn[:, 0].max() <= 0.7
    assert drawn[:, 1].min() >= 0.5
    assert drawn[:, 1].max() <= 2.0


def test_days_are_spread_over_the_range_of_friction():
    plans = plan_trials(SimulationRecipe(dry_trials=8, days=4))
    quarters = sorted(int((plan.day_draw.friction - 0.5) / 0.7 * 4) for plan in plans if plan.trial.endswith("dry-001"))
    assert quarters == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dry_trials": 2}, "dry_trials is 2, at least 3 is needed: training, validation and test need one each"),
        ({"wet_trials": -1}, "wet_trials is -1, at least 0"),
        ({"frames_per_trial": 5}, "frames_per_trial is 5, at least 20 is needed"),
        ({"days": 1}, "days is 1, at least 2 is needed: the test needs a day of its own"),
        ({"test_day": 1}, "test_day is 1, but the first of 4 days trains; name a day from 2 to 4"),
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
    ],
)
def test_impossible_ranges_are_refused(change, message):
    with pytest.raises(ContactError, match=message):
        Nuisances(**change)
