"""A real gripper is held by what fingertips read: each margin with its own force, and nothing is loosened blindly."""

import math
import re
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count
from pathlib import Path
from threading import Event
from types import SimpleNamespace

import numpy as np
import pytest
from constant_controller import Constant
from fake_gripper import FakeGripper

import sliplens as sl
from sliplens.codec import load_result
from sliplens.errors import InputError, SourceError
from sliplens.grip.controllers import HoldStep, MarginLaw
from sliplens.grip.gripper import DryRun, GripperError, GripperState, GuardedGripper
from sliplens.grip.hold import HoldLoop
from sliplens.grip.records import Hold
from sliplens.grip.source import GripSource
from sliplens.live.contract import LiveSource
from sliplens.live.reading import LiveFrame

plain_reader = partial(sl.LiveReader, health=None, slip=None)


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
    [code] = re.findall(
        r"## Control my own gripper.*?^```python[^\n]*\n(.*?)^```", page, flags=re.DOTALL | re.MULTILINE
    )
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
        hold = sl.hold_grip(reader, hand, controller=Constant(force_n=1.0), **given)
    assert (hold.ended, hold.why) == (ended, f"{why}; the gripper keeps the last command of 3.00 N")
    assert set(hand.sent) == {3.0}
    assert len(hold.steps) == hold.to_arrow().num_rows > 0
    assert hold.sources == ("a finger",)


def test_what_was_told_is_kept_though_who_hears_of_it_fails(tmp_path: Path):
    def fail(step: HoldStep) -> None:
        raise BrokenPipeError("nobody listens")

    with plain_reader(Frames()) as reader, pytest.raises(BrokenPipeError):
        sl.hold_grip(reader, DryRun(), controller=Constant(force_n=1.0), on_step=fail, out=tmp_path / "hold")
    hold = load_result(tmp_path / "hold", Hold, command="sliplens hold")
    assert (hold.ended, len(hold.steps)) == ("failed", 1)
    assert hold.why == "BrokenPipeError (nobody listens); the gripper keeps the last command of 1.00 N"


def test_a_force_that_was_told_is_noted_though_ctrl_c_comes_before_its_answer():
    class Interrupted(DryRun):
        def set_force(self, force_n: float) -> None:
            super().set_force(force_n)
            raise KeyboardInterrupt

    hand = Interrupted()
    with plain_reader(Frames()) as reader:
        hold = sl.hold_grip(reader, hand, controller=Constant(force_n=1.0))
    assert hand.sent == [1.0]
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
        def read_state(self):
            raise RuntimeError("no sensor")

    gripper = Mute()
    with plain_reader(Frames()) as reader, pytest.raises(GripperError, match=r"measures no force .*no sensor"):
        sl.hold_grip(reader, gripper, controller="fixed", settings={"force_n": 1.5}, seconds=0.1)
    assert gripper.sent == []


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
        holding = HoldLoop(guard, [reader], "margin")
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
    assert set(gripper.sent) == {2.0}


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
        ({"controller": "margin"}, "needs margins, and a finger has no network"),
        ({"controller": "oracle"}, "needs the true margin, which a finger does not have"),
        ({"controller": "assumed-friction"}, "needs a force sensor at the wrist"),
        ({"controller": Constant(), "settings": {"force_n": 1.0}}, "settings change a controller of the table"),
        ({"gripper": "simulated"}, "`simulated` is the gripper of the source `grip`; a finger has none"),
        ({"seconds": 0.0}, "seconds must be positive"),
        ({"ceiling_n": -1.0}, "the ceiling of a guarded gripper must be positive"),
    ],
)
def test_what_does_not_go_together_is_refused(given, told):
    with plain_reader(Frames()) as reader, pytest.raises(InputError, match=told):
        sl.hold_grip(reader, **({"gripper": "dry-run", "controller": "fixed"} | given))
