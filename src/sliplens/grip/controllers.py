"""Controllers of the grip force: laws on the safety margin, and grips without one to compare with."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from sliplens.errors import InputError
from sliplens.extras import Table
from sliplens.grip.plant import PERIOD_S, Episodes

_SETTLED_S = 1.0  # time until which the object is being lifted and no grip is loosened
_NOISE, _NOISE_SHARE = 0.06, 0.3
"""A margin that differs by less from the last one may be noise (two standard deviations), and moves it by this share:
as a grip tightens fast and loosens slowly, noise would press harder."""
_NO_MARGIN = -9.0  # before the first margin, which counts in full
_HIGHEST_ZERO = 0.6  # largest margin at which a slip counts: with more it is a jolt that ended
_SAME_SLIP_S = 0.15  # time after a slip in which another one is the same
_HORIZON_S = 0.1  # age of margins at a command, roughly: the law gives the force so long ahead


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
    start_n: float = 1.5

    def command(self, observation: Observation, /) -> Episodes:
        """Return the grip force in newtons."""
        force_n = np.maximum(observation.load_n, 0) / (2 * self.friction * (1 - self.target))
        return np.maximum(force_n, self.start_n if observation.time_s < _SETTLED_S else 0.0)


@dataclass(kw_only=True)
class MarginLaw:
    """F* = F (1 - Gamma) / (1 - Gamma*): the force at which the same load would leave the target margin.

    Around the law: dead band, fast up and slow down, reflex, and a safe force without margins.

    The controller acts on r = margin - caution (margin - low), the mean over the fingers that have a margin. A network
    that cannot see the friction predicts more than 0 for an object that already slides, so the margin is Gamma = (r -
    r_0) / (1 - r_0): r_0 is `zero` until a slip, and then the r at which the fingers began to slide, if that is more.
    """

    target: float = 0.3
    """Target margin Gamma*, as a share of the friction: 0.3 presses 43 % more than the least force that holds."""
    caution: float = 0.0
    """Share of the way from the margin to the lower end of its interval; with 1 a `zero` of 0.2 and a `target` of 0.1
    suit."""
    zero: float = 0.5
    """r_0 before any slip, a share: the prediction that is possible where the object already slides."""
    start_n: float = 2.0
    """Force to lift with."""
    least_n: float = 0.5
    """Lowest force: with less the network sees no touch."""
    dead_band: float = 0.05
    """Share of the force within which nothing changes."""
    up_n_s: float = 40.0
    """Largest rise of the force, in newtons a second."""
    down_n_s: float = 5.0
    """Largest fall of the force, in newtons a second."""
    boost: float = 1.5
    """Force after a slip over that before it, a ratio."""
    calm_s: float = 1.0
    """Time after a slip in which the grip is never loosened."""
    blind_s: float = 0.15
    """Time without any margin after which the force goes to `safe_n`; until then it holds."""
    safe_n: float = 2.5
    """Force without margins: no more, for beyond it frames are unknown to the network, and their margins withheld."""
    acted: Episodes = field(init=False, repr=False, default_factory=lambda: np.ones(1))
    """Margin acted on last in each episode, a share."""
    _zero: Episodes = field(init=False, repr=False, default_factory=lambda: np.zeros(1))
    _last: Episodes = field(init=False, repr=False, default_factory=lambda: np.full(1, _NO_MARGIN))
    _slipped_s: Episodes = field(init=False, repr=False, default_factory=lambda: np.full(1, -np.inf))
    _margin_s: Episodes = field(init=False, repr=False, default_factory=lambda: np.zeros(1))

    def law(self, force_n: Episodes, margin: Episodes) -> Episodes:
        """Return the grip force in newtons for a margin, a share."""
        return force_n * (1 - margin) / (1 - self.target)

    @property
    def aim(self) -> Episodes:
        """Predicted margin at which Gamma is the target: r_0 + (1 - r_0) Gamma*, a share."""
        return self._zero + (1 - self._zero) * self.target

    def margin_of(self, observation: Observation) -> Episodes:
        """Return the margin to act on, a share; NaN without a margin."""
        margin = observation.margin - self.caution * (observation.margin - observation.low)
        valid = np.isfinite(margin)
        mean = np.where(valid, margin, 0).sum(axis=1) / np.where(valid.any(axis=1), valid.sum(axis=1), np.nan)
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
        goal = np.where(blind, before_n, self.law(observation.force_n, self.acted))
        goal = np.where(np.abs(goal - before_n) < self.dead_band * before_n, before_n, goal)
        calm = (time_s - self._slipped_s < self.calm_s) | (time_s < _SETTLED_S)
        goal = np.where(calm, np.maximum(goal, before_n), goal)
        goal = np.where(time_s - self._margin_s > self.blind_s, np.maximum(goal, self.safe_n), goal)
        up, down = self.up_n_s * observation.since_s, self.down_n_s * observation.since_s
        force_n = np.clip(goal, before_n - down, before_n + up)
        # below the target a falling force comes from a wrong measurement
        force_n = np.where(self.acted < self.target, np.maximum(force_n, before_n), force_n)
        # the reflex has no limit of rate
        force_n = np.where(slip, np.maximum(force_n, self.boost * np.maximum(observation.force_n, before_n)), force_n)
        return np.maximum(force_n, self.start_n if time_s < _SETTLED_S else self.least_n)


@dataclass(kw_only=True)
class ProportionalLaw(MarginLaw):
    """dF/dt = K (Gamma* - Gamma): the force grows as long as the margin is below the target."""

    gain_n_s: float = 20.0
    """K, in newtons a second for a margin of 1."""

    def law(self, force_n: Episodes, margin: Episodes) -> Episodes:
        """Return the grip force in newtons."""
        return force_n + self.gain_n_s * (self.target - margin) * _HORIZON_S


@dataclass(kw_only=True)
class Reflex:
    """F = const until a slip, then `boost` times as much, again and again: markers alone, no margin."""

    start_n: float = 1.0
    boost: float = 1.5
    """Force after a slip over that before it, a ratio."""
    _slipped_s: Episodes = field(init=False, repr=False, default_factory=lambda: np.full(1, -np.inf))

    def command(self, observation: Observation, /) -> Episodes:
        """Return the grip force in newtons."""
        slip = observation.slip & (observation.time_s - self._slipped_s > _SAME_SLIP_S)
        self._slipped_s = np.where(slip, observation.time_s, self._slipped_s)
        force_n = np.maximum(observation.command_n, self.start_n)
        return np.where(slip, self.boost * force_n, force_n)


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
        "proportional": ProportionalLaw,
        "reflex": Reflex,
        "oracle": Oracle,
    },
)
"""Controllers by name; an installed package adds its own by the entry point `sliplens.controllers`."""
FRICTION_CONSTANTS = {"zero": 0.0, "target": 0.6}
"""Constants of the margin laws where the friction is known: the prediction is then the margin itself."""


def make_controller(
    name: str, settings: Mapping[str, float] | None = None, *, friction_known: bool = False
) -> Controller:
    """Create a controller of `CONTROLLERS`.

    Examples
    --------
    >>> from sliplens.grip.controllers import make_controller
    >>> make_controller("fixed", {"force_n": 1.5})
    FixedForce(force_n=1.5)
    """
    kind, settings = CONTROLLERS.pick(name), dict(settings or {})
    if friction_known and issubclass(kind, MarginLaw):
        settings = FRICTION_CONSTANTS | settings
    constants = [field.name for field in fields(kind) if field.init]  # pyright: ignore[reportArgumentType]
    for constant, value in settings.items():
        if constant not in constants:
            raise InputError(f"the controller {name} has no constant {constant!r}; choose of {', '.join(constants)}")
        if not np.isfinite(value) or value < 0:
            raise InputError(f"{constant} of the controller {name} must be a number not below 0, got {value:g}")
    if settings.get("target", 0) >= 1 or settings.get("zero", 0) >= 1:
        raise InputError("margins are shares of the friction: give a target and a zero below 1")
    return kind(**settings)
