"""Paired differences with their uncertainty over networks, days and trials."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, Shaped

FEWEST_UNITS = 5
"""Fewer trials say little."""


@dataclass(frozen=True, kw_only=True)
class Difference:
    """Mean of the first minus mean of the second, with a 95 % interval, and over what it was taken."""

    estimate: float
    low: float | None
    high: float | None
    """Ends of the interval; None of a single trial, of which nothing but the estimate is known."""
    units: int
    """Trials."""
    days: int = 1
    networks: int = 1
    """Of a single day or network the interval holds for that one alone: how far others differ is not in it."""

    def __str__(self) -> str:
        """Write the estimate with its interval."""
        ends = "" if self.low is None or self.high is None else f" ({self.low:.2g} to {self.high:.2g})"
        return f"{self.estimate:.3g}{ends}"

    @property
    def above_zero(self) -> bool:
        """True where the whole interval lies above zero, and rests on enough trials."""
        return self.units >= FEWEST_UNITS and self.low is not None and self.low > 0

    @property
    def below_zero(self) -> bool:
        """True where the whole interval lies below zero, and rests on enough trials."""
        return self.units >= FEWEST_UNITS and self.high is not None and self.high < 0

    @property
    def sure(self) -> bool:
        """True where the interval leaves zero out, and rests on enough trials."""
        return self.above_zero or self.below_zero

    @property
    def over(self) -> str:
        """Return the units of the interval in words: "14 trials, one day, one network"."""
        counts = {"trial": self.units, "day": self.days, "network": self.networks}
        return ", ".join(f"one {name}" if count == 1 else f"{count} {name}s" for name, count in counts.items())


def paired_difference(
    first: Float[np.ndarray, " images"],
    second: Float[np.ndarray, " images"],
    *,
    clusters: Iterable[Shaped[np.ndarray, " images"]],
    rng: np.random.Generator,
    comparisons: int | tuple[int, int] = 1,
) -> Difference:
    """Difference of two scores of the same images, with an interval that holds for other networks, days and trials.

    Frames of one trial resemble one another, and so do trials of one day and answers of one network. The interval is
    that of a mean over the outermost clusters of which there are several: the trials of a single day; else the days,
    whose spread has that of their trials in it. The ends come from the distribution of t among resampled clusters, or
    from Student's where clusters are fewer than eight. Of a single trial nothing is known but the estimate:
    there is no interval.

    `clusters` are labels of each image, outermost first: `[networks, days, trials]`, the last of them, or none where
    images are trials of their own. Equal labels are the same cluster: days that several networks saw count beside them.
    Of so many `comparisons`, looked at together, all intervals hold 95 times in 100 at least (Bonferroni); two numbers
    are those of the lower ends and of the upper ones.

    References
    ----------
    Efron and Tibshirani, *An Introduction to the Bootstrap* (1993), section 12.5: the bootstrap-t interval. Cameron,
    Gelbach and Miller, *Robust Inference with Multiway Clustering* (2011): networks that see the same days.

    Examples
    --------
    Sixteen frames, each about 0.1 better than its partner, but of four trials only:

    >>> import numpy as np
    >>> from sliplens.intervals import paired_difference
    >>> rng, trials = np.random.default_rng(0), np.repeat(np.arange(4), 4)
    >>> worse = rng.random(16)
    >>> gap = paired_difference(worse, worse - 0.1 + 0.01 * rng.random(16), clusters=[trials], rng=rng)
    >>> round(gap.estimate, 2), gap.over, gap.sure  # four trials are too few to be sure
    (0.09, '4 trials, one day, one network', False)
    """
    gap = first - second
    levels = [np.unique(labels, return_inverse=True)[1] for labels in clusters] or [np.arange(len(gap))]
    counts = [int(level.max()) + 1 for level in levels]
    free: list[Int[np.ndarray, " images"]] = []
    for level in levels:
        # of clusters that each lie in a single outer one the spread is in that of the outer ones
        cells = (len(np.unique(level * (outer.max() + 1) + outer)) for outer in free)
        if level.max() and level.max() + 1 not in cells:
            free.append(level)
    over = dict(zip(("units", "days", "networks"), counts[::-1], strict=False))
    estimate = float(gap.mean())
    low_tail, high_tail = np.broadcast_to(0.025 / np.array(comparisons), 2)
    at = np.array([low_tail, 1 - high_tail])
    many = len(free) == 1 and len(np.unique(free[0])) >= 8  # enough to draw the distribution of t from
    ends = _drawn_ends(gap, free[0], at, rng) if many else _student_ends(gap, free, at)
    low, high = (None, None) if ends is None else (estimate + ends).tolist()
    return Difference(estimate=estimate, low=low, high=high, **over)


def mean_interval(
    values: Float[np.ndarray, " images"],
    *,
    clusters: Iterable[Shaped[np.ndarray, " images"]],
    rng: np.random.Generator,
    limits: tuple[float, float] = (-np.inf, np.inf),
) -> Difference:
    """Mean of a score of images, such as a correlation, with the interval of `paired_difference`.

    `limits` are the least and the most that the score can be, -1 and 1 of a correlation. What lies beyond is cut off:
    the mean is never there, so that the interval holds it exactly as often as before.

    Examples
    --------
    Correlations of frames of two trials, which show little:

    >>> import numpy as np
    >>> from sliplens.intervals import mean_interval
    >>> alike, trials = np.array([0.9, 0.9, 0.5, 0.5]), np.array([0, 0, 1, 1])
    >>> found = mean_interval(alike, clusters=[trials], rng=np.random.default_rng(0), limits=(-1.0, 1.0))
    >>> round(found.estimate, 2), found.low, found.high
    (0.7, -1.0, 1.0)
    """
    interval = paired_difference(values, np.zeros(len(values)), clusters=clusters, rng=rng)
    low, high = (None if end is None else float(np.clip(end, *limits)) for end in (interval.low, interval.high))
    return replace(interval, low=low, high=high)


def _drawn_ends(
    gap: Float[np.ndarray, " images"],
    level: Int[np.ndarray, " images"],
    at: Float[np.ndarray, " 2"],
    rng: np.random.Generator,
) -> Float[np.ndarray, " 2"]:
    """Ends of the interval, at these quantiles, less the estimate; clusters are drawn again."""
    sums, counts = np.bincount(level, weights=gap), np.bincount(level)
    # the clusters as they are, then drawn again
    rows = np.concatenate([np.arange(len(sums))[None], rng.integers(0, len(sums), size=(2000, len(sums)))])
    sizes = counts[rows].sum(axis=1)
    means = sums[rows].sum(axis=1) / sizes
    rest = sums[rows] - means[:, None] * counts[rows]
    errors = np.sqrt(len(sums) / (len(sums) - 1) * (rest**2).sum(axis=1)) / sizes
    spread = errors > 0  # the same cluster in every place has no spread
    if not spread[0]:
        return np.zeros(2)
    return -errors[0] * np.quantile((means - means[0])[spread] / errors[spread], 1 - at)


def _student_ends(
    gap: Float[np.ndarray, " images"], levels: Sequence[Int[np.ndarray, " images"]], at: Float[np.ndarray, " 2"]
) -> Float[np.ndarray, " 2"] | None:
    """Ends of the interval less the estimate, by Student's t; clusters of several levels cross one another."""
    if not levels:  # a single trial
        return None
    rest = gap - gap.mean()
    parts, freedom, cells = [], [], np.zeros(len(gap), dtype=np.int64)
    alone = rest.copy()
    for level in levels:
        sums, counts = np.bincount(level, weights=rest), np.bincount(level)
        parts.append(len(sums) / (len(sums) - 1) * (sums**2).sum() / len(gap) ** 2)
        freedom.append(len(sums) - 1)
        alone -= (sums / counts)[level]
        cells = cells * len(sums) + level
    # what is left in each cell is in the spread of every level: it counts once
    within = (np.bincount(cells, weights=alone) ** 2).sum() / len(gap) ** 2
    shared = within * np.prod([1 + 1 / degree for degree in freedom])
    variance = max(sum(parts) - (len(parts) - 1) * shared, *parts, 0.0)
    if variance == 0:
        return np.zeros(2)
    degrees = variance**2 / sum(
        part**2 / degree for part, degree in zip(parts, freedom, strict=True)
    )  # Satterthwaite's
    from scipy.special import stdtrit  # noqa: PLC0415 (takes a second, and predictions have none)

    return np.sqrt(variance) * stdtrit(degrees, at)
