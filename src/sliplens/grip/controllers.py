"""Controllers of the grip force: what to press with, told from what the fingertips read."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from threading import Lock
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from sliplens.errors import InputError
from sliplens.extras import Table
from sliplens.grip.plant import PERIOD_S
from sliplens.live.reading import Reading, SlipState


@dataclass(frozen=True, kw_only=True)
class Observation:
    """What a controller knows at one moment; arrays hold one value an episode, or one an episode and finger.

    Readings are as old as the network's latency; `force_n` is the force of the moment they were seen, so that a margin
    is never paired with another force than its own.
    """

    time_s: float
    """Time now, from the first closing of the fingers."""
    force_n: Float[np.ndarray, " episodes"]
    """Grip force measured when the images were taken."""
    command_n: Float[np.ndarray, " episodes"]
    """Grip force told last."""
    load_n: Float[np.ndarray, " episodes"]
    """What a force sensor at the wrist told at that moment: weight and pull."""
    margin: Float[np.ndarray, "episodes 2"]
    """Safety margin read; NaN where a reading is withheld."""
    low: Float[np.ndarray, "episodes 2"]
    """Lower end of its interval."""
    slip: Bool[np.ndarray, " episodes"]
    """Whether the markers of a finger jumped back, as they do when it begins to slide."""
    true_margin: Float[np.ndarray, "episodes 2"] | None = None
    """Margin as it is, for the oracle; None outside a simulation."""
    since_s: float = PERIOD_S
    """Time since the command before, which bounds how far the force may go from it."""


@runtime_checkable
class Controller(Protocol):
    """Tells a grip force, one command an image; made anew for each batch of episodes and grasp, it may remember."""

    def command(self, seen: Observation) -> Float[np.ndarray, " episodes"]:
        """Grip force to press with, in newtons."""
        ...


@dataclass(kw_only=True)
class FixedForce:
    """F = const, whatever is read: the careful grip that all others have to beat."""

    force_n: float = 2.5

    def command(self, seen: Observation) -> Float[np.ndarray, " episodes"]:
        """Grip force in newtons."""
        return np.full_like(seen.force_n, self.force_n)


@dataclass(kw_only=True)
class AssumedFriction:
    """F = W / (2 mu_0 (1 - Gamma*)): the load W of a wrist sensor, and a friction mu_0 that is taken for granted."""

    friction: float = 0.3
    """Coefficient of friction mu_0 that is assumed."""
    target: float = 0.2
    """Margin Gamma* aimed at, as a share."""
    start_n: float = 1.5

    def command(self, seen: Observation) -> Float[np.ndarray, " episodes"]:
        """Grip force in newtons."""
        wanted = np.maximum(seen.load_n, 0) / (2 * self.friction * (1 - self.target))
        return np.maximum(wanted, self.start_n if seen.time_s < _SETTLED_S else 0.0)


_SETTLED_S = 1.0
"""Until then the object is being lifted, and no grip is loosened."""


@dataclass(kw_only=True)
class MarginGrip(ABC):
    """What grips on the margin share: caution, dead band, fast up and slow down, reflex, and what to do when blind.

    What is acted on is r = read - caution (read - low), the mean over the fingers that read; with a caution of 1 it is
    the lower end of the interval. A reading that differs from the last one by no more than noise moves it little. A
    network that cannot see the friction reads more than 0 of a slippery object that already slides, so the margin is
    Gamma = (r - r_0) / (1 - r_0): r_0 is a guess until a slip, and then what was read as the fingers began to slide, if
    that is more. After a slip nothing is loosened for a while.
    """

    target: float = 0.3
    """Margin Gamma* aimed at, as a share of the friction: 0.3 presses 43 % more than the least force that holds."""
    caution: float = 0.0
    """Share of the way from the margin read to the lower end of its interval; with 1 a `zero` of 0.2 and a `target` of
    0.1 suit."""
    zero: float = 0.5
    """r_0 before any slip, a share: what may be read where the object already slides."""
    start_n: float = 2.0
    """Force to lift with."""
    least_n: float = 0.5
    """Force never loosened below: with less the network sees no touch."""
    dead_band: float = 0.05
    """Share of the force within which nothing changes."""
    up_n_s: float = 40.0
    """Newtons a second that the force may grow by."""
    down_n_s: float = 5.0
    """Newtons a second that it may fall by."""
    boost: float = 1.5
    """Force after a slip over that before it, a ratio."""
    calm_s: float = 1.0
    """Time after a slip in which nothing is loosened."""
    blind_s: float = 0.15
    """Time without any reading after which the force goes to `safe_n`; until then it holds."""
    safe_n: float = 2.5
    """Force to go to then: no more, for beyond it the network sees frames that it does not know, and stays blind."""
    acted: np.ndarray = field(init=False, repr=False, default_factory=lambda: np.ones(1))
    """Margin acted on last in each episode, a share."""
    _zero: np.ndarray = field(init=False, default_factory=lambda: np.zeros(1))
    _last: np.ndarray = field(init=False, default_factory=lambda: np.full(1, _NOTHING_YET))
    _slipped_s: np.ndarray = field(init=False, default_factory=lambda: np.full(1, -np.inf))
    _seen_s: np.ndarray = field(init=False, default_factory=lambda: np.zeros(1))

    @abstractmethod
    def law(
        self, force_n: Float[np.ndarray, " episodes"], margin: Float[np.ndarray, " episodes"]
    ) -> Float[np.ndarray, " episodes"]:
        """Grip force in newtons that a margin, a share, asks for."""

    @property
    def aim(self) -> Float[np.ndarray, " episodes"]:
        """Margin read at which Gamma is the target: r_0 + (1 - r_0) Gamma*, a share."""
        return self._zero + (1 - self._zero) * self.target

    def margin_of(self, seen: Observation) -> Float[np.ndarray, " episodes"]:
        """Margin to act on, a share; NaN where no finger reads."""
        margin = seen.margin - self.caution * (seen.margin - seen.low)
        reads = np.isfinite(margin)
        read = np.where(reads, margin, 0).sum(axis=1) / np.where(reads.any(axis=1), reads.sum(axis=1), np.nan)
        change = read - self._last
        return np.where(np.abs(change) < _NEWS, self._last + _FOLLOWS * change, read)

    def command(self, seen: Observation) -> Float[np.ndarray, " episodes"]:
        """Grip force in newtons."""
        margin = self.margin_of(seen)
        blind = np.isnan(margin)
        self._seen_s = np.where(blind, self._seen_s, seen.time_s)
        slip = seen.slip & (seen.time_s - self._slipped_s > _DEAF_S)
        self._slipped_s = np.where(slip, seen.time_s, self._slipped_s)
        self._zero = np.maximum(self._zero, np.where(slip, np.minimum(self._last, _HIGHEST_ZERO), self.zero))
        self._last = np.where(blind, self._last, margin)
        self.acted = np.clip((margin - self._zero) / (1 - self._zero), -1, 1)
        wanted = self.law(seen.force_n, self.acted)
        wanted = np.where(blind, seen.command_n, wanted)
        wanted = np.where(np.abs(wanted - seen.command_n) < self.dead_band * seen.command_n, seen.command_n, wanted)
        calm = (seen.time_s - self._slipped_s < self.calm_s) | (seen.time_s < _SETTLED_S)
        wanted = np.where(calm, np.maximum(wanted, seen.command_n), wanted)
        wanted = np.where(seen.time_s - self._seen_s > self.blind_s, np.maximum(wanted, self.safe_n), wanted)
        up, down = self.up_n_s * seen.since_s, self.down_n_s * seen.since_s
        told = np.clip(wanted, seen.command_n - down, seen.command_n + up)
        # whatever force was measured: below the margin aimed at, a force that falls is one that was measured wrong
        told = np.where(self.acted < self.target, np.maximum(told, seen.command_n), told)
        # a reflex knows no rate
        told = np.where(slip, np.maximum(told, self.boost * np.maximum(seen.force_n, seen.command_n)), told)
        return np.maximum(told, self.start_n if seen.time_s < _SETTLED_S else self.least_n)


_NEWS, _FOLLOWS = 0.06, 0.3
"""A margin read that differs by less than this from what was acted on may be noise, of which two standard deviations
are as much: it moves that by this share. As a grip tightens fast and loosens slowly, noise would press harder."""
_NOTHING_YET = -9.0
"""No margin: the first one is acted on as it is."""
_HIGHEST_ZERO = 0.6
"""A slip at which more is read is taken for something else: a jolt that ended."""
_DEAF_S = 0.15
"""Time after a slip in which another one is the same."""


@dataclass(kw_only=True)
class MarginLaw(MarginGrip):
    """F* = F (1 - Gamma) / (1 - Gamma*): the force at which the same load would leave the margin aimed at."""

    def law(
        self, force_n: Float[np.ndarray, " episodes"], margin: Float[np.ndarray, " episodes"]
    ) -> Float[np.ndarray, " episodes"]:
        """Grip force in newtons that a margin, a share, asks for."""
        return force_n * (1 - margin) / (1 - self.target)


@dataclass(kw_only=True)
class ProportionalLaw(MarginGrip):
    """dF/dt = K (Gamma* - Gamma): the force grows as long as the margin is below the one aimed at."""

    gain_n_s: float = 20.0
    """K, in newtons a second for a margin of 1."""

    def law(
        self, force_n: Float[np.ndarray, " episodes"], margin: Float[np.ndarray, " episodes"]
    ) -> Float[np.ndarray, " episodes"]:
        """Grip force in newtons that a margin, a share, asks for."""
        return force_n + self.gain_n_s * (self.target - margin) * _HORIZON_S


_HORIZON_S = 0.1
"""Readings are older than a command by about this much: the force asked for is that of so long a time on."""


@dataclass(kw_only=True)
class Reflex:
    """F = const until a slip, then `boost` times as much, again and again: no margin, markers alone."""

    start_n: float = 1.0
    boost: float = 1.5
    """Force after a slip over that before it, a ratio."""
    _slipped_s: np.ndarray = field(init=False, default_factory=lambda: np.full(1, -np.inf))

    def command(self, seen: Observation) -> Float[np.ndarray, " episodes"]:
        """Grip force in newtons."""
        slip = seen.slip & (seen.time_s - self._slipped_s > _DEAF_S)
        self._slipped_s = np.where(slip, seen.time_s, self._slipped_s)
        kept = np.maximum(seen.command_n, self.start_n)
        return np.where(slip, self.boost * kept, kept)


@dataclass(kw_only=True)
class Oracle(MarginLaw):
    """The margin law on the true margin, as old as a reading: the best that any network could do for it."""

    target: float = 0.6
    zero: float = 0.0

    def margin_of(self, seen: Observation) -> Float[np.ndarray, " episodes"]:
        """True margin, a share; the lesser of both fingers."""
        assert seen.true_margin is not None
        return seen.true_margin.min(axis=1)


CONTROLLERS = Table(
    "controller",
    "sliplens.controllers",
    {
        "fixed": FixedForce,
        "assumed-friction": AssumedFriction,
        "margin": MarginLaw,
        "proportional": ProportionalLaw,
        "reflex": Reflex,
        "oracle": Oracle,
    },
)
"""Controllers by name; an installed package adds its own by the entry point `sliplens.controllers`."""


TOLD = {"zero": 0.0, "target": 0.6}
"""Constants of the laws on the margin where the friction is told: what is read is then the margin itself."""


def make_controller(name: str, settings: Mapping[str, float] | None = None, *, told: bool = False) -> Controller:
    """Make a controller of the table, some of its constants changed; `told`: readings know the friction.

    Raises
    ------
    InputError
        If there is no such controller, or it has no such constant.

    Examples
    --------
    >>> from sliplens.grip import make_controller
    >>> make_controller("fixed", {"force_n": 1.5})
    FixedForce(force_n=1.5)
    """
    kind, settings = CONTROLLERS.pick(name), dict(settings or {})
    if told and issubclass(kind, MarginGrip):
        settings = TOLD | settings
    known = [field.name for field in fields(kind) if field.init]  # pyright: ignore[reportArgumentType]
    for one, value in settings.items():
        if one not in known:
            raise InputError(f"the controller {name} has no constant {one!r}; choose of {', '.join(known)}")
        if not np.isfinite(value) or value < 0:
            raise InputError(f"{one} of the controller {name} must be a number not below 0, got {value:g}")
    if settings.get("target", 0) >= 1 or settings.get("zero", 0) >= 1:
        raise InputError("margins are shares of the friction: give a target and a zero below 1")
    return kind(**settings)


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What is commanded, and why."""

    command_n: float
    """Grip force to press with."""
    margin: float
    """Margin read, the mean of the fingertips that read; NaN where none does."""
    low: float
    """Lower end of its interval, in margin units."""
    slip: bool
    """Whether the markers told a slip since the command before."""
    why: str
    trouble: str | None = None
    """What is wrong with the measured force; None where it follows the commands."""


class SlipGate:
    """Passes each detected slip of some contacts once, where the skin did not spring back for another reason.

    While the fingers close, and where the grip was loosened within the last `SPRINGS_BACK_S`, the markers move back as
    they do in a slip.
    """

    def __init__(self) -> None:
        self._slipping: np.bool | Bool[np.ndarray, " contacts"] = np.bool(False)

    def update(
        self,
        slip: bool | Bool[np.ndarray, " contacts"],
        *,
        since_touch_s: float | Float[np.ndarray, " contacts"],
        force_n: float | Float[np.ndarray, " contacts"],
        earlier_n: float | Float[np.ndarray, " contacts"],
    ) -> Any:
        """Whether a slip begins that counts, from the grip force of the frame and the one `SPRINGS_BACK_S` before."""
        slip = np.logical_and(slip, np.greater(since_touch_s, _CLOSING_S))
        begins = slip & ~self._slipping & ~np.less(force_n, np.multiply(0.99, earlier_n))
        self._slipping = slip
        return begins


SPRINGS_BACK_S = 0.25
"""Time within which the markers tell of skin that springs back."""
_CLOSING_S = 0.5
"""Time after the first touch in which the markers move because the fingers close."""


class Holder:
    """Answers the readings of one or two running fingertips with a grip force, command after command.

    A reading counts for half a second, with the grip force of the moment in which its frame was taken. A slip that the
    markers tell counts once; while the fingers close, or the grip is loosened, skin that springs back looks the same,
    and does not count. The controller's time begins at the first touch. Readings may be heard in other threads.

    Three laws hold for every controller. Without a margin, or below the margin aimed at (that of a `MarginLaw` where
    the controller has no `target`), the force never falls. Where no force is measured, or the measured one differs from
    the command by more than 30 % for more than 0.5 s, the last command is repeated until the force follows again; a
    slip in that time is answered afterwards. A controller that says no number holds.

    Parameters
    ----------
    controller
        Row of `CONTROLLERS`, made to suit what the readings know of the friction, or a controller of your own.
    settings
        Constants of a row to change, in its units (newtons, seconds, shares).
    ceiling_n
        Grip force that is never passed.
    command_n
        Grip force that was told before.
    fingers
        How many fingertips read: 1 or 2.
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
        self._settings, self._ceiling, self._command = settings, ceiling_n, command_n
        self._lock, self._knows_friction = Lock(), False
        self._told = [False] * fingers  # whether the readings of each know a friction
        self._heard: list[tuple[Reading, float] | None] = [None] * fingers
        self._gates, self._slip = [SlipGate() for _ in range(fingers)], False
        self._past: deque[tuple[float, float, float, float]] = deque(maxlen=_MEMORY)
        """Times of the last commands; grip force and load measured then, and the command that held until then."""
        self._touched_s: float | None = None
        self._follows_s, self._trouble = -np.inf, None
        self.choose(controller)

    @property
    def touched(self) -> bool:
        """Whether a grip force was measured yet."""
        return self._touched_s is not None

    def choose(self, controller: str | Controller) -> None:
        """Have another controller answer from now on."""
        self._chosen = controller
        self._controller = (
            make_controller(controller, self._settings, told=self._knows_friction)
            if isinstance(controller, str)
            else controller
        )

    def hear(self, reading: Reading, *, taken_s: float, finger: int = 0) -> None:
        """Take what a fingertip read of a frame that was taken at a time, on the clock of the commands."""
        with self._lock:
            # a reading that is withheld tells no friction either
            if reading.margin is not None:
                self._told[finger] = reading.friction is not None
                if self._knows_friction != all(self._told):
                    self._knows_friction = not self._knows_friction
                    self._suit()
            self._slip |= self._gates[finger].update(
                reading.slip is SlipState.SLIP,
                since_touch_s=-1.0 if self._touched_s is None else taken_s - self._touched_s,
                # a measured force is too noisy to show that the grip was loosened a little
                force_n=self._at(taken_s)[2],
                earlier_n=self._at(taken_s - SPRINGS_BACK_S)[2],
            )
            self._heard[finger] = reading, taken_s

    def _suit(self) -> None:
        """Take the constants that suit what the readings now know of the friction; the grip goes on where it was."""
        before = self._controller
        if not (isinstance(self._chosen, str) and isinstance(before, MarginGrip)):
            return  # no other controller asks for the friction
        self.choose(self._chosen)
        for one in fields(before):
            if not one.init and one.name != "_zero":  # r_0 is of readings that knew as much
                setattr(self._controller, one.name, getattr(before, one.name))

    def answer(self, time_s: float, force_n: float, *, load_n: float = np.nan) -> Answer:
        """Grip force to command at a time, from the force measured now; NaN where nothing is measured."""
        with self._lock:
            before_s = self._past[-1][0] if self._past else time_s - PERIOD_S
            if self._touched_s is None and force_n > _TOUCH_N:
                self._touched_s = self._follows_s = time_s
            differs, trouble = self._compare(time_s, force_n)
            if differs and force_n > self._command:
                force_n = self._command  # no gripper presses harder than it was told so soon after
            self._past.append((time_s, force_n, load_n, self._command))
            heard = [one if one and time_s - one[1] <= STALE_S else None for one in self._heard]
            measured = [self._at(one[1])[:2] for one in heard if one]
            then_n, load_n = np.mean(measured, axis=0).tolist() if measured else (force_n, load_n)
            margin, low, true_margin = (
                np.resize([_value(one[0], name) if one else np.nan for one in heard], (1, 2))
                for name in ("margin", "low", "true_margin")
            )
            low, blind = np.where(np.isnan(low), margin, low), bool(np.isnan(margin).all())
            read, lowest = (np.nan, np.nan) if blind else (float(np.nanmean(margin)), float(np.nanmean(low)))
            unmeasured = np.isnan(force_n) or (not blind and np.isnan(then_n))
            if unmeasured or trouble is not None:
                reason = "no force is measured" if unmeasured else "the measured force does not follow the commands"
                return Answer(
                    command_n=self._command,
                    margin=read,
                    low=lowest,
                    slip=False,
                    why=f"{reason}: holds",
                    trouble=trouble,
                )
            slip, self._slip = bool(self._slip), False
            seen = Observation(
                time_s=0.0 if self._touched_s is None else time_s - self._touched_s,
                force_n=np.array([force_n if np.isnan(then_n) else then_n]),
                command_n=np.array([self._command]),
                load_n=np.array([load_n]),
                margin=margin,
                low=low,
                slip=np.array([slip]),
                true_margin=true_margin,
                since_s=min(time_s - before_s, _LONGEST_S),
            )
            command_n = float(np.asarray(self._controller.command(seen))[0])
            acted = float(self._controller.acted[0]) if isinstance(self._controller, MarginGrip) else read
            below = acted < getattr(self._controller, "target", MarginLaw.target)
            if np.isnan(command_n) or ((blind or below or differs) and command_n < self._command):
                command_n = self._command
            command_n = min(max(command_n, 0.0), self._ceiling)
            change, self._command = command_n - self._command, command_n
            why = self._why(change, slip=slip, blind=blind)
            return Answer(command_n=command_n, margin=read, low=lowest, slip=slip, why=why)

    def _compare(self, time_s: float, force_n: float) -> tuple[bool, str | None]:
        """Compare the measured force with the command: whether they differ now, and the trouble if that lasts."""
        if self._touched_s is None or np.isnan(force_n):
            return False, None
        differs = abs(force_n - self._command) > max(_DIFFERS * self._command, _DIFFERS_N)
        if not differs:
            self._follows_s, self._trouble = time_s, None
        elif self._trouble is None and time_s - self._follows_s > _DIFFERS_S:
            self._trouble = (
                f"the gripper measures {force_n:.3g} N where {self._command:.3g} N is commanded, for more than "
                f"{_DIFFERS_S:g} s; check its force sensor and the unit of its forces"
            )
        return differs, self._trouble

    def _at(self, time_s: float) -> tuple[float, float, float]:
        """Measured grip force, measured load and command at a time; NaN where there was none."""
        if not self._past or np.isnan(time_s):
            return np.nan, np.nan, np.nan
        times, *rows = np.array(self._past).T
        force_n, load_n, command_n = (float(np.interp(time_s, times, row)) for row in rows)
        return force_n, load_n, command_n

    def _why(self, change_n: float, *, slip: bool, blind: bool) -> str:
        does = "holds" if abs(change_n) < 1e-3 else "tightens" if change_n > 0 else "loosens"
        does = "presses as hard as it may" if self._command == self._ceiling else does
        if slip:
            return f"the markers told a slip: {does}"
        if blind:
            return f"no margin is read: {does}"
        if isinstance(self._controller, MarginGrip):
            aim = 100 * float(self._controller.aim[0])
            return f"aims at a margin of {aim:.0f} %: {does}"
        return does


def _value(reading: Reading, name: str) -> float:
    value = getattr(reading, name)
    return np.nan if value is None else value


STALE_S = 0.5
"""Age from which a reading says nothing of now."""
_TOUCH_N = 0.02
"""Grip force that is a touch."""
_DIFFERS, _DIFFERS_N, _DIFFERS_S = 0.3, 0.1, 0.5
"""Share of the command, least force, and time from which a measured force that differs so much is a trouble. An
actuator with a lag of 50 ms that closes on a soft object (17 N/s) is there within 0.3 s of any command."""
_LONGEST_S = 3 * PERIOD_S
"""Time that the force may change for at once: what a slow gripper missed is not made up for."""
_MEMORY = 240
