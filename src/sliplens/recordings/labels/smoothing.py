"""Means and noise of force samples that need not be evenly spaced."""

import numpy as np
from jaxtyping import Float

_MAD_TO_SIGMA = 1.4826  # standard deviation of a Gaussian over its median absolute deviation


def typical_step(time_s: Float[np.ndarray, " samples"]) -> float:
    """Median time between samples, in seconds; 0 for one sample."""
    return float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0


def mean_force(
    time_s: Float[np.ndarray, " samples"],
    force_n: Float[np.ndarray, "samples *axes"],
    at_s: Float[np.ndarray, " times"],
    *,
    window_s: float,
    until_s: float = np.inf,
) -> Float[np.ndarray, "times *axes"]:
    """Mean over a window about given times of the force, interpolated linearly between its samples.

    It is the exact mean of the broken line through the samples, so it holds for samples that are not evenly spaced,
    and a window of 0 is plain interpolation. Near the ends of the samples, and of `until_s`, the onset of slip
    where the force breaks off, the window shrinks evenly about its time.
    """
    at = np.clip(at_s, time_s[0], time_s[-1])
    half = half_window(time_s, at, window_s=window_s, until_s=until_s)
    flat = force_n.reshape(len(time_s), -1)
    plain = np.stack([np.interp(at, time_s, column) for column in flat.T], axis=1)
    # a window narrower than a sample's step holds no more than the interpolated value
    wide = half > 1e-9
    low, high = at - half, at + half
    mean = (_integral(time_s, flat, high) - _integral(time_s, flat, low)) / np.where(wide, 2 * half, 1)[:, None]
    return np.where(wide[:, None], mean, plain).reshape(len(at), *force_n.shape[1:])


def half_window(
    time_s: Float[np.ndarray, " samples"], at_s: Float[np.ndarray, " times"], *, window_s: float, until_s: float
) -> Float[np.ndarray, " times"]:
    """Half the length of the windows that `mean_force` takes its means over."""
    room = np.minimum(at_s - time_s[0], time_s[-1] - at_s)
    return np.clip(np.minimum(room, np.abs(at_s - until_s)), 0, window_s / 2)


def noise_sigma(values: Float[np.ndarray, "samples *axes"]) -> Float[np.ndarray, "*axes"]:
    """Standard deviation of the noise of each column, from second differences: what changes slowly leaves no trace.

    The median makes it blind to a few jumps. A column that hardly ever changes has a noise of 0.
    """
    if len(values) < 3:
        return np.zeros(values.shape[1:])
    second = values[2:] - 2 * values[1:-1] + values[:-2]
    return np.asarray(_MAD_TO_SIGMA * np.median(np.abs(second), axis=0) / np.sqrt(6))


def _integral(
    time_s: Float[np.ndarray, " samples"], values: Float[np.ndarray, "samples columns"], at_s: Float[np.ndarray, " t"]
) -> Float[np.ndarray, "t columns"]:
    """Integral of the broken line through the samples, from the first of them."""
    # about the mean: a large offset would cost digits
    steps = np.diff(time_s)[:, None] * (values[1:] + values[:-1]) / 2
    sums = np.concatenate((np.zeros((1, values.shape[1])), np.cumsum(steps, axis=0)))
    before = np.clip(np.searchsorted(time_s, at_s, side="right") - 1, 0, len(time_s) - 1)
    here = np.stack([np.interp(at_s, time_s, column) for column in values.T], axis=1)
    return sums[before] + (at_s - time_s[before])[:, None] * (values[before] + here) / 2
