"""Laws of the plant: momentum, friction's limits, closed forms, and commands that no gripper may follow."""

from dataclasses import replace

import numpy as np
import pytest

from sliplens.grip.plant import (
    GRAVITY_M_S2,
    LAG_S,
    OBJECTS,
    PERIOD_S,
    SHEAR_DAMPING_N_S_M,
    SHEAR_STIFFNESS_N_M,
    Plant,
    World,
)

CUP = OBJECTS["cup"]


def world(count: int = 1, *, mass_kg: float = 0.06, friction: float = 0.6, pull_n: float = 0.0) -> World:
    full = np.full(count, 1.0)
    return World(
        mass_kg=mass_kg * full,
        friction=np.full((count, 2), friction),
        kinetic_ratio=0.8 * full,
        pull_n=pull_n * full,
    )


def held_in_air(*, force_n: float, episodes: int = 1, substeps: int = 16) -> Plant:
    """Plant whose object hangs in the air between fingers that press already, all springs at rest."""
    plant, full = Plant(CUP, episodes=episodes, substeps=substeps), np.ones(episodes)
    anchor = np.full((episodes, 2), -1.0)  # the hand is at 0, and stays there for 0.5 s
    plant.state = replace(plant.state, force_n=force_n * full, height_m=full, anchor_m=anchor)
    return plant


def test_the_object_moves_by_the_momentum_that_the_forces_give():
    plant, mass = held_in_air(force_n=2.0, substeps=1), 0.06
    for _ in range(40):
        before = plant.state
        after = plant.step(np.array([2.0]), world(mass_kg=mass, pull_n=0.3), duration_s=1e-3)
        gained = mass * (after.speed_m_s - before.speed_m_s)
        assert gained == pytest.approx(1e-3 * (after.shear_n.sum(axis=1) - mass * GRAVITY_M_S2 - 0.3), abs=1e-12)


def test_a_step_of_load_answers_as_a_damped_spring_in_closed_form():
    plant, mass, substeps = held_in_air(force_n=4.0, substeps=512), 0.06, 60
    stiffness, damping = 2 * SHEAR_STIFFNESS_N_M, 2 * SHEAR_DAMPING_N_S_M
    rate, omega = damping / (2 * mass), np.sqrt(stiffness / mass)
    ringing = np.sqrt(omega**2 - rate**2)
    for number in range(1, substeps + 1):
        state = plant.step(np.array([4.0]), world(mass_kg=mass, friction=1.2), duration_s=1e-3)
        time_s = number * 1e-3
        shape = np.cos(ringing * time_s) + rate / ringing * np.sin(ringing * time_s)
        sunk = mass * GRAVITY_M_S2 / stiffness * (1 - np.exp(-rate * time_s) * shape)
        assert 1 - state.height_m[0] == pytest.approx(sunk, abs=2e-3 * mass * GRAVITY_M_S2 / stiffness)


def test_a_sliding_object_falls_with_what_kinetic_friction_leaves():
    plant, mass, force = held_in_air(force_n=0.5), 0.06, 0.5
    speeds = [plant.step(np.array([force]), world(mass_kg=mass, friction=0.3)).speed_m_s[0] for _ in range(6)]
    held = 2 * 0.8 * 0.3 * force  # kinetic friction of both fingers
    assert np.diff(speeds[2:]) / PERIOD_S == pytest.approx(held / mass - GRAVITY_M_S2, rel=1e-6)
    assert plant.state.sliding.all()
    assert plant.state.margin.max() == 0


@pytest.mark.parametrize("force_n", [0.0, 0.3, 1.0, 3.9])
def test_no_finger_carries_more_than_its_friction(force_n):
    plant, rng = held_in_air(force_n=force_n, episodes=20), np.random.default_rng(0)
    for _ in range(60):
        now = world(20, friction=0.5, pull_n=float(rng.uniform(-1, 2)))
        state = plant.step(np.full(20, force_n), now)
        # the skin's shear was checked against the force before its last change
        slack = plant.most_n_s * PERIOD_S / plant.substeps
        assert np.all(np.abs(state.shear_n) <= 0.5 * (state.force_n[:, None] + slack) + 1e-12)


def test_friction_only_takes_energy():
    plant, mass = held_in_air(force_n=0.6, substeps=256), 0.05

    def energy() -> float:
        state = plant.state
        stretch = -state.height_m[:, None] - state.anchor_m
        kinetic, weight = 0.5 * mass * state.speed_m_s**2, mass * GRAVITY_M_S2 * state.height_m
        return float((kinetic + weight + 0.5 * SHEAR_STIFFNESS_N_M * (stretch**2).sum(axis=1))[0])

    levels = []
    for _ in range(30):
        plant.step(np.array([0.6]), world(mass_kg=mass, friction=0.3), duration_s=2e-3)
        levels.append(energy())
    assert np.all(np.diff(levels) < 1e-7)


def test_the_force_follows_its_command_with_the_lag_and_no_faster_than_the_fingers_close(monkeypatch):
    for speed_m_s in (10.0, 1e-3):
        monkeypatch.setattr("sliplens.grip.plant.CLOSING_SPEED_M_S", speed_m_s)
        plant = Plant(CUP)
        for _ in range(3):
            plant.step(np.array([2.0]), world())
        # two fingers of 4 N/mm and the cup of 3 N/mm in a row
        limited_n = 3 * PERIOD_S * speed_m_s / (2 / 4_000 + 1 / 3_000)
        followed_n = 2 * (1 - np.exp(-3 * PERIOD_S / LAG_S))
        assert plant.state.force_n[0] == pytest.approx(min(followed_n, limited_n), rel=1e-9)


@pytest.mark.parametrize("command_n", [1e9, np.inf, -5.0, -np.inf])
def test_no_command_passes_ceiling_or_floor(command_n):
    plant = Plant(CUP)
    for _ in range(120):
        plant.step(np.array([command_n]), world())
    assert plant.state.force_n[0] == pytest.approx(plant.ceiling_n if command_n > 0 else 0, abs=1e-6)


def test_a_command_that_is_no_number_holds():
    plant = held_in_air(force_n=2.0)
    for _ in range(10):
        plant.step(np.array([np.nan]), world())
    assert plant.state.force_n[0] == pytest.approx(2.0, abs=0.02)


def test_a_dropped_object_stays_dropped_while_others_go_on():
    plant = held_in_air(force_n=2.0, episodes=2)
    now = replace(world(2), friction=np.array([[0.05, 0.05], [0.9, 0.9]]))
    for _ in range(40):
        plant.step(np.full(2, 2.0), now)
    fallen = plant.state
    assert fallen.dropped.tolist() == [True, False]
    after = plant.step(np.full(2, 3.0), now)
    assert after.height_m[0] == fallen.height_m[0]
    assert after.force_n[1] > fallen.force_n[1]
