"""Laws of the controllers: the force each formula asks for, and what every one of them owes a grip."""

from dataclasses import replace

import numpy as np
import pytest

from sliplens.errors import InputError
from sliplens.grip.controllers import CONTROLLERS, MarginLaw, Observation, make_controller
from sliplens.grip.plant import PERIOD_S

LATE_S = 2.0
"""After the lift."""


def seen(margin: float = 0.5, *, force_n: float = 1.0, time_s: float = LATE_S, slip: bool = False) -> Observation:
    both = np.full((1, 2), margin)
    return Observation(
        time_s=time_s,
        force_n=np.array([force_n]),
        command_n=np.array([force_n]),
        load_n=np.array([0.6]),
        margin=both,
        low=both - 0.2,
        slip=np.array([slip]),
        true_margin=both,
    )


def settle(controller, *, load_over_friction_n: float, seconds: float = 4.0) -> float:
    """Force at which a controller comes to rest where the margin is 1 - Q / (mu F), Q / mu in newtons, read exactly."""
    force = 2.0
    for tick in range(round(seconds / PERIOD_S)):
        margin = max(0.0, 1 - load_over_friction_n / force)
        force = float(controller.command(seen(margin, force_n=force, time_s=LATE_S + tick * PERIOD_S))[0])
    return force


@pytest.mark.parametrize("name", ["margin", "oracle"])
@pytest.mark.parametrize("least_n", [0.6, 1.2])
def test_a_law_comes_to_rest_at_the_margin_aimed_at(name, least_n, monkeypatch):
    monkeypatch.setattr("sliplens.grip.controllers._DEAD_BAND", 0.0)
    settings = {"target": 0.25, "zero": 0.0}
    force = settle(make_controller(name, settings), load_over_friction_n=least_n)
    assert force == pytest.approx(least_n / (1 - 0.25), rel=0.01)


def test_a_change_that_may_be_noise_is_followed_little_and_a_larger_one_at_once():
    controller, acted = MarginLaw(zero=0.0), []
    for read in (0.5, 0.53, 0.3):
        controller.command(seen(read))
        acted.append(float(controller.acted[0]))
    assert acted[0] == pytest.approx(0.5)
    assert 0.5 < acted[1] < 0.515
    assert acted[2] == pytest.approx(0.3)


def test_nothing_is_loosened_on_a_withheld_reading_and_blindness_ends_at_the_safe_force():
    controller = make_controller("margin")
    force, blind = 1.0, np.full((1, 2), np.nan)
    controller.command(seen(0.5, time_s=LATE_S))
    told = []
    for tick in range(1, 60):
        now = replace(seen(force_n=force, time_s=LATE_S + tick * PERIOD_S), margin=blind, low=blind)
        force = float(controller.command(now)[0])
        told.append(force)
    assert np.all(np.diff(told) >= 0)
    assert told[5] == 1.0  # held for 0.15 s
    assert told[-1] == pytest.approx(2.5)


@pytest.mark.parametrize("name", ["margin", "reflex"])
def test_a_slip_is_answered_at_once_and_not_loosened_after(name):
    controller = make_controller(name)
    force = float(controller.command(seen(0.9, force_n=1.5, slip=True))[0])
    assert force >= 1.5 * 1.5
    after = controller.command(seen(1.0, force_n=force, time_s=LATE_S + 0.1))[0]
    assert after >= force


def test_after_a_slip_what_was_read_there_counts_as_nothing_left():
    controller, told = MarginLaw(zero=0.0), 0.6
    controller.command(seen(told))
    controller.command(seen(told, slip=True, time_s=LATE_S + 0.1))
    again = controller.command(seen(told, time_s=LATE_S + 0.5))[0]
    # a margin of 0 asks for F / (1 - target), as far as the rate of 40 N/s allows
    assert again == pytest.approx(min(1 / (1 - controller.target), 1 + 40 * PERIOD_S))


def test_an_assumed_friction_presses_by_the_load_alone():
    controller = make_controller("assumed-friction", {"friction": 0.3, "target": 0.2})
    assert controller.command(seen(0.0))[0] == controller.command(seen(1.0))[0]
    assert controller.command(seen())[0] == pytest.approx(0.6 / (2 * 0.3 * 0.8))


@pytest.mark.parametrize("name", list(CONTROLLERS))
def test_every_controller_tells_a_force_for_each_episode(name):
    controller, many = make_controller(name), 7
    told = controller.command(
        Observation(
            time_s=0.0,
            force_n=np.ones(many),
            command_n=np.ones(many),
            load_n=np.ones(many),
            margin=np.full((many, 2), np.nan),
            low=np.full((many, 2), np.nan),
            slip=np.zeros(many, dtype=bool),
            true_margin=np.ones((many, 2)),
        )
    )
    assert told.shape == (many,)
    assert np.isfinite(told).all()


@pytest.mark.parametrize(
    ("name", "settings", "told"),
    [
        ("magic", {}, "there is no controller named 'magic'; choose one of fixed"),
        ("fixed", {"gain": 1.0}, "the controller fixed has no constant 'gain'; choose of force_n"),
        ("fixed", {"force_n": -1.0}, "force_n of the controller fixed must be a number not below 0, got -1"),
        ("margin", {"target": 1.0}, "give a target and a zero below 1"),
    ],
)
def test_a_wrong_controller_is_told_in_a_sentence(name, settings, told):
    with pytest.raises(InputError, match=told):
        make_controller(name, settings)
