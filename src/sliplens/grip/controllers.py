"""Controllers of the grip force: what to press with, told from what the fingertips read."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from sliplens.errors import InputError
from sliplens.extras import Table
from sliplens.grip.plant import PERIOD_S


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


@runtime_checkable
class Controller(Protocol):
    """Tells a grip force, one command an image; made anew for each batch of episodes, it may remember."""

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
    trained_n: float = 2.25
    """Normal force up to which the network reads as it was trained to; its training ended at 2 N."""
    sag_per_n: float = 0.18
    """Share of the margin by which it reads too low for each newton beyond (measured up to 4 N)."""
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

    def margin_of(self, seen: Observation) -> Float[np.ndarray, " episodes"]:
        """Margin to act on, a share; NaN where no finger reads."""
        margin = seen.margin - self.caution * (seen.margin - seen.low)
        margin = margin / (1 - self.sag_per_n * np.maximum(seen.force_n - self.trained_n, 0))[:, None]
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
        up, down = self.up_n_s * PERIOD_S, self.down_n_s * PERIOD_S
        told = np.clip(wanted, seen.command_n - down, seen.command_n + up)
        # a reflex knows no rate
        told = np.where(slip, np.maximum(told, self.boost * seen.force_n), told)
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
