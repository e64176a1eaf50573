"""Forces interpolated onto the times of frames, with their noise, and where there is nothing to interpolate."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from sliplens.recordings.labels.axes import ContactForces, magnitude
from sliplens.recordings.labels.smoothing import half_window, mean_force

_NO_FLAG = 1e-6
"""Rounding of a mean of flags that are all 0."""


@dataclass(frozen=True, kw_only=True)
class FrameForces:
    """Forces at the times of frames."""

    normal_n: Float[np.ndarray, " frames"]
    tangential_n: Float[np.ndarray, " frames"]
    """Length of the tangential force."""
    normal_sigma_n: Float[np.ndarray, " frames"]
    """Standard uncertainty, from noise and tare."""
    tangential_sigma_n: Float[np.ndarray, " frames"]
    missing: Bool[np.ndarray, " frames"]
    """Whether the neighbouring samples are too far apart, or there are none on one side."""
    out_of_range: Bool[np.ndarray, " frames"]


def interpolate_forces(
    forces: ContactForces,
    time_s: Float[np.ndarray, " frames"],
    *,
    window_s: float,
    gap_s: float,
    until_s: float = np.inf,
    force_range_n: float | None = None,
) -> FrameForces:
    """Interpolate the forces onto given times: the mean, over a window about each, of the line through the samples.

    Parameters
    ----------
    forces
        In the axes of the contact.
    time_s
        Where to have them, on the force sensor's clock.
    window_s
        Full length of the window; 0 interpolates between two samples.
    gap_s
        Samples further apart count as missing.
    until_s
        A time that no window reaches over.
    force_range_n
        What each axis of the sensor can measure, either way; None if it is not known.
    """
    samples = forces.time_s
    normal, tangential = (
        mean_force(samples, values, time_s, window_s=window_s, until_s=until_s)
        for values in (forces.normal_n, forces.tangential_n)
    )
    noise, one = forces.noise_of_means_n(window_s), forces.noise_n
    # a shorter window averages less noise away, at worst none
    length = 2 * half_window(samples, np.clip(time_s, samples[0], samples[-1]), window_s=window_s, until_s=until_s)
    more = np.sqrt(window_s / np.maximum(length, 1e-9))
    normal_noise = np.minimum(noise.normal * more, max(one.normal, noise.normal))
    tangential_noise = np.minimum(noise.tangential * more, max(one.tangential, noise.tangential))
    tare = forces.tare_sigma_n
    return FrameForces(
        normal_n=normal,
        tangential_n=magnitude(tangential, sigma_n=tangential_noise),
        normal_sigma_n=np.hypot(normal_noise, tare.normal),
        tangential_sigma_n=np.hypot(tangential_noise, tare.tangential),
        missing=_missing(samples, time_s, gap_s=gap_s),
        out_of_range=_out_of_range(forces, time_s, window_s=window_s, range_n=force_range_n),
    )


def _missing(
    samples_s: Float[np.ndarray, " samples"], time_s: Float[np.ndarray, " frames"], *, gap_s: float
) -> Bool[np.ndarray, " frames"]:
    """Whether the samples on both sides of a time are too far apart, or one side has none."""
    after = np.searchsorted(samples_s, time_s, side="left")
    outside = (time_s < samples_s[0]) | (time_s > samples_s[-1])
    next_one = np.clip(after, 0, len(samples_s) - 1)
    apart = samples_s[next_one] - samples_s[np.maximum(next_one - 1, 0)]
    on_sample = samples_s[next_one] == time_s
    return outside | ((apart > gap_s) & ~on_sample)


def _out_of_range(
    forces: ContactForces, time_s: Float[np.ndarray, " frames"], *, window_s: float, range_n: float | None
) -> Bool[np.ndarray, " frames"]:
    """Whether any sample that a frame's force rests on reaches the end of the sensor's range, tare included."""
    if range_n is None:
        return np.zeros(len(time_s), dtype=bool)
    full = np.any(np.abs(forces.recorded.force_n) >= range_n, axis=1, keepdims=True).astype(np.float64)
    # the slip's onset hides no sample here: a window more is a frame less, a window less a wrong label
    return mean_force(forces.time_s, full, time_s, window_s=window_s)[:, 0] > _NO_FLAG
