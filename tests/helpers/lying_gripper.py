"""Grippers that lie for a while, held by the margin in virtual time."""

import random
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from fake_gripper import FakeGripper

from sliplens.grip.controllers import Controller, Holder, MarginLaw
from sliplens.grip.gripper import GuardedGripper, open_gripper
from sliplens.grip.plant import PERIOD_S
from sliplens.live.reading import Reading

CEILING_N, FRICTION = 3.0, 0.7
LIES_S, ENDS_S, OVER_S = 2.0, 2.8, 3.2
"""When the gripper begins to lie, when it stops, and when the hold is over."""
NOISE = random.Random(0)


def state(force_n: float) -> bytes:
    return f"OK {force_n:.3f} 0.0400\n".encode()


LIES: dict[str, Callable[[float], bytes | None]] = {
    "zero": lambda _: state(0.0),
    "half": lambda force_n: state(0.5 * force_n),
    "negative": lambda force_n: state(-force_n),
    "triple": lambda force_n: state(3 * force_n),
    "huge": lambda _: state(1e6),
    "constant": lambda _: state(0.8),
    "noise of 0.5 N": lambda force_n: state(max(0.0, force_n + NOISE.gauss(0, 0.5))),
    "garbage": lambda _: b"\x00\xff{}OK nan\n",
    "no answer": lambda _: None,
    "refusals": lambda _: b"ERR hot\n",
    "endless line": lambda _: b"x" * 10_000,
}
"""Answer to a line, by the force that is pressed."""
WIRE = ("late answers", "hangs up")
"""Lies of the line itself."""


class LyingGripper(FakeGripper):
    """Gripper that presses as commanded, with a lag, and reports something else while it lies."""

    def __init__(self, lie: str) -> None:
        super().__init__()
        self.lie, self.lies, self.answer = lie, False, self.report
        self.force_n = self.command_n = 0.0

    def report(self, line: str) -> bytes | None:
        if line.startswith("F "):
            self.command_n = float(line.removeprefix("F "))
        if self.lies and self.lie in LIES:
            return LIES[self.lie](self.force_n)
        if self.lies and self.lie == "hangs up":
            self.hang_up()
        elif self.lies:
            time.sleep(0.05)
        return state(self.force_n)


@dataclass(frozen=True, kw_only=True)
class LyingHold:
    """Commands of a hold, a row each."""

    command_n: np.ndarray
    acted: np.ndarray
    """Margin acted on, or read by a controller of another kind; NaN where none is."""
    troubles: tuple[str, ...]
    sent: frozenset[str]
    """First words of all lines."""


def hold(lie: str, controller: str | Controller = "margin") -> LyingHold:
    """Hold with a lying gripper an object that is pulled at with 0.6 N from 1 s on, and with 0.8 N as it lies."""
    gripper = LyingGripper(lie)
    holder = Holder(controller, ceiling_n=CEILING_N)
    rows, troubles = [], dict[str, None]()
    line = open_gripper(gripper.address, timeout_s=2.0)
    with closing(gripper), GuardedGripper(line, ceiling_n=CEILING_N, watchdog_s=60.0) as guard:
        for step in range(round(OVER_S / PERIOD_S)):
            now_s = step * PERIOD_S
            gripper.lies = LIES_S <= now_s < ENDS_S
            line.timeout_s = 0.02 if gripper.lies else 2.0  # a busy machine is no lie
            gripper.force_n += (gripper.command_n - gripper.force_n) * (1 - np.exp(-PERIOD_S / 0.05))
            pull_n = 0.0 if now_s < 1 else 0.6 if now_s < LIES_S + 0.3 else 0.8
            margin = max(0.0, 1 - pull_n / (FRICTION * max(gripper.force_n, 1e-9)))
            read = 0.5 + 0.5 * margin  # as a network reads that sees no friction
            holder.update_reading(Reading(number=step, time_s=now_s, captured_s=now_s, margin=read), taken_s=now_s)
            try:
                force_n, trouble = guard.read_state().force_n, None
            except Exception as error:  # as `hold_grip` takes it
                force_n, trouble = np.nan, str(error)
            answer = holder.grip_force(now_s, force_n)
            guard.set_force(answer.command_n)
            for words in (guard.failure, trouble, answer.trouble):
                if words is not None:
                    troubles[words] = None
            law = holder.controller
            acted = float(law.acted[0]) if isinstance(law, MarginLaw) else read
            rows.append((answer.command_n, acted))
    command_n, acted = np.array(rows).T
    sent = frozenset(line.split()[0] for line in gripper.heard)
    return LyingHold(command_n=command_n, acted=acted, troubles=tuple(troubles), sent=sent)
