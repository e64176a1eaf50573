"""Controllers of the grip force, and the holder by which one acts on running fingertips."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from threading import Lock
from typing import Protocol, TypeAlias, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from sliplens.errors import InputError
from sliplens.extras import Table
from sliplens.grip.plant import PERIOD_S, Episodes
from sliplens.live.reading import Reading, SlipState, describe_reading

_SETTLED_S = 1.0  # time until which the object is being lifted and no grip is loosened
_START_N, _REFLEX_N, _ASSUMED_N = 2.0, 1.0, 1.5  # forces to lift with, of the margin law and the two others
_NOISE, _NOISE_SHARE = 0.06, 0.3
"""A margin that differs by less from the last one may be noise (two standard deviations), and moves it by this share:
as a grip tightens fast and loosens slowly, noise would press harder."""
_NO_MARGIN = -9.0  # before the first margin, which counts in full
_HIGHEST_ZERO = 0.6  # largest margin at which a slip counts: with more it is a jolt that ended
_SAME_SLIP_S = 0.15  # time after a slip in which another one is the same
_CALM_S = 1.0  # time after a slip in which the grip is never loosened
_BOOST = 1.5  # force after a slip over that before it
_DEAD_BAND = 0.05  # share of the force within which nothing changes
_UP_N_S, _DOWN_N_S = 40.0, 5.0  # largest rise and fall of the force
_BLIND_S, _SAFE_N = 0.15, 2.5
"""Time without any margin after which the force goes to the second number; until then it holds. With more force,
frames are unknown to the network, and their margins withheld."""


@dataclass(frozen=True, kw_only=True)
class Observation:
    """Input of a controller at one moment; arrays hold one value an episode, or one an episode and finger.

    Margins are as old as the network's latency; `force_n` is the force at the time of their images, so that a margin is
    never paired with another force than its own.
    """

    time_s: float
    """Time now, from the first closing of the fingers."""
    force_n: Float[np.ndarray, " episodes"]
    """Grip force measured when the images were taken."""
    command_n: Float[np.ndarray, " episodes"]
    """Last grip force commanded."""
    load_n: Float[np.ndarray, " episodes"]
    """Load on a force sensor at the wrist at that moment: weight and pull."""
    margin: Float[np.ndarray, "episodes 2"]
    """Predicted safety margin; NaN where it is withheld."""
    low: Float[np.ndarray, "episodes 2"]
    """Lower end of its interval."""
    slip: Bool[np.ndarray, " episodes"]
    """True where the markers of a finger spring back, as they do when it begins to slide."""
    true_margin: Float[np.ndarray, "episodes 2"] | None = None
    """True margin, for the oracle; None outside a simulation."""
    since_s: float = PERIOD_S
    """Time since the last command, which bounds the change of the force."""


@runtime_checkable
class Controller(Protocol):
    """Chooses the grip force, once an image; may keep state, for each batch of episodes and grasp gets a new one."""

    def command(self, observation: Observation, /) -> Episodes:
        """Return the grip force to press with, in newtons."""
        ...


@dataclass(kw_only=True)
class FixedForce:
    """F = const, whatever the margin: the careful grip that all others have to beat."""

    force_n: float = 2.5

    def command(self, observation: Observation, /) -> Episodes:
        """Return the grip force in newtons."""
        return np.full_like(observation.force_n, self.force_n)


@dataclass(kw_only=True)
class AssumedFriction:
    """F = W / (2 mu_0 (1 - Gamma*)): the load W of a wrist sensor, and an assumed friction mu_0."""

    friction: float = 0.3
    """Assumed coefficient of friction mu_0."""
    target: float = 0.2
    """Target margin Gamma*, as a share."""

    def command(self, observation: Observation, /) -> Episodes:
        """Return the grip force in newtons."""
        force_n = np.maximum(observation.load_n, 0) / (2 * self.friction * (1 - self.target))
        return np.maximum(force_n, _ASSUMED_N if observation.time_s < _SETTLED_S else 0.0)


@dataclass(kw_only=True)
class MarginLaw:
    """F* = F (1 - Gamma) / (1 - Gamma*): the force at which the same load would leave the target margin.

    Around the law: dead band, fast up and slow down, reflex, and a safe force without margins.

    The controller acts on r, the mean margin of the fingers that have one. A network that cannot see the friction
    predicts more than 0 for an object that already slides, so the margin is Gamma = (r - r_0) / (1 - r_0): r_0 is
    `zero` until a slip, and then the r at which the fingers began to slide, if that is more.
    """

    target: float = 0.3
    """Target margin Gamma*, as a share of the friction: 0.3 presses 43 % more than the least force that holds."""
    zero: float = 0.5
    """r_0 before any slip, a share: the prediction that is possible where the object already slides."""
    least_n: float = 0.5
    """Lowest force: with less the network sees no touch."""
    # state, not constants: without a type it is no field
    acted = np.ones(1)
    """Margin acted on last in each episode, a share."""
    _zero, _last, _margin_s, _slipped_s = np.zeros(1), np.full(1, _NO_MARGIN), np.zeros(1), np.full(1, -np.inf)

    @property
    def aim(self) -> Episodes:
        """Predicted margin at which Gamma is the target: r_0 + (1 - r_0) Gamma*, a share."""
        return self._zero + (1 - self._zero) * self.target

    def margin_of(self, observation: Observation) -> Episodes:
        """Return the margin to act on, a share; NaN without a margin."""
        valid = np.isfinite(observation.margin)
        mean = np.where(valid, observation.margin, 0).sum(axis=1) / np.where(
            valid.any(axis=1), valid.sum(axis=1), np.nan
        )
        change = mean - self._last
        return np.where(np.abs(change) < _NOISE, self._last + _NOISE_SHARE * change, mean)

    def command(self, observation: Observation, /) -> Episodes:
        """Return the grip force in newtons."""
        margin, time_s, before_n = self.margin_of(observation), observation.time_s, observation.command_n
        blind = np.isnan(margin)
        self._margin_s = np.where(blind, self._margin_s, time_s)
        slip = observation.slip & (time_s - self._slipped_s > _SAME_SLIP_S)
        self._slipped_s = np.where(slip, time_s, self._slipped_s)
        self._zero = np.maximum(self._zero, np.where(slip, np.minimum(self._last, _HIGHEST_ZERO), self.zero))
        self._last = np.where(blind, self._last, margin)
        self.acted = np.clip((margin - self._zero) / (1 - self._zero), -1, 1)
        goal = np.where(blind, before_n, observation.force_n * (1 - self.acted) / (1 - self.target))
        goal = np.where(np.abs(goal - before_n) < _DEAD_BAND * before_n, before_n, goal)
        calm = (time_s - self._slipped_s < _CALM_S) | (time_s < _SETTLED_S)
        goal = np.where(calm, np.maximum(goal, before_n), goal)
        goal = np.where(time_s - self._margin_s > _BLIND_S, np.maximum(goal, _SAFE_N), goal)
        up, down = _UP_N_S * observation.since_s, _DOWN_N_S * observation.since_s
        force_n = np.clip(goal, before_n - down, before_n + up)
        # below the target a falling force comes from a wrong measurement
        force_n = np.where(self.acted < self.target, np.maximum(force_n, before_n), force_n)
        # the reflex has no limit of rate
        force_n = np.where(slip, np.maximum(force_n, _BOOST * np.maximum(observation.force_n, before_n)), force_n)
        return np.maximum(force_n, _START_N if time_s < _SETTLED_S else self.least_n)


@dataclass(kw_only=True)
class Reflex:
    """F = const until a slip, then 1.5 times as much, again and again: markers alone, no margin."""

    _slipped_s = np.full(1, -np.inf)

    def command(self, observation: Observation, /) -> Episodes:
        """Return the grip force in newtons."""
        slip = observation.slip & (observation.time_s - self._slipped_s > _SAME_SLIP_S)
        self._slipped_s = np.where(slip, observation.time_s, self._slipped_s)
        force_n = np.maximum(observation.command_n, _REFLEX_N)
        return np.where(slip, _BOOST * force_n, force_n)


@dataclass(kw_only=True)
class Oracle(MarginLaw):
    """Margin law on the true margin, as old as a prediction: the best that any network could do for it."""

    target: float = 0.6
    zero: float = 0.0

    def margin_of(self, observation: Observation) -> Episodes:
        """Return the true margin, a share; the smaller of both fingers."""
        assert observation.true_margin is not None
        return observation.true_margin.min(axis=1)


CONTROLLERS = Table(
    "controller",
    "sliplens.controllers",
    {
        "fixed": FixedForce,
        "assumed-friction": AssumedFriction,
        "margin": MarginLaw,
        "reflex": Reflex,
        "oracle": Oracle,
    },
)
"""Controllers by name; an installed package adds its own by the entry point `sliplens.controllers`."""


def make_controller(
    controller: str | Controller, settings: Mapping[str, float] | None = None, *, friction_known: bool = False
) -> Controller:
    """Create a controller of `CONTROLLERS`; another one is returned as it is.

    Examples
    --------
    >>> from sliplens.grip.controllers import make_controller
    >>> make_controller("fixed", {"force_n": 1.5})
    FixedForce(force_n=1.5)
    """
    if not isinstance(controller, str):
        if settings:
            raise InputError("settings change a controller of the table; set those of your own where you make it")
        return controller
    kind, settings = CONTROLLERS.pick(controller), dict(settings or {})
    if friction_known and issubclass(kind, MarginLaw):
        settings = {"zero": 0.0, "target": 0.6} | settings  # the prediction is then the margin itself
    constants = [item.name for item in fields(kind) if item.init]  # pyright: ignore[reportArgumentType]
    for constant, value in settings.items():
        if constant not in constants:
            raise InputError(f"controller {controller} has no constant {constant!r}; choose of {', '.join(constants)}")
        if not np.isfinite(value) or value < 0:
            raise InputError(f"{constant} of the controller {controller} must be a number not below 0, got {value:g}")
    if settings.get("target", 0) >= 1 or settings.get("zero", 0) >= 1:
        raise InputError("margins are shares of the friction: give a target and a zero below 1")
    return kind(**settings)


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
_TOO_OLD = {"margin": None, "low": None, "high": None, "withheld": "the newest margin is too old"}
Values: TypeAlias = float | Float[np.ndarray, " contacts"]


class SlipGate:
    """Passes each detected slip of some contacts once, unless the skin springs back for another reason.

    While the fingers close, and within `SPRINGS_BACK_S` after the grip was loosened, the markers move back as in a
    slip.
    """

    _slipping: np.bool | Bool[np.ndarray, " contacts"] = np.bool(False)

    def update(
        self, slip: bool | Bool[np.ndarray, " contacts"], *, since_touch_s: Values, force_n: Values, earlier_n: Values
    ) -> np.bool | Bool[np.ndarray, " contacts"]:
        """Return True where a slip begins, from the grip force now and `SPRINGS_BACK_S` ago."""
        slip = np.logical_and(slip, np.greater(since_touch_s, _CLOSING_S))
        begins = slip & ~self._slipping & ~np.less(force_n, np.multiply(0.99, earlier_n))
        self._slipping = slip
        return begins


@dataclass(frozen=True, kw_only=True)
class HoldStep:
    """One command to a gripper, its reason, and the readings behind it."""

    command_n: float
    """Grip force to press with."""
    margin: float
    """Predicted margin, the mean of the fingertips that have one; NaN without a margin."""
    low: float
    """Lower end of its interval, in margin units."""
    slip: bool
    """True where the markers showed a slip since the last command."""
    why: str
    trouble: str | None
    """Fault of the gripper or its measured force; None while it follows the commands."""
    time_s: float
    """Time since the hold began."""
    force_n: float
    """Grip force that the gripper measured before; NaN without a measurement."""
    readings: tuple[Reading | None, ...]
    """Newest reading of each fingertip; None before the first."""

    def __str__(self) -> str:
        several = len(self.readings) > 1
        words = [
            (f"fingertip {number}: " if several else "") + str(describe_reading(reading))
            for number, reading in enumerate(self.readings, start=1)
            if reading is not None
        ]
        forces = f"{self.time_s:8.2f} s  {self.command_n:5.2f} N commanded, {self.force_n:5.2f} N measured"
        return "; ".join([f"{forces}  {self.why}", *words])


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
        self._with_friction = [False] * fingers  # true for each fingertip whose last margin used a friction
        self._readings: list[tuple[Reading, float] | None] = [None] * fingers
        """Newest reading of each fingertip, and the time of its frame."""
        self._gates, self._slip = [SlipGate() for _ in range(fingers)], False
        self._past: deque[tuple[float, float, float, float]] = deque(maxlen=_MEMORY)
        """Times of commands, forces and loads measured then, and the command until then."""
        self.touched_s: float | None = None
        """Time of the first measured grip force."""
        self._follows_s, self._trouble = -np.inf, None
        self.choose(controller)

    def choose(self, controller: str | Controller) -> None:
        """Use another controller from now on."""
        self._chosen = controller
        self.controller = make_controller(controller, self._settings, friction_known=self._friction_known)

    def update_reading(self, reading: Reading, *, taken_s: float, finger: int = 0) -> None:
        """Take the reading of a frame that was taken at a time on the clock of the commands."""
        with self._lock:
            # a withheld reading does not show whether the friction is known
            if reading.margin is not None:
                self._with_friction[finger] = reading.friction is not None
                if self._friction_known != all(self._with_friction):
                    self._friction_known, law = not self._friction_known, self.controller
                    if isinstance(self._chosen, str) and isinstance(law, MarginLaw):
                        self.choose(self._chosen)
                        # the state goes on, but r_0 belongs to the readings before
                        for name in ("acted", "_last", "_slipped_s", "_margin_s"):
                            setattr(self.controller, name, getattr(law, name))
            # a slip is judged by commands: the measured force is too noisy to show a slightly looser grip
            self._slip |= bool(
                self._gates[finger].update(
                    reading.slip is SlipState.SLIP,
                    since_touch_s=-1.0 if self.touched_s is None else taken_s - self.touched_s,
                    force_n=self._at(taken_s)[2],
                    earlier_n=self._at(taken_s - SPRINGS_BACK_S)[2],
                )
            )
            self._readings[finger] = reading, taken_s

    def grip_force(self, time_s: float, force_n: float, *, load_n: float = np.nan) -> HoldStep:
        """Return the grip force to command now, from the force measured now; NaN where none is measured."""
        measured_n = force_n
        with self._lock:
            since_s = min(time_s - self._past[-1][0], _LONGEST_S) if self._past else PERIOD_S
            if self.touched_s is None and force_n > _TOUCH_N:
                self.touched_s = self._follows_s = time_s
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
            readings = tuple(
                item and (item[0] if new or item[0].margin is None else replace(item[0], **_TOO_OLD))
                for item, new in zip(self._readings, fresh, strict=True)
            )
            unmeasured = np.isnan(force_n) or (not blind and np.isnan(then_n))
            reason = "no force is measured" if unmeasured else "the measured force does not follow the commands"
            step = HoldStep(
                command_n=self._command_n, margin=mean, low=lowest, slip=False, why=f"{reason}: holds", trouble=trouble,
                time_s=time_s, force_n=measured_n, readings=readings,
            )  # fmt: skip
            if unmeasured or trouble is not None:
                return step
            slip, self._slip = self._slip, False
            observation = Observation(
                time_s=0.0 if self.touched_s is None else time_s - self.touched_s,
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
            return replace(step, command_n=command_n, slip=slip, why=why)

    def _compare(self, time_s: float, force_n: float) -> bool:
        """Return True where the measured force differs from the command; note a fault that lasts in `_trouble`."""
        if self.touched_s is None or np.isnan(force_n):
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
