"""Knowledge of the coefficient of friction: exact, a range, or learnt from slips."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from sliplens.errors import InputError
from sliplens.files import hash_json

GRASP_SPREAD = 0.06
"""Standard deviation of an object's friction from grasp to grasp, as a share of it; measured on simulated days."""
MOST_FRICTION = 20.0
"""Largest coefficient: with more, something sticks, or the number is wrong."""
LEARNT = "learnt from slips"
"""Note of friction learnt from slips."""
_LOWEST, _HIGHEST = 0.05, 2.0  # unknown friction: ice on steel to clean rubber on glass
_REACH = 4.0  # standard deviations to either side that a distribution of friction covers
_NODES = 400  # values over two decades, in steps of 1 %: finer than any slip shows
_MOST_RATIOS, _FRESH_S = 120, 0.3  # ratios in memory; largest age of a ratio at a slip: an older one is too small


@dataclass(frozen=True, eq=False)
class Friction:
    """A coefficient of friction mu, with its uncertainty: possible values and their probabilities.

    `Friction(0.62)` is exact, `Friction.between(0.5, 0.8)` lies anywhere in a range, `Friction.about(0.58, 0.05)` has a
    mean and a standard deviation, and `Friction.from_slips([0.58])` is learnt from earlier slips of the same object.

    Parameters
    ----------
    values
        Coefficient of static friction: one number, or several possible ones.
    weights
        Probability of each value, scaled to sum to 1; equal if None.
    note
        Origin, for tables and pages.

    See Also
    --------
    predict : Takes a friction, for networks that predict F_t / F_n.

    Examples
    --------
    >>> from sliplens.friction import Friction
    >>> str(Friction(0.62)), str(Friction.between(0.5, 0.8))
    ('0.62, exact', '0.5 to 0.8, range')
    >>> learnt = Friction.from_slips([0.58], sigma=0.03)
    >>> round(learnt.mean, 2), round(learnt.sigma, 2)
    (0.58, 0.06)
    """

    values: Float[np.ndarray, " values"] | float
    weights: Float[np.ndarray, " values"] | None = None
    note: str = field(default="exact", kw_only=True)

    def __post_init__(self) -> None:
        values = np.atleast_1d(np.asarray(self.values, dtype=np.float64))
        weights = np.ones(len(values)) if self.weights is None else np.asarray(self.weights, dtype=np.float64)
        if not np.all(possible := (values > 0) & (values <= MOST_FRICTION)):
            wrong = f"a coefficient of friction is positive, up to {MOST_FRICTION:g}, got {values[~possible][0]:g}"
            raise InputError(f"{wrong}; give F_t / F_n at which the object slips, such as 0.6")
        if weights.shape != values.shape or not (np.all(weights >= 0) and 0 < weights.sum() < math.inf):
            raise InputError(f"{len(values)} values of friction need as many weights, none negative and not all zero")
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "weights", weights / weights.sum())

    @classmethod
    def between(cls, low: float, high: float, *, values: int = 41) -> "Friction":
        """Friction evenly distributed in a range, at the middles of equal shares of it."""
        if not 0 < low < high <= MOST_FRICTION:
            wrong = f"a range of friction rises, from above 0 to at most {MOST_FRICTION:g}, got {low:g}..{high:g}"
            raise InputError(f"{wrong}; give the smaller number first, such as 0.5..0.8")
        middles = low + (high - low) * (np.arange(values) + 0.5) / values
        return cls(middles, note=f"{low:g} to {high:g}, range")

    @classmethod
    def about(cls, mean: float, sigma: float) -> "Friction":
        """Friction with a mean and a standard deviation, normal in the logarithm and so never negative."""
        if not (0 < mean <= MOST_FRICTION and 0 < sigma < mean):
            wrong = f"mean and spread of friction are positive, the mean is larger, got {mean:g}+-{sigma:g}"
            raise InputError(f"{wrong}; give such as 0.58+-0.05, the mean up to {MOST_FRICTION:g} or alone")
        spread = math.sqrt(math.log1p((sigma / mean) ** 2))
        steps = np.linspace(-_REACH, _REACH, 81)
        nodes = mean * np.exp(spread * steps - spread**2 / 2)
        possible = nodes <= MOST_FRICTION
        return cls(nodes[possible], np.exp(-0.5 * steps[possible] ** 2), note="mean and spread")

    @classmethod
    def from_slips(cls, ratios: Sequence[float] | Float[np.ndarray, " slips"], *, sigma: float = 0.05) -> "Friction":
        """Friction of the next grasp of an object that slipped in earlier ones.

        At gross slip F_t / F_n is the friction of that grasp, which differs from the object's by a Gaussian share
        (`GRASP_SPREAD`), as that of the next grasp will. Before the slips it is even in the logarithm.

        Parameters
        ----------
        ratios
            F_t / F_n at which the object slipped, one a grasp: errors within a grasp are correlated.
        sigma
            Standard deviation of each ratio.
        """
        ratios = np.asarray(ratios, dtype=np.float64)
        friction = _unknown(cls(ratios).nodes[0] if len(ratios) else None)
        for ratio in ratios.tolist():
            friction = friction.update(ratio, math.hypot(sigma, GRASP_SPREAD * ratio))
        return friction.next_grasp()

    def update(self, ratio: float, sigma: float) -> "Friction":
        """Update by a gross slip at F_t / F_n = `ratio`, predicted with the standard deviation `sigma` (Bayes' rule).

        Exact friction stays; a slip far outside the possible values leaves the nearest of them.
        """
        if not (0 < ratio < math.inf and 0 < sigma < math.inf):
            raise InputError(f"a slip needs a positive ratio F_t / F_n and sigma, got {ratio:g} and {sigma:g}")
        values, weights = self.nodes
        with np.errstate(divide="ignore"):
            posterior = np.log(weights) - 0.5 * ((values - ratio) / sigma) ** 2
        return _likely(values, np.exp(posterior - posterior.max()), note=LEARNT)

    def next_grasp(self) -> "Friction":
        """Friction of another grasp of the same object, whose share differs with `GRASP_SPREAD`."""
        # in the logarithm, where no friction becomes negative
        values, weights = self.nodes
        grid, _ = _unknown(values).nodes
        share = np.exp(-0.5 * (np.log(grid / values[:, None]) / GRASP_SPREAD) ** 2)
        moved = weights @ (share / np.maximum(share.sum(axis=1, keepdims=True), 1e-300))
        return _likely(grid, moved, note=self.note)

    @property
    def nodes(self) -> tuple[Float[np.ndarray, " values"], Float[np.ndarray, " values"]]:
        """Possible values, and their weights, which sum to 1."""
        assert isinstance(self.values, np.ndarray)
        assert self.weights is not None
        return self.values, self.weights

    @property
    def mean(self) -> float:
        """Expected coefficient of friction."""
        return float(np.dot(*self.nodes))

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
        """Hash of values and weights, which `text` rounds: equal only for equal friction."""
        return hash_json([part.tolist() for part in self.nodes])

    def __str__(self) -> str:
        if self.note.endswith("range"):
            return self.note
        number = f"{self.mean:.3g} +- {self.sigma:.2g}" if len(self.nodes[0]) > 1 else f"{self.mean:.6g}"
        return f"{number}, {self.note}"


class SlipLearner:
    """Friction of the object in the grip, learnt from the first gross slip of each grasp.

    The last ratio F_t / F_n before the beginning of the slip counts, if it is at most 0.3 s older: while the contact
    slides, the ratio is less. Later slips of the same contact would reduce the uncertainty and not the network's error.
    The learnt friction ends with its grasp, unless `same_object` is set: then it counts in the next grasps, with a
    slightly larger uncertainty. Without friction beforehand it counts from the next grasp on, so that a controller's
    constants do not change during its reaction to the slip.

    Parameters
    ----------
    friction
        Friction beforehand; exact friction stays. None if it is unknown.
    same_object
        If True, all grasps are of one object.

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
        self.friction = self._first = friction
        """Friction of this grasp; None if it is unknown."""
        self.learnt: Friction | None = None
        """Friction of the next grasp of the last object that slipped; None before a slip."""
        self.slips = 0
        """Number of slips that it was learnt from."""
        self.same_object = same_object
        self._ratios: deque[tuple[float, float, float]] = deque(maxlen=_MOST_RATIOS)
        self._slipped = False

    def note(self, ratio: float, *, sigma: float, time_s: float) -> None:
        """Take a predicted ratio F_t / F_n, and its standard deviation."""
        self._ratios.append((time_s, ratio, sigma))

    def update(self, time_s: float, *, slipping_s: float | None, touches: bool = True) -> None:
        """Learn from a slip that began some seconds ago; None where the contact holds."""
        if slipping_s is not None and not self._slipped:
            began_s = time_s - slipping_s
            before = [(ratio, sigma) for then_s, ratio, sigma in self._ratios if 0 <= began_s - then_s <= _FRESH_S]
            prior = _unknown() if self.friction is None else self.friction
            if before and before[-1][0] > 0 and len(prior.nodes[0]) > 1:
                slipped, self._slipped = prior.update(*before[-1]), True
                self.learnt, self.slips = slipped.next_grasp(), self.slips + 1 if self.same_object else 1
                if self.friction is not None:
                    self.friction = slipped
        if not touches:
            self.release()

    def release(self) -> None:
        """End the grasp: the next contact is another one."""
        self._ratios.clear()
        if self._slipped:
            self.friction = self.learnt if self.same_object else self._first
            self._slipped = False


FrictionLike: TypeAlias = Friction | float | tuple[float, float] | str
"""Friction as a parameter: `Friction`, one number, (low, high), or as text 0.62, 0.5..0.8 or 0.58+-0.05."""


def as_friction(friction: FrictionLike) -> Friction:
    """Convert a number, range or text to a coefficient of friction.

    Examples
    --------
    >>> from sliplens.friction import as_friction
    >>> str(as_friction("0.5..0.8")), str(as_friction("0.58+-0.05"))
    ('0.5 to 0.8, range', '0.58 +- 0.05, mean and spread')
    """
    if isinstance(friction, Friction):
        return friction
    about = isinstance(friction, str) and "+-" in friction
    parts = friction if isinstance(friction, tuple) else str(friction).split("+-" if about else "..")
    makers = {1: Friction, 2: Friction.about if about else Friction.between}
    try:
        numbers = [float(part) for part in parts]
        make = makers[len(numbers)]
    except (TypeError, ValueError, KeyError):
        cure = "give a number such as 0.62, a range such as 0.5..0.8, or mean and spread such as 0.58+-0.05"
        raise InputError(f"{friction!r} is no friction; {cure}") from None
    return make(*numbers)


def _likely(values: Float[np.ndarray, " values"], weights: Float[np.ndarray, " values"], *, note: str) -> Friction:
    """Return friction without values that are a million times less likely than the likeliest."""
    weights = weights / weights.sum()
    likely = weights > 1e-6 * weights.max()
    return Friction(values[likely], weights[likely], note=note)


def _unknown(near: Float[np.ndarray, " values"] | None = None) -> Friction:
    """Return unknown friction, evenly in the logarithm, over a range that covers some values and their spread."""
    low, high = _LOWEST, _HIGHEST
    if near is not None and len(near) and np.all((near > 0) & np.isfinite(near)):
        low = min(low, float(near.min()) * math.exp(-_REACH * GRASP_SPREAD))
        high = min(MOST_FRICTION, max(high, float(near.max()) * math.exp(_REACH * GRASP_SPREAD)))
    return Friction(np.geomspace(low, high, _NODES), note="unknown")
