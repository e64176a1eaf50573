"""A real gripper is held by what fingertips read: each margin with its own force, and nothing is loosened blindly."""

import math
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fake_gripper import FakeGripper
from hypothesis import given
from hypothesis import strategies as st

import sliplens as sl
from sliplens.codec import load_result
from sliplens.errors import InputError, SourceError
from sliplens.grip.controllers import CONTROLLERS, FRICTION_CONSTANTS, MarginGrip, MarginLaw, Observation
from sliplens.grip.gripper import DryRun, GripperError, GripperState, GuardedGripper
from sliplens.grip.hold import HoldLoop, HoldStep
from sliplens.grip.holder import Holder
from sliplens.grip.plant import PERIOD_S
from sliplens.grip.records import Hold
from sliplens.grip.source import GripSource
from sliplens.live.contract import LiveSource
from sliplens.live.reading import LiveFrame, Reading, SlipState

plain_reader = partial(sl.LiveReader, health=None, slip=None)


@dataclass
class Says:
    """Controller that notes what it sees, and says what it is told to."""

    force_n: float = 2.0
    seen: list[Observation] = field(default_factory=list)

    def command(self, seen: Observation) -> np.ndarray:
        self.seen.append(seen)
        return np.array([self.force_n])


def told(margin: float | None, *, low: float | None = None, slip: SlipState | None = None, friction: str | None = None):
    return Reading(number=0, time_s=0.0, captured_s=0.0, margin=margin, low=low, slip=slip, friction=friction)


def holder_of(controller, *, forces: np.ndarray | None = None, fingers: int = 1) -> tuple[Holder, float]:
    """Holder that has measured some forces, one a period, and the time now."""
    holder = Holder(controller, ceiling_n=4.0, fingers=fingers)
    forces = np.full(90, 2.0) if forces is None else forces
    for number, force_n in enumerate(forces):
        holder.grip_force(number * PERIOD_S, float(force_n))
    return holder, len(forces) * PERIOD_S


def test_a_margin_counts_with_the_force_of_its_own_moment():
    says = Says()
    holder, now_s = holder_of(says, forces=np.linspace(1.0, 2.0, 91))
    holder.update_reading(told(0.5, low=0.3), taken_s=75 * PERIOD_S)
    answer = holder.grip_force(now_s, 3.0)
    assert says.seen[-1].force_n == pytest.approx(1.0 + 75 / 90)
    assert (answer.margin, answer.low) == (0.5, 0.3)
    np.testing.assert_array_equal(says.seen[-1].margin, [[0.5, 0.5]])


def test_two_fingers_read_each_its_margin_and_one_suffices():
    says = Says()
    holder, now_s = holder_of(says, forces=np.linspace(1.0, 2.0, 91), fingers=2)
    holder.update_reading(told(0.4), taken_s=80 * PERIOD_S)
    assert holder.grip_force(now_s, 2.0).margin == 0.4
    np.testing.assert_array_equal(says.seen[-1].margin, [[0.4, np.nan]])
    holder.update_reading(told(0.6), taken_s=90 * PERIOD_S, finger=1)
    assert holder.grip_force(now_s, 2.0).margin == pytest.approx(0.5)
    assert says.seen[-1].force_n == pytest.approx(1.0 + 85 / 90)


@pytest.mark.parametrize("reading", [None, told(None), told(0.9)], ids=["none", "withheld", "stale"])
def test_nothing_is_loosened_without_a_margin_whatever_a_controller_says(reading: Reading | None):
    says = Says(force_n=2.0)
    holder, now_s = holder_of(says)
    if reading is not None:
        holder.update_reading(reading, taken_s=now_s - 0.6)
    for wanted_n, force_n in ((1.0, 2.0), (np.nan, 2.0), (3.0, 3.0), (-1.0, 3.0), (9.0, 4.0), (0.0, 4.0)):
        says.force_n = wanted_n
        answer = holder.grip_force(now_s, force_n)
        assert answer.command_n == force_n
        assert answer.why.startswith("no margin:")
    holder.update_reading(told(0.9), taken_s=now_s)
    assert holder.grip_force(now_s, 4.0).command_n == 0.0


@pytest.mark.parametrize("controller", [Says(force_n=3.0), Says(force_n=0.0), "margin", "reflex"])
def test_without_a_measured_force_the_last_command_is_repeated(controller):
    holder, now_s = holder_of(Says(force_n=2.0))
    holder.choose(controller)
    holder.update_reading(told(0.1, slip=SlipState.SLIP), taken_s=now_s)
    for step in range(60):
        answer = holder.grip_force(now_s + step * PERIOD_S, np.nan)
        assert (answer.command_n, answer.slip) == (2.0, False)
        assert answer.why == "no force is measured: holds"
    # the force of the moment of the frame was not measured either
    holder.update_reading(told(0.1), taken_s=now_s + 0.5)
    now_s += 1.0
    assert holder.grip_force(now_s, 2.0).why == "no force is measured: holds"
    holder.update_reading(told(0.1), taken_s=now_s)
    assert holder.grip_force(now_s, 2.0).slip  # which was not forgotten


@pytest.mark.parametrize("share", [-1.0, 0.0, 0.5, 1.5, 3.0, 1e6])
def test_a_force_that_does_not_follow_the_commands_is_a_trouble_and_held(share):
    holder, now_s = holder_of(Says(force_n=2.0))
    holder.choose("margin")
    answers = []
    for step in range(60):
        # a margin above the one aimed at, so that the law would loosen by the force that is measured
        holder.update_reading(told(0.7), taken_s=now_s + step * PERIOD_S)
        answers.append(holder.grip_force(now_s + step * PERIOD_S, share * 2.0))
    assert {answer.command_n for answer in answers} == {2.0}
    troubles = [answer.trouble for answer in answers]
    assert troubles[29] is None  # for half a second it may be the actuator
    assert len(set(troubles[32:])) == 1
    assert f"measures {share * 2.0:.3g} N where 2 N is commanded" in str(troubles[-1])
    # as soon as the force follows it counts again
    holder.update_reading(told(0.1), taken_s=now_s + 1.0)
    answer = holder.grip_force(now_s + 1.0, 2.0)
    assert answer.trouble is None
    assert answer.command_n >= 2.0


@dataclass
class Loosens:
    """Controller of somebody else, which lets go whatever is read."""

    def command(self, seen: Observation) -> np.ndarray:
        return 0.0 * seen.command_n


@given(
    name=st.sampled_from([*(name for name in CONTROLLERS if name != "oracle"), "own"]),
    command_n=st.floats(0.6, 4.0),
    # of what is commanded, as a gripper may measure it
    share=st.floats(0.0, 2.0),
    read=st.lists(st.floats(0.0, 1.0), min_size=2, max_size=30),
)
def test_below_the_margin_aimed_at_no_controller_commands_less_than_before(name, command_n, share, read):
    """What is acted on is at most what is read: a reading under the target is a margin under it, but for noise."""
    holder = Holder(Loosens() if name == "own" else name, ceiling_n=5.0, command_n=command_n)
    before = command_n
    controller: Any = holder.controller
    for step, margin in enumerate(read):
        time_s = 2.0 + step * PERIOD_S
        holder.update_reading(told(margin), taken_s=time_s)
        after = holder.grip_force(time_s, share * before, load_n=0.0).command_n
        acted = float(controller.acted[0]) if isinstance(controller, MarginGrip) else margin
        if acted < getattr(controller, "target", MarginLaw.target):
            assert after >= before
        before = after


def test_time_begins_at_the_touch_and_what_a_slow_gripper_missed_is_not_made_up_for():
    says = Says()
    holder, now_s = holder_of(says, forces=np.zeros(60))
    assert {seen.time_s for seen in says.seen} == {0.0}
    for step_s in (0.0, PERIOD_S, 0.3):
        holder.grip_force(now_s := now_s + step_s, 1.0)
    assert [seen.time_s for seen in says.seen[-3:]] == pytest.approx([0.0, PERIOD_S, PERIOD_S + 0.3])
    assert [seen.since_s for seen in says.seen[-3:]] == pytest.approx([PERIOD_S, PERIOD_S, 3 * PERIOD_S])


def test_a_force_grows_as_fast_at_any_rate_of_commands():
    def grown(period_s: float) -> float:
        law = MarginLaw()
        seen = {"force_n": np.array([2.0]), "load_n": np.zeros(1), "slip": np.zeros(1, dtype=bool)}
        seen |= {"margin": np.full((1, 2), 0.5), "low": np.full((1, 2), 0.5), "since_s": period_s}
        [force_n] = law.command(Observation(time_s=2.0, command_n=np.array([1.0]), **seen))
        return (force_n - 1.0) / period_s

    assert grown(1 / 120) == pytest.approx(grown(1 / 60)) == pytest.approx(MarginLaw.up_n_s)


def test_laws_aim_at_the_margin_itself_as_soon_as_readings_know_the_friction():
    holder, now_s = holder_of("margin")
    read = MarginLaw.zero + (1 - MarginLaw.zero) * MarginLaw.target  # of which MarginLaw.target is left beyond r_0
    for friction, aim in (("0.6", FRICTION_CONSTANTS["target"]), (None, read)):
        holder.update_reading(told(0.7, friction=friction), taken_s=now_s)
        assert f"aims at a margin of {100 * aim:.0f} %" in holder.grip_force(now_s, 2.0).why
    holder.update_reading(told(None, friction=None), taken_s=now_s)  # withheld, which says nothing of the friction
    holder.update_reading(told(0.7, friction="0.6"), taken_s=now_s)
    assert f"aims at a margin of {100 * FRICTION_CONSTANTS['target']:.0f} %" in holder.grip_force(now_s, 2.0).why


def test_what_a_slip_teaches_of_the_friction_makes_no_law_forget_the_slip():
    holder, now_s = holder_of("margin")
    holder.update_reading(told(0.5, slip=SlipState.SLIP), taken_s=now_s)
    pressed = holder.grip_force(now_s, 2.0)
    assert pressed.slip
    loosened = {}
    for after_s in (0.1, MarginLaw.calm_s + 0.1):
        holder.update_reading(told(0.95, friction="0.6"), taken_s=now_s + after_s)
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
    says = Says()
    holder, now_s = Holder(says, ceiling_n=4.0), len(forces) * PERIOD_S
    for number, force_n in enumerate(forces.tolist()):
        holder.update_reading(told(0.9), taken_s=number * PERIOD_S)
        says.force_n = force_n
        # whatever noise the measured force has
        holder.grip_force(number * PERIOD_S, force_n + 0.05 * (-1) ** number)
    says.force_n = 2.5
    for expected in (counts, False):
        holder.update_reading(told(0.5, slip=SlipState.SLIP), taken_s=taken_s)
        assert holder.grip_force(now_s, 2.0).slip is expected
    holder.update_reading(told(0.5, slip=SlipState.STICKING), taken_s=taken_s)
    holder.update_reading(told(0.5, slip=SlipState.SLIP), taken_s=taken_s)
    assert holder.grip_force(now_s, 2.0).slip is counts


@pytest.fixture
def gripper() -> Iterator[FakeGripper]:
    fake = FakeGripper()
    yield fake
    fake.close()


def test_a_gripper_that_misbehaves_holds_a_cup_by_what_is_read_of_its_frames(gripper, monkeypatch, capsys):
    monkeypatch.setattr("sliplens.grip.source.OPEN_S", 0.0)
    monkeypatch.setattr("sliplens.grip.source.LIFT_S", 0.2)
    source, number = GripSource("cup", rate_hz=20.0), count()

    def answer(line: str) -> bytes | None:
        """Obey, and say so; or refuse, stammer, or say nothing."""
        bad = {17: b"ERR busy\n", 31: b"OK a lot\n", 47: None}.get(next(number) % 50, b"")
        if bad != b"":
            return bad
        if line.startswith("F "):
            source.set_force(float(line.removeprefix("F ")))
        state = source.read_state()
        return f"OK {state.force_n:.3f} {state.width_m:.4f}\n".encode()

    gripper.answer = answer
    # as the page has it, but for where the fingertip and the gripper are, and how long
    page = (Path(__file__).parents[2] / "docs" / "grip.md").read_text(encoding="utf-8")
    [code] = re.findall(r"## Hold with my own gripper.*?^```python\n(.*?)^```", page, flags=re.DOTALL | re.MULTILINE)
    for old, new in (
        ('"0", "chromatouch-pair"', 'source, "chromatouch-pair", seconds=1.8, **given'),
        ('"tcp://gripper:5000"', "address"),
        ("ceiling_n=4.0", "ceiling_n=2.6"),
    ):
        assert old in code
        code = code.replace(old, new)
    names = {"source": source, "address": gripper.address, "given": {"engine": "torch", "health": None, "slip": None}}
    exec(code, names)
    hold, held = names["hold"], source.status(max(source._frames))
    assert held is not None
    assert isinstance(hold, Hold)
    assert hold.ended == "source"
    assert "aims at a margin" in capsys.readouterr().out
    assert held.phase in {"lifting", "holding"}
    assert held.slip_m < 2e-3
    assert held.controller == "outside"
    steps = hold.steps
    assert any("busy" in trouble for trouble in hold.troubles)
    assert any("a lot" in trouble for trouble in hold.troubles)
    assert np.isnan(steps.force_n[steps.failed]).any()
    assert not steps.failed.all()
    forces = [float(line.removeprefix("F ")) for line in gripper.heard if line.startswith("F ")]
    assert min(forces) >= MarginLaw.least_n
    assert max(forces) <= 2.6
    assert not [line for line in gripper.heard if line.startswith("W")]
    blind = np.flatnonzero(np.isnan(steps.margin))[1:]
    assert np.all(steps.command_n[blind] >= steps.command_n[blind - 1])


class Frames(LiveSource):
    """Frames of noise, until somebody ends them; a few end once a step was told."""

    name, rate_hz, size = "a finger", 100.0, (64, 64)

    def __init__(self, *, frames: int = 10**6, then: Callable[[Event], object] = lambda _: None) -> None:
        self._frames, self._then, self._closed, self.held = frames, then, Event(), Event()
        self.reference = self._image = np.zeros((64, 64, 3), dtype=np.uint8)

    def frames(self) -> Iterator[LiveFrame]:
        for number in range(self._frames):
            if self._closed.wait(0.01):
                return
            now_s = time.monotonic()
            yield LiveFrame(image=self._image, number=number, time_s=now_s, captured_s=now_s)
        self.held.wait(10)  # however late it begins to hold
        self._then(self._closed)

    def close(self) -> None:
        self._closed.set()
        self.held.set()


def lose(_: Event) -> None:
    raise SourceError("the cable was pulled; put it back")


def interrupt(step: HoldStep) -> None:
    if step.time_s > 0.05:
        raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("source", "given", "ended", "why"),
    [
        (Frames(frames=5), {}, "source", "a finger has ended"),
        (Frames(frames=5, then=lose), {}, "failed", "the cable was pulled; put it back"),
        (Frames(frames=5, then=lambda closed: closed.wait(10)), {"seconds": 0.15}, "time", "the time is over"),
        (Frames(), {"on_step": interrupt}, "interrupted", "interrupted"),
    ],
    ids=["ends", "fails", "stalls", "ctrl-c"],
)
def test_however_it_ends_the_gripper_keeps_what_it_holds_with(source, given, ended, why):
    hand = DryRun()
    hand.set_force(3.0)  # it holds something already
    with plain_reader(source) as reader:
        given = {"on_step": lambda _: source.held.set()} | given
        hold = sl.hold_grip(reader, hand, controller=Says(force_n=1.0), **given)
    assert (hold.ended, hold.why) == (ended, f"{why}; the gripper keeps the last command of 3.00 N")
    assert set(hand.sent) == {"F 3.000"}
    assert len(hold.steps) == hold.frame().num_rows > 0
    assert hold.sources == ("a finger",)


def test_what_was_told_is_kept_though_who_hears_of_it_fails(tmp_path: Path):
    def fail(step: HoldStep) -> None:
        raise BrokenPipeError("nobody listens")

    with plain_reader(Frames()) as reader, pytest.raises(BrokenPipeError):
        sl.hold_grip(reader, DryRun(), controller=Says(force_n=1.0), on_step=fail, out=tmp_path / "hold")
    hold = load_result(tmp_path / "hold", Hold, command="sliplens hold")
    assert (hold.ended, len(hold.steps)) == ("failed", 1)
    assert hold.why == ("on_step failed (nobody listens); the gripper keeps the last command of 1.00 N")


def test_a_force_that_was_told_is_noted_though_ctrl_c_comes_before_its_answer():
    class Interrupted(DryRun):
        def set_force(self, force_n: float) -> None:
            super().set_force(force_n)
            raise KeyboardInterrupt

    hand = Interrupted()
    with plain_reader(Frames()) as reader:
        hold = sl.hold_grip(reader, hand, controller=Says(force_n=1.0))
    assert hand.sent == ["F 1.000"]
    assert hold.why == "interrupted; the gripper keeps the last command of 1.00 N"
    assert hold.steps.command_n.tolist() == [1.0]


def test_one_of_two_readers_suffices():
    few, more = Frames(frames=2), Frames(frames=12)

    def end(_: HoldStep) -> None:
        few.held.set()
        if one.ended is not None:  # it held with the other alone
            more.held.set()

    with plain_reader(few) as one, plain_reader(more) as other:
        hold = sl.hold_grip([one, other], "dry-run", controller="fixed", on_step=end)
        assert other.ended is not None
    assert hold.ended == "source"
    assert hold.why == "a finger has ended, a finger has ended; nothing was sent"


def test_a_gripper_that_never_answers_is_told_on_and_its_failure_noted():
    class Dead(DryRun):
        def set_force(self, force_n: float) -> None:
            raise GripperError(f"no motor for {force_n:g} N")

        reads = 0

        def read_state(self):
            self.reads += 1
            if self.reads in {2, 3}:  # twice it answers, and then never
                return super().read_state()
            raise RuntimeError("no sensor")

    with plain_reader(Frames()) as reader:
        hold = sl.hold_grip(reader, Dead(), controller="fixed", settings={"force_n": 1.5}, seconds=0.1)
    assert hold.troubles == ("no motor for 1.5 N",)
    assert hold.steps.failed.all()
    assert np.isnan(hold.steps.force_n[1:]).all()


def test_who_does_not_know_what_is_held_tells_nothing():
    class Mute(DryRun):
        told: tuple[float, ...] = ()

        def set_force(self, force_n: float) -> None:
            self.told += (force_n,)

        def read_state(self):
            raise RuntimeError("no sensor")

    gripper = Mute()
    with plain_reader(Frames()) as reader, pytest.raises(GripperError, match=r"measures no force .*no sensor"):
        sl.hold_grip(reader, gripper, controller="fixed", settings={"force_n": 1.5}, seconds=0.1)
    assert gripper.told == ()


@pytest.mark.parametrize("force_n", [0.0, -2.0])
def test_a_gripper_that_measures_no_force_from_the_start_is_refused_and_keeps_its_command(force_n, monkeypatch):
    class Numb(DryRun):
        width_m = 0.04

        def read_state(self) -> GripperState:
            return GripperState(force_n=force_n, width_m=self.width_m)

    clock = SimpleNamespace(now_s=100.0)
    clock.monotonic = lambda: clock.now_s
    monkeypatch.setattr("sliplens.grip.hold.time", clock)
    gripper, reader = Numb(), plain_reader(Frames())
    with GuardedGripper(gripper, ceiling_n=3.0, watchdog_s=60.0) as guard:
        holding = HoldLoop(guard, [reader], "margin", ceiling_n=3.0)
        for _ in range(300):  # its fingers close for 5 s, which is no reason to refuse it
            clock.now_s += 1 / 60
            gripper.width_m -= 1.2e-4
            holding.step(100.0)
        for _ in range(119):
            clock.now_s += 1 / 60
            holding.step(100.0)
        clock.now_s += 3 / 60
        with pytest.raises(GripperError, match="its fingers do not move"):
            holding.step(100.0)
    assert math.isclose(clock.now_s, 107.0, abs_tol=0.1)
    assert set(gripper.sent) == {"F 2.000"}


def test_a_reader_that_was_not_entered_is_refused():
    with pytest.raises(InputError, match="enter the reader first"):
        sl.hold_grip(plain_reader(Frames()), "dry-run", controller="fixed", seconds=0.1)


def test_a_hold_is_kept_and_no_other_takes_its_place(tmp_path: Path):
    steps: list[HoldStep] = []

    def once(**given) -> Hold:
        steps.clear()
        with plain_reader(Frames()) as reader:
            return sl.hold_grip(
                reader, "dry-run", controller="fixed", seconds=0.1, out=tmp_path / "hold", on_step=steps.append, **given
            )

    hold = once()
    kept = load_result(tmp_path / "hold", Hold, command="sliplens hold")
    np.testing.assert_array_equal(kept.steps.command_n, hold.steps.command_n)
    assert list(kept.steps.why) == [step.why for step in steps]
    assert kept.ended == "time"
    assert len(sl.plot(kept).axes[0].lines) >= 2
    with pytest.raises(InputError, match="holds a result of other settings"):
        once()
    assert once(overwrite=True).ended == "time"


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"controller": "margin"}, "needs margins, and no network reads a finger"),
        ({"controller": "oracle"}, "needs the true margin, which a finger does not have"),
        ({"controller": "assumed-friction"}, "needs a force sensor at the wrist"),
        ({"controller": "magic"}, "there is no controller named 'magic'"),
        ({"controller": Says(), "settings": {"force_n": 1.0}}, "settings change a controller of the table"),
        ({"gripper": "simulated"}, "`simulated` is the gripper of the source `grip`; a finger has none"),
        ({"gripper": "/dev/no-such-device"}, "no serial device"),
        ({"network": "chromatouch-difference"}, "a reader has its own network"),
        ({"seconds": 0.0}, "seconds must be positive"),
        ({"ceiling_n": -1.0}, "the ceiling of a guarded gripper must be positive"),
    ],
)
def test_what_does_not_go_together_is_refused(given, told):
    with plain_reader(Frames()) as reader, pytest.raises(InputError, match=told):
        sl.hold_grip(reader, **({"gripper": "dry-run", "controller": "fixed"} | given))
