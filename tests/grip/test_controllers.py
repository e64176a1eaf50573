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


@pytest.mark.parametrize("name", ["margin", "oracle"])
@pytest.mark.parametrize("least_n", [0.6, 1.2])
def test_a_law_comes_to_rest_at_the_margin_aimed_at(name, least_n, monkeypatch):
    monkeypatch.setattr("sliplens.grip.controllers._DEAD_BAND", 0.0)
    controller, force = make_controller(name, {"target": 0.25, "zero": 0.0}), 2.0
    for tick in range(240):  # 4 s of a margin of 1 - Q / (mu F), with Q / mu the least force
        margin = max(0.0, 1 - least_n / force)
        force = float(controller.command(seen(margin, force_n=force, time_s=LATE_S + tick * PERIOD_S))[0])
    assert force == pytest.approx(least_n / (1 - 0.25), rel=0.01)


def test_a_change_that_may_be_noise_is_followed_little_and_a_larger_one_at_once():
    controller = MarginLaw(zero=0.0)
    for margin, low, high in ((0.5, 0.499, 0.501), (0.53, 0.5, 0.515), (0.3, 0.299, 0.301)):
        controller.command(seen(margin))
        assert low < controller.acted[0] < high


def test_nothing_is_loosened_on_a_withheld_reading_and_blindness_ends_at_the_safe_force():
    controller, forces = make_controller("margin"), [1.0]
    controller.command(seen(0.5, time_s=LATE_S))
    for tick in range(1, 60):
        now = seen(np.nan, force_n=forces[-1], time_s=LATE_S + tick * PERIOD_S)
        forces.append(float(controller.command(now)[0]))
    assert np.all(np.diff(forces) >= 0)
    assert forces[6] == 1.0  # held for 0.15 s
    assert forces[-1] == pytest.approx(2.5)


@pytest.mark.parametrize("name", ["margin", "reflex"])
def test_a_slip_is_answered_at_once_and_not_loosened_after(name):
    controller = make_controller(name)
    force = float(controller.command(seen(0.9, force_n=1.5, slip=True))[0])
    assert force >= 1.5 * 1.5
    after = controller.command(seen(1.0, force_n=force, time_s=LATE_S + 0.1))[0]
    assert after >= force


def test_after_a_slip_what_was_read_there_counts_as_nothing_left():
    controller = MarginLaw(zero=0.0)
    for after_s, slip in ((0.0, False), (0.1, True)):
        controller.command(seen(0.6, slip=slip, time_s=LATE_S + after_s))
    again = controller.command(seen(0.6, time_s=LATE_S + 0.5))[0]
    # a margin of 0 asks for F / (1 - target), as far as the rate of 40 N/s allows
    assert again == pytest.approx(min(1 / (1 - controller.target), 1 + 40 * PERIOD_S))


def test_an_assumed_friction_presses_by_the_load_alone():
    controller = make_controller("assumed-friction", {"friction": 0.3, "target": 0.2})
    assert controller.command(seen(0.0))[0] == controller.command(seen(1.0))[0]
    assert controller.command(seen())[0] == pytest.approx(0.6 / (2 * 0.3 * 0.8))


@pytest.mark.parametrize("name", list(CONTROLLERS))
def test_every_controller_tells_a_force_for_each_episode(name):
    one = replace(seen(np.nan, time_s=0.0), true_margin=np.ones((1, 2)))
    arrays = {field: value for field, value in vars(one).items() if isinstance(value, np.ndarray)}
    many = replace(one, **{field: np.repeat(value, 7, axis=0) for field, value in arrays.items()})
    assert np.isfinite(make_controller(name).command(many)).tolist() == [True] * 7


@pytest.mark.parametrize(
    ("name", "settings", "told"),
    [
        ("magic", {}, "there is no controller named 'magic'; choose one of fixed"),
        ("fixed", {"gain": 1.0}, "controller fixed has no constant 'gain'; choose of force_n"),
        ("fixed", {"force_n": -1.0}, "force_n of the controller fixed must be a number not below 0, got -1"),
        ("margin", {"target": 1.0}, "give a target and a zero below 1"),
    ],
)
def test_a_wrong_controller_is_told_in_a_sentence(name, settings, told):
    with pytest.raises(InputError, match=told):
        make_controller(name, settings)
