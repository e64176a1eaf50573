"""Forces in the axes of the contact: normal and tangential, tare taken off."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sliplens.recordings.capture import Forces
from sliplens.recordings.labels.axes import ForceAxes
from sliplens.recordings.labels.smoothing import mean_force, noise_sigma

_FEW_MEANS = 20
"""Fewer means tell no spread."""


@dataclass(frozen=True, kw_only=True)
class NormalTangential:
    """A standard deviation of the normal force, and of one component of the tangential, in newtons."""

    normal: float
    tangential: float


@dataclass(frozen=True, kw_only=True)
class ContactForces:
    """Forces in the axes of the contact, tare taken off, on the force sensor's clock."""

    recorded: Forces
    normal_n: Float[np.ndarray, " samples"]
    """Positive when pressing."""
    tangential_n: Float[np.ndarray, "samples 2"]
    """The two other axes in their order. Their length would be biased by noise: average first; see `magnitude`."""
    axes: ForceAxes

    @property
    def time_s(self) -> Float[np.ndarray, " samples"]:
        """Times of the samples."""
        return self.recorded.time_s

    @property
    def noise_n(self) -> NormalTangential:
        """Standard deviation of a sample's noise."""
        return self._split(self.axes.noise_n)

    @property
    def tare_sigma_n(self) -> NormalTangential:
        """Standard uncertainty of the tare."""
        return self._split(self.axes.tare_sigma_n)

    def noise_of_means_n(self, window_s: float) -> NormalTangential:
        """Standard deviation of the noise of means over a window; white or not, it is taken from means."""
        time = self.time_s
        middles = np.arange(time[0] + window_s / 2, time[-1] - window_s / 2, window_s) if window_s > 0 else time
        means = mean_force(time, self.recorded.force_n, middles, window_s=window_s)
        # too few means tell no spread: the samples then have to
        return self._split(noise_sigma(means)) if len(means) >= _FEW_MEANS else self.noise_n

    def _split(self, of_axes: Float[np.ndarray, "3"]) -> NormalTangential:
        index = self.axes.normal_index
        return NormalTangential(
            normal=float(of_axes[index]), tangential=float(np.sqrt(np.mean(np.delete(of_axes, index) ** 2)))
        )


def apply_axes(forces: Forces, axes: ForceAxes) -> ContactForces:
    """Take the tare off and turn the forces into the axes of the contact."""
    force = forces.force_n - axes.tare_n
    return ContactForces(
        recorded=forces,
        normal_n=axes.sign * force[:, axes.normal_index],
        tangential_n=np.delete(force, axes.normal_index, axis=1),
        axes=axes,
    )


def magnitude(
    tangential_n: Float[np.ndarray, "samples 2"], *, sigma_n: float | Float[np.ndarray, " samples"]
) -> Float[np.ndarray, " samples"]:
    """Length of a noisy tangential force, the noise's share taken off: on average noise only ever lengthens a vector.

    Parameters
    ----------
    tangential_n
        Two components, averaged as far as they will be.
    sigma_n
        Standard deviation of the noise that is left in a component.

    References
    ----------
    Gudbjartsson and Patz, *Magn. Reson. Med.* 34 (1995) 910: sqrt(|m^2 - sigma^2|) for Rician data.
    """
    return np.sqrt(np.maximum(np.sum(tangential_n**2, axis=1) - sigma_n**2, 0))
