"""A gripper that runs: it answers what it hears, is careful where it hears nothing, and grips anew what fell."""

from itertools import islice

import numpy as np
import pytest
from there import there

from sliplens.errors import InputError
from sliplens.grip.controllers import MarginLaw
from sliplens.grip.source import GripSource, GripStatus, open_reader
from sliplens.live.contract import LiveOptions, Pace
from sliplens.live.reading import Reading, SlipState

RATE_HZ = 30.0


@pytest.fixture
def source(monkeypatch: pytest.MonkeyPatch) -> GripSource:
    """A gripper that waits for nobody, and whose frames nobody has to look at."""
    monkeypatch.setattr(Pace, "wait", lambda *_: True)
    source = GripSource("cup", "margin", rate_hz=RATE_HZ)
    monkeypatch.setattr(source._tip, "draw", lambda *_, **__: source.reference)
    return source


def run(
    source: GripSource, frames, seconds: float, *, tells: bool = True, slip: SlipState | None = None
) -> list[GripStatus]:
    """Go on for a time; what is told is the true margin, as far as the fingertip is pressed."""
    course = []
    for frame in islice(frames, round(seconds * RATE_HZ)):
        course.append(there(source.status(frame.number)))
        if tells:
            # as a network that cannot tell friction reads it, counted from a zero of a half
            margin = None if frame.safety_margin is None else 0.5 + 0.5 * frame.safety_margin
            reading = Reading(number=frame.number, time_s=frame.time_s, captured_s=0.0, margin=margin, slip=slip)
            source.update_reading(reading)
    return course


def test_it_lifts_holds_at_the_margin_aimed_at_and_answers_more_weight(source: GripSource):
    frames = source.frames()
    light = run(source, frames, 8.0)
    assert list(dict.fromkeys(held.phase for held in light)) == ["open", "closing", "lifting", "holding"]
    source.act(water_kg=0.05)
    heavy = run(source, frames, 4.0)
    assert heavy[-1].least_force_n == pytest.approx(0.07 * 9.81 / (2 * 0.7), rel=1e-3)
    for held in (light[-1], heavy[-1]):
        # the dead band is 5 % of the force, and it is never loosened below 0.5 N
        aimed = max(held.least_force_n / (1 - MarginLaw.target), MarginLaw.least_n)
        assert held.force_n == pytest.approx(aimed, rel=0.08)
    assert heavy[-1].slip_m < 1e-3
    assert "aims at a margin" in heavy[-1].why


def test_it_is_careful_where_it_hears_nothing(source: GripSource):
    course = run(source, source.frames(), 5.0, tells=False)
    assert course[-1].force_n == pytest.approx(2.5, rel=0.02)
    assert course[-1].why.startswith("no margin:")


def test_skin_that_springs_back_as_the_grip_is_loosened_is_no_slip(source: GripSource):
    frames = source.frames()
    run(source, frames, 2.8)  # lifted with 2 N, far more than it needs
    course = run(source, frames, 1.0, slip=SlipState.SLIP)
    assert np.all(np.diff([held.force_n for held in course]) < 0.05)


def test_what_fell_is_gripped_anew(source: GripSource):
    frames = source.frames()
    source.act(controller="reflex", water_kg=0.05)
    run(source, frames, 4.0)
    source.act(wet=True, pull_n=1.0)
    phases = [held.phase for held in run(source, frames, 4.0)]
    assert list(dict.fromkeys(phases))[:4] == ["holding", "dropped", "open", "closing"]
    source.act(wet=False, pull_n=0.0)
    source.grip_again()
    phases = [held.phase for held in run(source, frames, 5.0)]
    assert list(dict.fromkeys(phases)) == ["open", "closing", "lifting", "holding"]


@pytest.mark.parametrize("told", [{"water_kg": -0.1}, {"pull_n": np.inf}, {"controller": "magic"}])
def test_what_cannot_be_done_is_refused(source: GripSource, told):
    with pytest.raises(InputError, match=r"must be 0 or more|there is no controller named 'magic'"):
        source.act(**told)


def test_a_gripper_is_named_with_what_it_holds():
    assert open_reader("grip:egg", options=LiveOptions(rate_hz=10.0)).source.name == "a simulated gripper (egg)"
    for name, options, error in (
        ("grip:anvil", LiveOptions(), "there is no object named 'anvil'"),
        ("grip", LiveOptions(speed=2.0), "the simulated gripper takes no --speed"),
        ("gripper.mp4", LiveOptions(speed=2.0), "gripper.mp4 is no source"),
    ):
        with pytest.raises(InputError, match=error):
            open_reader(name, options=options)


@pytest.mark.parametrize("name", ["simulated", "simulated:chromatouch", "grip", "grip:egg", "simulated:flat-gel", "0"])
def test_simulated_sensors_of_the_training_have_a_network(name: str):
    assert (open_reader(name).network is not None) == (name not in {"simulated:flat-gel", "0"})
