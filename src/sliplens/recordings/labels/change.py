"""Where a noisy line breaks off, and how surely."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from sliplens.errors import RecordingError

_REACH_S = 0.08
"""How far the break may lie from the rough guess."""
_TRIES = 41
"""Breaks tried over that reach."""
_FALLS_S = (0.005, 0.007, 0.01, 0.014, 0.02, 0.028, 0.04, 0.056, 0.08)
"""Lengths of the fall that are tried, from a sudden drop to that of a soft fingertip."""
_LEAST_BEFORE, _LEAST_AFTER = 6, 3
"""Samples that the two sides of a break need."""
_PARAMETERS = 7
"""What a fit takes from the noise: five numbers, and where the break and the end of the fall lie."""
_MEMORY = 0.2
"""Residuals that correlate by more are drawn together."""
_LONGEST_BLOCK = 0.1
"""Longest block, as a share of the samples."""


@dataclass(frozen=True, kw_only=True)
class Break:
    """A line that rises to a break, falls, and goes on level."""

    time_s: float
    level: float
    """At the break."""
    levels: Float[np.ndarray, " draws"]
    """At the breaks of the bootstrap's draws."""
    times_s: Float[np.ndarray, " draws"]


def fit_break(
    time_s: Float[np.ndarray, " samples"],
    values: Float[np.ndarray, " samples"],
    *,
    about_s: float,
    rng: np.random.Generator,
    draws: int,
) -> Break:
    """Fit a parabola that at a break goes over into a fall and then a line, by least squares.

    Every break within reach and a few lengths of the fall are tried; the bootstrap draws blocks of the residuals anew
    and fits the break anew with each.

    Parameters
    ----------
    time_s, values
        Samples, before and after the break.
    about_s
        Roughly where it is.
    rng
        Source of the draws.
    draws
        How many.

    Raises
    ------
    RecordingError
        If the samples about the break are too few to fit.
    """
    designs = [
        _Design.at(moment, fall, time_s=time_s)
        for moment in about_s + np.linspace(-_REACH_S, _REACH_S, _TRIES)
        for fall in _FALLS_S
        if np.sum(time_s < moment) >= _LEAST_BEFORE and np.sum(time_s > moment + fall) >= _LEAST_AFTER
    ]
    if not designs:
        raise RecordingError(
            f"only {np.sum(time_s < about_s)} samples before the slip at {about_s:.2f} s and "
            f"{np.sum(time_s > about_s)} after it can be used; record the forces faster or give the friction by hand"
        )
    (index,), (level,) = _best(designs, values[:, None])
    basis = designs[index].basis
    fitted = basis @ (basis.T @ values)
    residuals = values - fitted
    # a fit takes from the residuals what its parameters explain of the noise
    residuals = (residuals - residuals.mean()) * np.sqrt(len(values) / max(1, len(values) - _PARAMETERS))
    drawn = fitted[:, None] + residuals[_blocks(residuals, draws=draws, rng=rng)]
    chosen, levels = _best(designs, drawn)
    return Break(
        time_s=designs[index].moment_s,
        level=float(level),
        levels=levels,
        times_s=np.array([designs[one].moment_s for one in chosen]),
    )


@dataclass(frozen=True, kw_only=True)
class _Design:
    """The least-squares problem of one break, solved for any values."""

    moment_s: float
    basis: Float[np.ndarray, "samples parameters"]
    triangle: Float[np.ndarray, "parameters parameters"]

    @classmethod
    def at(cls, moment_s: float, fall_s: float, *, time_s: Float[np.ndarray, " samples"]) -> "_Design":
        """Level at the break, slope and bend before it, depth of the fall, slope after it."""
        since = time_s - moment_s
        before, after = np.minimum(since, 0), np.maximum(since, 0)
        columns = (
            np.ones_like(since),
            before,
            before**2,
            np.minimum(after / fall_s, 1),
            np.maximum(after - fall_s, 0),
        )
        basis, triangle = np.linalg.qr(np.stack(columns, axis=1))
        return cls(moment_s=float(moment_s), basis=basis, triangle=triangle)


def _best(
    designs: Sequence[_Design], values: Float[np.ndarray, "samples draws"]
) -> tuple[Int[np.ndarray, " draws"], Float[np.ndarray, " draws"]]:
    """Which design explains each column best, and its level at the break."""
    draws = values.shape[1]
    explained, chosen, levels = np.full(draws, -np.inf), np.zeros(draws, dtype=int), np.zeros(draws)
    for index, design in enumerate(designs):
        shares = design.basis.T @ values
        power = np.sum(shares**2, axis=0)
        better = power > explained
        if better.any():
            explained[better], chosen[better] = power[better], index
            levels[better] = np.linalg.solve(design.triangle, shares[:, better])[0]
    return chosen, levels


def _blocks(
    residuals: Float[np.ndarray, " samples"], *, draws: int, rng: np.random.Generator
) -> Int[np.ndarray, "samples draws"]:
    """Indices that draw blocks of neighbours anew, a column a draw; white noise is drawn sample by sample."""
    count = len(residuals)
    power = max(float(residuals @ residuals), 1e-300)
    longest = max(1, int(_LONGEST_BLOCK * count))
    remembers = np.array([residuals[lag:] @ residuals[:-lag] / power > _MEMORY for lag in range(1, longest)])
    memory = longest if remembers.all() else int(np.argmin(remembers))
    # a memory of one sample needs blocks of a few, for each is cut at its ends
    length = min(longest, 1 + 4 * memory)
    starts = rng.integers(0, count - length + 1, (int(np.ceil(count / length)), 1, draws))
    return (starts + np.arange(length)[:, None]).reshape(-1, draws)[:count]
