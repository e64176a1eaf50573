"""Paired differences with their uncertainty."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Shaped

__all__ = ["FEWEST_UNITS", "Difference", "bootstrap_difference", "paired_difference"]

FEWEST_UNITS = 5
"""Resampling fewer trials or frames says little."""
_RESAMPLES = 2000


@dataclass(frozen=True, kw_only=True)
class Difference:
    """Mean of the first minus mean of the second, with a 95 % interval over `units` resampled trials or frames."""

    estimate: float
    low: float
    high: float
    units: int

    @property
    def sure(self) -> bool:
        """Whether the interval leaves zero out, and rests on enough units."""
        return self.units >= FEWEST_UNITS and (self.low > 0 or self.high < 0)


def bootstrap_difference(
    first: Float[np.ndarray, " units"],
    second: Float[np.ndarray, " units"],
    counts: Float[np.ndarray, " units"],
    *,
    rng: np.random.Generator,
) -> Difference:
    """Difference of two means over the same units, resampled together.

    Given are each unit's sums, such as the squared errors of a trial's frames or one frame's score, and the number of
    terms in them.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.intervals import bootstrap_difference
    >>> squared_errors, of_another = np.array([4.0, 6, 5, 5, 4, 6]), np.array([1.0, 3, 2, 2, 1, 3])
    >>> gap = bootstrap_difference(squared_errors, of_another, np.full(6, 10.0), rng=np.random.default_rng(0))
    >>> round(gap.estimate, 6), gap.sure
    (0.3, True)
    """
    gap = first - second
    rows = rng.integers(0, len(gap), size=(_RESAMPLES, len(gap)))
    means = gap[rows].sum(axis=1) / counts[rows].sum(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return Difference(estimate=float(gap.sum() / counts.sum()), low=float(low), high=float(high), units=len(gap))


def paired_difference(
    first: Float[np.ndarray, " images"],
    second: Float[np.ndarray, " images"],
    *,
    trials: Shaped[np.ndarray, " images"] | None = None,
    rng: np.random.Generator,
) -> Difference:
    """Difference of two scores of the same images; whole trials are resampled where each image's trial is named.

    Frames of one trial resemble one another: resampled one by one they would feign more evidence than there is.

    Examples
    --------
    Eight frames, each 0.1 better than its partner, but of four trials only:

    >>> import numpy as np
    >>> from sliplens.intervals import paired_difference
    >>> worse = np.linspace(0.2, 0.9, 8)
    >>> gap = paired_difference(worse, worse - 0.1, trials=np.repeat(np.arange(4), 2), rng=np.random.default_rng(0))
    >>> round(gap.estimate, 6), gap.units, gap.sure  # four trials are too few to be sure
    (0.1, 4, False)
    """
    _, member = np.unique(np.arange(len(first)) if trials is None else trials, return_inverse=True)
    ones = np.ones(len(first))
    return bootstrap_difference(*(np.bincount(member, weights=values) for values in (first, second, ones)), rng=rng)
