"""Grip force for running fingertips: pairs margins with forces, and never loosens a grip blindly."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, fields
from threading import Lock
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from sliplens.grip.controllers import Controller, MarginLaw, Observation, make_controller
from sliplens.grip.plant import PERIOD_S
from sliplens.live.reading import Reading, SlipState

SPRINGS_BACK_S = 0.25
"""Time within which skin that springs back shows in the markers."""
_CLOSING_S = 0.5  # time after the first touch in which the markers move because the fingers close
STALE_S = 0.5
"""Age from which a reading does not count."""
_TOUCH_N = 0.02  # grip force that is a touch
_DIFFERS, _DIFFERS_N, _DIFFERS_S = 0.3, 0.1, 0.5
"""Share of the command, least force, and time from which a measured force that differs is a fault. An actuator with a
lag of 50 ms that closes on a soft object (17 N/s) reaches any command within 0.3 s."""
_LONGEST_S = 3 * PERIOD_S
"""Longest time that the force may change for at once: a late command does not make up for those before it."""
_MEMORY = 240
Values: TypeAlias = float | Float[np.ndarray, " contacts"]


class SlipGate:
    """Passes each detected slip of some contacts once, unless the skin springs back for another reason.

    While the fingers close, and within `SPRINGS_BACK_S` after the grip was loosened, the markers move back as in a
    slip.
    """

    def __init__(self) -> None:
        self._slipping: np.bool | Bool[np.ndarray, " contacts"] = np.bool(False)

    def update(
        self, slip: bool | Bool[np.ndarray, " contacts"], *, since_touch_s: Values, force_n: Values, earlier_n: Values
    ) -> np.bool | Bool[np.ndarray, " contacts"]:
        """Return True where a slip begins, from the grip force now and `SPRINGS_BACK_S` ago."""
        slip = np.logical_and(slip, np.greater(since_touch_s, _CLOSING_S))
        begins = slip & ~self._slipping & ~np.less(force_n, np.multiply(0.99, earlier_n))
        self._slipping = slip
        return begins


@dataclass(frozen=True, kw_only=True)
class GripCommand:
    """Grip force to command, and its reason."""

    command_n: float
    """Grip force to press with."""
    margin: float
    """Predicted margin, the mean of the fingertips that have one; NaN without a margin."""
    low: float
    """Lower end of its interval, in margin units."""
    slip: bool
    """True where the markers showed a slip since the last command."""
    why: str
    trouble: str | None = None
    """Fault of the measured force; None while it follows the commands."""


class Holder:
    """Turns the readings of one or two running fingertips into grip forces, command after command.

    A reading counts for half a second, with the grip force at the time of its frame; it may come from another thread.
    A slip counts once (`SlipGate`). The controller's time begins at the first touch.

    Three laws hold for every controller. Without a margin, or below the target margin (that of a `MarginLaw` for a
    controller without `target`), the force never falls. Without a measured force, or where it differs from the command
    by more than 30 % for more than 0.5 s, the last command is repeated until the force follows again; a slip in that
    time counts afterwards. A controller that returns NaN holds.
    """

    def __init__(
        self,
        controller: str | Controller,
        *,
        settings: Mapping[str, float] | None = None,
        ceiling_n: float,
        command_n: float = 0.0,
        fingers: int = 1,
    ) -> None:
        self._settings, self._ceiling_n, self._command_n = settings, ceiling_n, command_n
        self._lock, self._friction_known = Lock(), False
        self._with_friction = [False] * fingers
        """True for each fingertip whose last margin used a friction."""
        self._readings: list[tuple[Reading, float] | None] = [None] * fingers
        """Newest reading of each fingertip, and the time of its frame."""
        self._gates, self._slip = [SlipGate() for _ in range(fingers)], False
        self._past: deque[tuple[float, float, float, float]] = deque(maxlen=_MEMORY)
        """Times of commands, forces and loads measured then, and the command until then."""
        self._touched_s: float | None = None
        self._follows_s, self._trouble = -np.inf, None
        self.choose(controller)

    @property
    def touched(self) -> bool:
        """True after the first measured grip force."""
        return self._touched_s is not None

    def choose(self, controller: str | Controller) -> None:
        """Use another controller from now on."""
        self._chosen = controller
        if isinstance(controller, str):
            controller = make_controller(controller, self._settings, friction_known=self._friction_known)
        self.controller = controller

    def update_reading(self, reading: Reading, *, taken_s: float, finger: int = 0) -> None:
        """Take the reading of a frame that was taken at a time on the clock of the commands."""
        with self._lock:
            # a withheld reading does not show whether the friction is known
            if reading.margin is not None:
                self._with_friction[finger] = reading.friction is not None
                if self._friction_known != all(self._with_friction):
                    self._friction_known = not self._friction_known
                    self._update_constants()
            # a slip is judged by commands: the measured force is too noisy to show a slightly looser grip
            self._slip |= bool(
                self._gates[finger].update(
                    reading.slip is SlipState.SLIP,
                    since_touch_s=-1.0 if self._touched_s is None else taken_s - self._touched_s,
                    force_n=self._at(taken_s)[2],
                    earlier_n=self._at(taken_s - SPRINGS_BACK_S)[2],
                )
            )
            self._readings[finger] = reading, taken_s

    def _update_constants(self) -> None:
        """Switch a named margin law to the constants for a known or unknown friction; its state goes on."""
        before = self.controller
        if isinstance(self._chosen, str) and isinstance(before, MarginLaw):
            self.choose(self._chosen)
            for item in fields(before):
                if not item.init and item.name != "_zero":  # r_0 belongs to the readings before
                    setattr(self.controller, item.name, getattr(before, item.name))

    def grip_force(self, time_s: float, force_n: float, *, load_n: float = np.nan) -> GripCommand:
        """Return the grip force to command now, from the force measured now; NaN where none is measured."""
        with self._lock:
            since_s = min(time_s - self._past[-1][0], _LONGEST_S) if self._past else PERIOD_S
            if self._touched_s is None and force_n > _TOUCH_N:
                self._touched_s = self._follows_s = time_s
            differs = self._compare(time_s, force_n)
            trouble = None if np.isnan(force_n) else self._trouble
            if differs:
                force_n = min(force_n, self._command_n)  # no gripper presses harder so soon after a command
            self._past.append((time_s, force_n, load_n, self._command_n))
            fresh = [item if item and time_s - item[1] <= STALE_S else None for item in self._readings]
            measured = [self._at(item[1])[:2] for item in fresh if item]
            then_n, load_n = np.mean(measured, axis=0).tolist() if measured else (force_n, load_n)
            margin, low, true_margin = (
                np.resize(np.array([getattr(item[0], name) if item else None for item in fresh], dtype=float), (1, 2))
                for name in ("margin", "low", "true_margin")
            )
            low, blind = np.where(np.isnan(low), margin, low), bool(np.isnan(margin).all())
            mean, lowest = (np.nan, np.nan) if blind else (float(np.nanmean(margin)), float(np.nanmean(low)))
            unmeasured = np.isnan(force_n) or (not blind and np.isnan(then_n))
            if unmeasured or trouble is not None:
                reason = "no force is measured" if unmeasured else "the measured force does not follow the commands"
                return GripCommand(
                    command_n=self._command_n, margin=mean, low=lowest, slip=False, why=f"{reason}: holds",
                    trouble=trouble,
                )  # fmt: skip
            slip, self._slip = self._slip, False
            observation = Observation(
                time_s=0.0 if self._touched_s is None else time_s - self._touched_s,
                force_n=np.array([force_n if np.isnan(then_n) else then_n]),
                command_n=np.array([self._command_n]),
                load_n=np.array([load_n]),
                margin=margin,
                low=low,
                slip=np.array([slip]),
                true_margin=true_margin,
                since_s=since_s,
            )
            command_n = float(np.asarray(self.controller.command(observation))[0])
            acted = float(self.controller.acted[0]) if isinstance(self.controller, MarginLaw) else mean
            below = acted < getattr(self.controller, "target", MarginLaw.target)
            if np.isnan(command_n) or ((blind or below or differs) and command_n < self._command_n):
                command_n = self._command_n
            command_n = min(max(command_n, 0.0), self._ceiling_n)
            why = self._explain(command_n, slip=slip, blind=blind)
            self._command_n = command_n
            return GripCommand(command_n=command_n, margin=mean, low=lowest, slip=slip, why=why)

    def _compare(self, time_s: float, force_n: float) -> bool:
        """Return True where the measured force differs from the command; note a fault that lasts in `_trouble`."""
        if self._touched_s is None or np.isnan(force_n):
            return False
        differs = abs(force_n - self._command_n) > max(_DIFFERS * self._command_n, _DIFFERS_N)
        if not differs:
            self._follows_s, self._trouble = time_s, None
        elif self._trouble is None and time_s - self._follows_s > _DIFFERS_S:
            self._trouble = (
                f"the gripper measures {force_n:.3g} N where {self._command_n:.3g} N is commanded, for more than "
                f"{_DIFFERS_S:g} s; check its force sensor and the unit of its forces"
            )
        return differs

    def _at(self, time_s: float) -> tuple[float, float, float]:
        """Interpolate force, load and command at a time; NaN before the first."""
        if not self._past or np.isnan(time_s):
            return np.nan, np.nan, np.nan
        times, *rows = np.array(self._past).T
        force_n, load_n, command_n = (float(np.interp(time_s, times, row)) for row in rows)
        return force_n, load_n, command_n

    def _explain(self, command_n: float, *, slip: bool, blind: bool) -> str:
        change_n = command_n - self._command_n
        action = "holds" if abs(change_n) < 1e-3 else "tightens" if change_n > 0 else "loosens"
        action = "presses as hard as it may" if command_n == self._ceiling_n else action
        if slip:
            return f"the markers show a slip: {action}"
        if blind:
            return f"no margin: {action}"
        if isinstance(self.controller, MarginLaw):
            return f"aims at a margin of {100 * float(self.controller.aim[0]):.0f} %: {action}"
        return action
