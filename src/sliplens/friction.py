"""What is known of the coefficient of friction: told exactly, within a range, or learnt from slips."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from sliplens.errors import InputError
from sliplens.files import hash_json

__all__ = ["Friction", "FrictionLike", "SlipLearner", "as_friction"]

LOWEST, HIGHEST = 0.05, 2.0
"""Coefficients between which friction is looked for where only slips tell it: ice on steel to clean rubber on glass."""
GRASP_SPREAD = 0.06
"""Standard deviation of an object's friction from one grasp to the next, as a share of it: the trials of a simulated
day lie evenly within a tenth of its friction."""
MOST_FRICTION = 20.0
"""Larger than the coefficient of anything that slides: beyond, something sticks, or the number is none."""
LEARNT = "learnt from slips"
"""Note of friction that slips told."""
_REACH = 4.0
"""Standard deviations to either side within which friction of a mean and a spread is held possible."""
_NODES = 400
"""Over two decades a step is then 1 %, finer than any slip tells."""
_NEGLIGIBLE = 1e-6


def require_friction(value: float) -> None:
    """Check that a coefficient of friction can be one."""
    if not 0 < value <= MOST_FRICTION:
        raise InputError(
            f"a coefficient of friction is a positive number up to {MOST_FRICTION:g}, got {value:g}; give F_t / F_n at "
            "which the object slips, such as 0.6"
        )


@dataclass(frozen=True, eq=False)
class Friction:
    """A coefficient of friction mu, as far as it is known: values and how likely each is.

    `Friction(0.62)` is known exactly, `Friction.between(0.5, 0.8)` lies anywhere in a range,
    `Friction.about(0.58, 0.05)` has a mean and a standard deviation, and `Friction.from_slips([0.58])` was learnt from
    slips seen before on the same object.

    Parameters
    ----------
    values
        Coefficient of static friction: one number, or several of which any may be right.
    weights
        How likely each value is, as a share: they are scaled to sum to 1, and are even if None.
    note
        Where it comes from, for tables and pages.

    Raises
    ------
    InputError
        If a value is not positive and finite, or weights are negative, all zero or of another number.

    Examples
    --------
    >>> from sliplens.friction import Friction
    >>> str(Friction(0.62)), str(Friction.between(0.5, 0.8))
    ('0.62, told exactly', '0.5 to 0.8, told as a range')
    >>> learnt = Friction.from_slips([0.58], sigma=0.03)
    >>> round(learnt.mean, 2), round(learnt.sigma, 2)
    (0.58, 0.06)
    """

    values: Float[np.ndarray, " values"] | float
    weights: Float[np.ndarray, " values"] | None = None
    note: str = field(default="told exactly", kw_only=True)

    def __post_init__(self) -> None:
        values = np.atleast_1d(np.asarray(self.values, dtype=np.float64))
        weights = np.ones(len(values)) if self.weights is None else np.asarray(self.weights, dtype=np.float64)
        for value in values.tolist():
            require_friction(value)
        if weights.shape != values.shape or not (np.all(weights >= 0) and 0 < weights.sum() < math.inf):
            raise InputError(f"{len(values)} values of friction need as many weights, none negative and not all zero")
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "weights", weights / weights.sum())

    @classmethod
    def between(cls, low: float, high: float, *, values: int = 41) -> "Friction":
        """Friction anywhere in a range, evenly; at so many values, each in the middle of its share of the range."""
        if not 0 < low < high <= MOST_FRICTION:
            raise InputError(
                f"a range of friction runs from a positive low to a larger high, at most {MOST_FRICTION:g}, got "
                f"{low:g}..{high:g}; give the smaller number first, such as 0.5..0.8"
            )
        middles = low + (high - low) * (np.arange(values) + 0.5) / values
        return cls(middles, note=f"{low:g} to {high:g}, told as a range")

    @classmethod
    def about(cls, mean: float, sigma: float, *, values: int = 81) -> "Friction":
        """Friction of a mean and a standard deviation, normal in the logarithm, where none becomes negative."""
        if not (0 < mean <= MOST_FRICTION and 0 < sigma < mean):
            raise InputError(
                "mean and standard deviation of friction are positive, the mean the larger and at most "
                f"{MOST_FRICTION:g}, got {mean:g}+-{sigma:g}; give such as 0.58+-0.05, or the mean alone"
            )
        spread = math.sqrt(math.log1p((sigma / mean) ** 2))
        steps = np.linspace(-_REACH, _REACH, values)
        nodes = mean * np.exp(spread * steps - spread**2 / 2)
        kept = nodes <= MOST_FRICTION
        return cls(nodes[kept], np.exp(-0.5 * steps[kept] ** 2), note="told with its spread")

    @classmethod
    def from_slips(
        cls,
        ratios: Sequence[float] | Float[np.ndarray, " slips"],
        *,
        sigma: float = 0.05,
        grasp_spread: float = GRASP_SPREAD,
        prior: "Friction | None" = None,
    ) -> "Friction":
        """Friction of the next grasp of an object that slipped in earlier ones.

        At gross slip F_t / F_n is the friction of that grasp, which differs from the object's by a Gaussian share, as
        that of the next grasp will.

        Parameters
        ----------
        ratios
            F_t / F_n at which the object slipped, one a grasp: errors within a grasp are alike.
        sigma
            Standard deviation of each such ratio, as it was read.
        grasp_spread
            Standard deviation of friction from one grasp to the next, as a share of it.
        prior
            What was known of the object before; evenly anything (in the logarithm) if None.
        """
        seen = np.asarray(ratios, dtype=np.float64)
        known = _anything(seen) if prior is None else prior
        for ratio in seen.tolist():
            known = known.update(ratio, math.hypot(sigma, grasp_spread * ratio))
        return known.next_grasp(grasp_spread)

    def update(self, ratio: float, sigma: float) -> "Friction":
        """Friction after a gross slip at F_t / F_n = `ratio`, read with the standard deviation `sigma` (Bayes' rule).

        What is known exactly stays; a slip far outside what was held possible leaves the value nearest to it.
        """
        if not (math.isfinite(ratio) and ratio > 0 and math.isfinite(sigma) and sigma > 0):
            raise InputError(f"a slip is told by a positive ratio F_t / F_n and its sigma, got {ratio:g} and {sigma:g}")
        values, weights = self.nodes
        exponent = -0.5 * ((values - ratio) / sigma) ** 2
        with np.errstate(divide="ignore"):
            posterior = np.log(weights) + exponent
        posterior = np.exp(posterior - posterior.max())
        return Friction(values, posterior, note=LEARNT)._without_negligible()

    def next_grasp(self, spread: float = GRASP_SPREAD) -> "Friction":
        """Friction of another grasp of the same object, which differs by a Gaussian share of deviation `spread`."""
        if not 0 <= spread < 1:
            raise InputError(f"the spread from grasp to grasp is a share of the friction, from 0 to 1, got {spread:g}")
        if spread == 0:
            return self
        # in the logarithm, where no friction becomes negative
        values, weights = self.nodes
        grid, _ = _anything(values, spread=spread).nodes
        share = np.exp(-0.5 * (np.log(grid / values[:, None]) / spread) ** 2)
        moved = weights @ (share / np.maximum(share.sum(axis=1, keepdims=True), 1e-300))
        return Friction(grid, moved, note=self.note)._without_negligible()

    def _without_negligible(self) -> "Friction":
        """The same without values that are a million times less likely than the likeliest."""
        values, weights = self.nodes
        kept = weights > _NEGLIGIBLE * weights.max()
        return Friction(values[kept], weights[kept], note=self.note)

    @property
    def nodes(self) -> tuple[Float[np.ndarray, " values"], Float[np.ndarray, " values"]]:
        """Values and their weights, which sum to 1."""
        assert isinstance(self.values, np.ndarray)
        assert self.weights is not None
        return self.values, self.weights

    @property
    def mean(self) -> float:
        """Expected coefficient of friction."""
        values, weights = self.nodes
        return float(values @ weights)

    @property
    def sigma(self) -> float:
        """Standard deviation of the coefficient of friction."""
        values, weights = self.nodes
        return float(np.sqrt(weights @ (values - self.mean) ** 2))

    @property
    def text(self) -> str:
        """Mean and standard deviation as `as_friction` and `--friction` take them, such as 0.58+-0.05."""
        return f"{self.mean:.3g}+-{self.sigma:.2g}" if self.sigma > 0 else f"{self.mean:.6g}"

    @property
    def digest(self) -> str:
        """Hash of all that is known, which `text` rounds: the same only for the same friction."""
        return hash_json([part.tolist() for part in self.nodes])

    def __str__(self) -> str:
        if self.note.endswith("range"):
            return self.note
        known = f"{self.mean:.3g} +- {self.sigma:.2g}" if len(self.nodes[0]) > 1 else f"{self.mean:.6g}"
        return f"{known}, {self.note}"


class SlipLearner:
    """Friction of what is held, as the first gross slip of each grasp teaches it.

    As a contact begins to slip, F_t / F_n is the static friction; what is read while it slides is less. So a slip is
    told together with the time since it began, and the ratio that was read last before counts, if that is at most
    0.3 s older: with no such reading a slip teaches nothing. Later slips of the same contact teach nothing either: what
    a network reads wrong of a contact it reads wrong alike at each of them, so that they would make it surer and no
    better.

    Nobody sees whether the next grasp is of the same object. So what a slip taught ends with its grasp, unless it was
    said that the object stays the same: then it counts in the next ones, a little less surely. Where nothing was told,
    it counts from the next grasp on, so that a controller's constants do not change while it answers the slip.

    Parameters
    ----------
    friction
        What is known beforehand; what is known exactly stays so. None where nothing is.
    same_object
        Whether all grasps are of one object.

    Examples
    --------
    >>> from sliplens.friction import Friction, SlipLearner
    >>> learner = SlipLearner(Friction.between(0.2, 1.0), same_object=True)
    >>> for tick in range(10):
    ...     learner.note(0.06 * tick, sigma=0.03, time_s=0.1 * tick)
    >>> learner.update(0.95, slipping_s=0.2)
    >>> str(learner.friction)
    '0.42 +- 0.03, learnt from slips'
    >>> learner.release()
    >>> learner.friction.text  # another grasp
    '0.421+-0.039'
    """

    def __init__(self, friction: Friction | None = None, *, same_object: bool = False) -> None:
        self.friction = self._told = friction
        """What is known of the friction of this grasp; None where nothing is."""
        self.learnt: Friction | None = None
        """What slips taught of the object that slipped last, for a grasp to come; None before any."""
        self.slips = 0
        """How many slips that was learnt from."""
        self.same_object = same_object
        self._read: deque[tuple[float, float, float]] = deque(maxlen=_KEPT)
        self._slipped = False

    def note(self, ratio: float, *, sigma: float, time_s: float) -> None:
        """Keep a ratio F_t / F_n that was read, and its standard deviation."""
        self._read.append((time_s, ratio, sigma))

    def update(self, time_s: float, *, slipping_s: float | None, touches: bool = True) -> None:
        """Learn from whether the contact slips now, and since how many seconds; None where it holds."""
        if slipping_s is not None and not self._slipped:
            began_s = time_s - slipping_s
            before = [(ratio, sigma) for then_s, ratio, sigma in self._read if 0 <= began_s - then_s <= _FRESH_S]
            known = _anything() if self.friction is None else self.friction
            if before and before[-1][0] > 0 and len(known.nodes[0]) > 1:
                slipped, self._slipped = known.update(*before[-1]), True
                self.learnt, self.slips = slipped.next_grasp(), self.slips + 1 if self.same_object else 1
                if self.friction is not None:
                    self.friction = slipped
        if not touches:
            self.release()

    def release(self) -> None:
        """Let the object go: the next contact is another grasp."""
        self._read.clear()
        if self._slipped:
            self.friction = self.learnt if self.same_object else self._told
            self._slipped = False


_KEPT = 120
"""Readings that are kept: longer than any slip takes to be told."""
_FRESH_S = 0.3
"""Time before a slip within which a ratio is that of its beginning. Frames may be withheld while the pull grows, and
an older ratio would teach too little friction."""


FrictionLike: TypeAlias = Friction | float | tuple[float, float] | str
"""Friction as a caller may give it: `Friction`, one number, (low, high), or as text 0.62, 0.5..0.8 or 0.58+-0.05."""


def as_friction(told: FrictionLike) -> Friction:
    """Coefficient of friction from what a caller gave.

    Raises
    ------
    InputError
        If it is none.

    Examples
    --------
    >>> from sliplens.friction import as_friction
    >>> str(as_friction("0.5..0.8")), str(as_friction("0.58+-0.05"))
    ('0.5 to 0.8, told as a range', '0.58 +- 0.05, told with its spread')
    """
    if isinstance(told, Friction):
        return told
    about = isinstance(told, str) and "+-" in told
    parts = (
        told.split("+-" if about else "..") if isinstance(told, str) else told if isinstance(told, tuple) else (told,)
    )
    try:
        numbers = [float(part) for part in parts]
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) not in {1, 2}:
        raise InputError(
            f"{told!r} is no friction; give a number such as 0.62, a range such as 0.5..0.8, or mean and spread such "
            "as 0.58+-0.05"
        )
    if len(numbers) == 1:
        return Friction(numbers[0])
    return Friction.about(*numbers) if about else Friction.between(*numbers)


def _anything(near: Float[np.ndarray, " values"] | None = None, *, spread: float = GRASP_SPREAD) -> Friction:
    """Friction of which nothing is known, evenly in the logarithm; also what lies within a spread of some values."""
    low, high = LOWEST, HIGHEST
    if near is not None and len(near) and np.all((near > 0) & np.isfinite(near)):
        low = min(low, float(near.min()) * math.exp(-_REACH * spread))
        high = min(MOST_FRICTION, max(high, float(near.max()) * math.exp(_REACH * spread)))
    return Friction(np.geomspace(low, high, _NODES), note="not told")
