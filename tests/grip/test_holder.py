"""Laws of the holder: each margin counts with its own force, and the grip is never loosened blindly."""

from typing import Any

import numpy as np
import pytest
from constant_controller import Constant
from hypothesis import given
from hypothesis import strategies as st
from lying_gripper import CEILING_N, LIES, WIRE, hold

from sliplens.grip.controllers import CONTROLLERS, Holder, MarginLaw
from sliplens.grip.plant import PERIOD_S
from sliplens.live.reading import Reading, SlipState


def reading_of(
    margin: float | None, *, low: float | None = None, slip: SlipState | None = None, friction: str | None = None
):
    return Reading(number=0, time_s=0.0, captured_s=0.0, margin=margin, low=low, slip=slip, friction=friction)


def holder_of(controller, *, forces: np.ndarray | None = None, fingers: int = 1) -> tuple[Holder, float]:
    """Holder that has measured some forces, one a period, and the time now."""
    holder = Holder(controller, ceiling_n=4.0, fingers=fingers)
    forces = np.full(90, 2.0) if forces is None else forces
    for number, force_n in enumerate(forces):
        holder.grip_force(number * PERIOD_S, float(force_n))
    return holder, len(forces) * PERIOD_S


def test_a_margin_counts_with_the_force_of_its_own_moment():
    controller = Constant()
    holder, now_s = holder_of(controller, forces=np.linspace(1.0, 2.0, 91))
    holder.update_reading(reading_of(0.5, low=0.3), taken_s=75 * PERIOD_S)
    answer = holder.grip_force(now_s, 3.0)
    assert controller.observations[-1].force_n == pytest.approx(1.0 + 75 / 90)
    assert (answer.margin, answer.low) == (0.5, 0.3)
    np.testing.assert_array_equal(controller.observations[-1].margin, [[0.5, 0.5]])


@pytest.mark.parametrize("reading", [None, reading_of(None), reading_of(0.9)], ids=["none", "withheld", "stale"])
def test_nothing_is_loosened_without_a_margin_whatever_a_controller_says(reading: Reading | None):
    controller = Constant(force_n=2.0)
    holder, now_s = holder_of(controller)
    if reading is not None:
        holder.update_reading(reading, taken_s=now_s - 0.6)
    for wanted_n, force_n in ((1.0, 2.0), (np.nan, 2.0), (3.0, 3.0), (-1.0, 3.0), (9.0, 4.0), (0.0, 4.0)):
        controller.force_n = wanted_n
        answer = holder.grip_force(now_s, force_n)
        assert answer.command_n == force_n
        assert answer.why.startswith("no margin:")
    holder.update_reading(reading_of(0.9), taken_s=now_s)
    assert holder.grip_force(now_s, 4.0).command_n == 0.0


@pytest.mark.parametrize("controller", [Constant(force_n=3.0), Constant(force_n=0.0), "margin", "reflex"])
def test_without_a_measured_force_the_last_command_is_repeated(controller):
    holder, now_s = holder_of(Constant(force_n=2.0))
    holder.choose(controller)
    holder.update_reading(reading_of(0.1, slip=SlipState.SLIP), taken_s=now_s)
    for step in range(60):
        answer = holder.grip_force(now_s + step * PERIOD_S, np.nan)
        assert (answer.command_n, answer.slip) == (2.0, False)
        assert answer.why == "no force is measured: holds"
    # the force of the moment of the frame was not measured either
    holder.update_reading(reading_of(0.1), taken_s=now_s + 0.5)
    now_s += 1.0
    assert holder.grip_force(now_s, 2.0).why == "no force is measured: holds"
    holder.update_reading(reading_of(0.1), taken_s=now_s)
    assert holder.grip_force(now_s, 2.0).slip  # which was not forgotten


@pytest.mark.parametrize("share", [-1.0, 0.0, 0.5, 1.5, 3.0, 1e6])
def test_a_force_that_does_not_follow_the_commands_is_a_trouble_and_held(share):
    holder, now_s = holder_of(Constant(force_n=2.0))
    holder.choose("margin")
    answers = []
    for step in range(60):
        # a margin above the one aimed at, so that the law would loosen by the force that is measured
        holder.update_reading(reading_of(0.7), taken_s=now_s + step * PERIOD_S)
        answers.append(holder.grip_force(now_s + step * PERIOD_S, share * 2.0))
    assert {answer.command_n for answer in answers} == {2.0}
    troubles = [answer.trouble for answer in answers]
    assert troubles[29] is None  # for half a second it may be the actuator
    assert len(set(troubles[32:])) == 1
    assert f"measures {share * 2.0:.3g} N where 2 N is commanded" in str(troubles[-1])
    # as soon as the force follows it counts again
    holder.update_reading(reading_of(0.1), taken_s=now_s + 1.0)
    answer = holder.grip_force(now_s + 1.0, 2.0)
    assert answer.trouble is None
    assert answer.command_n >= 2.0


@given(
    name=st.sampled_from([*(name for name in CONTROLLERS if name != "oracle"), "own"]),
    command_n=st.floats(0.6, 4.0),
    # of what is commanded, as a gripper may measure it
    share=st.floats(0.0, 2.0),
    read=st.lists(st.floats(0.0, 1.0), min_size=2, max_size=30),
)
def test_below_the_margin_aimed_at_no_controller_commands_less_than_before(name, command_n, share, read):
    """What is acted on is at most what is read: a reading under the target is a margin under it, but for noise."""
    holder = Holder(Constant(force_n=0.0) if name == "own" else name, ceiling_n=5.0, command_n=command_n)
    before = command_n
    controller: Any = holder.controller
    for step, margin in enumerate(read):
        time_s = 2.0 + step * PERIOD_S
        holder.update_reading(reading_of(margin), taken_s=time_s)
        after = holder.grip_force(time_s, share * before, load_n=0.0).command_n
        acted = float(controller.acted[0]) if isinstance(controller, MarginLaw) else margin
        if acted < getattr(controller, "target", MarginLaw.target):
            assert after >= before
        before = after


def test_time_begins_at_the_touch_and_what_a_slow_gripper_missed_is_not_made_up_for():
    controller = Constant()
    holder, now_s = holder_of(controller, forces=np.zeros(60))
    assert {observation.time_s for observation in controller.observations} == {0.0}
    for step_s in (0.0, PERIOD_S, 0.3):
        holder.grip_force(now_s := now_s + step_s, 1.0)
    assert [item.time_s for item in controller.observations[-3:]] == pytest.approx([0.0, PERIOD_S, PERIOD_S + 0.3])
    assert [item.since_s for item in controller.observations[-3:]] == pytest.approx([PERIOD_S, PERIOD_S, 3 * PERIOD_S])


def test_laws_aim_at_the_margin_itself_as_soon_as_readings_know_the_friction():
    holder, now_s = holder_of("margin")
    read = MarginLaw.zero + (1 - MarginLaw.zero) * MarginLaw.target  # of which MarginLaw.target is left beyond r_0
    for friction, aim in (("0.6", 0.6), (None, read)):
        holder.update_reading(reading_of(0.7, friction=friction), taken_s=now_s)
        assert f"aims at a margin of {100 * aim:.0f} %" in holder.grip_force(now_s, 2.0).why
    holder.update_reading(reading_of(None, friction=None), taken_s=now_s)  # withheld: no news of the friction
    holder.update_reading(reading_of(0.7, friction="0.6"), taken_s=now_s)
    assert "aims at a margin of 60 %" in holder.grip_force(now_s, 2.0).why


def test_what_a_slip_teaches_of_the_friction_makes_no_law_forget_the_slip():
    holder, now_s = holder_of("margin")
    holder.update_reading(reading_of(0.5, slip=SlipState.SLIP), taken_s=now_s)
    pressed = holder.grip_force(now_s, 2.0)
    assert pressed.slip
    loosened = {}
    for after_s in (0.1, 1.1):
        holder.update_reading(reading_of(0.95, friction="0.6"), taken_s=now_s + after_s)
        answer = holder.grip_force(now_s + after_s, pressed.command_n)
        loosened[after_s] = answer.command_n < pressed.command_n
    assert list(loosened.values()) == [False, True]


@pytest.mark.parametrize(
    ("forces", "taken_s", "counts"),
    [
        (np.full(90, 2.0), 1.4, True),
        (np.full(90, 2.0), 0.4, False),  # the fingers close
        (np.linspace(3.0, 2.0, 90), 1.4, False),  # loosened
        (np.linspace(2.0, 3.0, 90), 1.4, True),
    ],
)
def test_a_slip_counts_once_and_only_where_the_skin_does_not_spring_back_by_itself(forces, taken_s, counts):
    controller = Constant()
    holder, now_s = Holder(controller, ceiling_n=4.0), len(forces) * PERIOD_S
    for number, force_n in enumerate(forces.tolist()):
        holder.update_reading(reading_of(0.9), taken_s=number * PERIOD_S)
        controller.force_n = force_n
        # whatever noise the measured force has
        holder.grip_force(number * PERIOD_S, force_n + 0.05 * (-1) ** number)
    controller.force_n = 2.5
    for expected in (counts, False):
        holder.update_reading(reading_of(0.5, slip=SlipState.SLIP), taken_s=taken_s)
        assert holder.grip_force(now_s, 2.0).slip is expected
    holder.update_reading(reading_of(0.5, slip=SlipState.STICKING), taken_s=taken_s)
    holder.update_reading(reading_of(0.5, slip=SlipState.SLIP), taken_s=taken_s)
    assert holder.grip_force(now_s, 2.0).slip is counts


@pytest.mark.parametrize("lie", [*LIES, *WIRE])
def test_a_lying_gripper_is_never_opened_overloaded_or_loosened_below_the_target(lie):
    held = hold(lie)
    assert held.sent <= {"F", "S"}
    assert held.command_n.max() <= CEILING_N
    assert held.command_n.min() >= MarginLaw.least_n
    change = np.diff(held.command_n, prepend=0.0)
    assert np.all(change[held.acted < MarginLaw.target] >= 0)
    if lie != "noise of 0.5 N":  # which is right on average
        assert held.troubles
