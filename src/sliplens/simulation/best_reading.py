"""The safety margin as the best reader of the markers would read it, and what each marker adds to that.

The simulator's own margin follows from forces and is no function of a marker: put one back where it rested and the
margin is what it was. What changes is what the markers tell of it. So the truth that an explanation can be held
against is the reading of the best reader there is: Gamma-hat = Gamma + g . (u - u(Gamma)), with the displacements u of
the markers and the gain g of the minimum-variance linear estimator of the margin, linearised at this very frame (Kay,
*Fundamentals of Statistical Signal Processing* I (1993), sections 6.4 and 12.3). Its error is the bound of
`information.margin_bound`, which docs/limit.md reports: with Gaussian noise in each coordinate, priors of the
simulator's spread on the nuisances, and none on the margin, so that it is unbiased, g . du/dGamma = 1. (A prior on the
margin would shrink all of g alike and change no ranking.)

Being linear, the reading is a sum over the markers, and marker m adds g_m . u_m to it, in margin units: what the
reading loses when this marker alone is put back. The step from u_m to 0 is far larger than the noise; what curvature
would change there is left out. At margins of 0 and 1 the displacement has no derivative: there the gain is that of the
nearest margin inside.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int

from sliplens.errors import ContactError
from sliplens.simulation.information import (
    MARGIN,
    marker_sensitivity,
    prior_sigma,
    visible_markers,
)
from sliplens.simulation.intervention import FilmedTrial

NOISE_PX = 0.1
"""Of each coordinate of a marker that is followed in images of this noise, as in docs/limit.md."""
_NEAREST_END = 0.02
"""Margins nearer to 0 or 1 are read with the gain of this one, or of one less this: the ends have no derivative."""


def reading_gain(
    jacobian: Float[np.ndarray, "coordinates unknowns"],
    unknowns: tuple[str, ...],
    *,
    noise_px: float,
    prior: Mapping[str, float],
) -> Float[np.ndarray, " coordinates"]:
    """Gain of the best linear estimator of the margin: how far its reading moves with each coordinate, per pixel.

    The margin's row of (J^T J / sigma^2 + diag(1 / prior^2))^-1 J^T / sigma^2: with infinite priors the best linear
    unbiased estimator, else the posterior mean.

    Parameters
    ----------
    jacobian, unknowns
        Derivatives of the coordinates, as in `Sensitivity`; the margin first.
    noise_px, prior
        As for `margin_bound`.

    Raises
    ------
    ContactError
        If the noise or a standard deviation is not positive.
    """
    sigma = {MARGIN: np.inf, **prior}
    if not (noise_px > 0 and min(sigma.values()) > 0):
        raise ContactError("noise and priors must be positive; leave out of `prior` what is known")
    kept = [index for index, name in enumerate(unknowns) if name in sigma]
    # a prior is one more observation
    rows = np.concatenate([jacobian[:, kept] / noise_px, np.diag([1 / sigma[unknowns[index]] for index in kept])])
    # metres, radians and shares in one matrix: each in its own unit length
    scale = np.maximum(np.linalg.norm(rows, axis=0), np.finfo(float).tiny)
    return np.linalg.pinv(rows / scale)[0, : len(jacobian)] / (scale[0] * noise_px)


def marker_readings(
    trial: FilmedTrial, frame: int, *, noise_px: float = NOISE_PX
) -> tuple[Int[np.ndarray, " markers"], Float[np.ndarray, " markers"]]:
    """What each marker that lies wholly in the image adds to the best reading of a frame's margin.

    Parameters
    ----------
    trial
        The trial.
    frame
        A frame in contact.
    noise_px
        Standard deviation of each coordinate, in pixels.

    Returns
    -------
    markers, effects
        Numbers of the markers, and the reading as it is less the reading with that marker put back, in margin units.

    Raises
    ------
    ContactError
        If the frame has no contact.
    """
    margin = float(trial.loading.safety_margin[frame])
    if np.isnan(margin):
        raise ContactError(
            f"frame {frame} of {trial.plan.trial} has no contact, and so no margin; choose another frame"
        )
    recipe, motion = trial.plan.recipe, trial.film.motion
    sensitivity = marker_sensitivity(
        np.array([np.clip(margin, _NEAREST_END, 1 - _NEAREST_END)]),
        sensor=recipe.sensor,
        touch=trial.touch(frame),
        displacement=recipe.resolved_displacement,
    )
    gain = reading_gain(
        sensitivity.jacobian[0],
        sensitivity.unknowns,
        noise_px=noise_px,
        prior=prior_sigma(recipe.nuisances, wet=trial.plan.condition == "wet"),
    )
    seen = visible_markers(recipe.sensor)
    moved = (motion.centres_px[frame] - motion.rest_px)[seen]
    return seen, (gain.reshape(-1, 2) * moved).sum(axis=1)
