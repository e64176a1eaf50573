"""What the markers of a frame tell of the safety margin: their motion with it, and the best linear reading of it.

Seen are the displacements of the markers inside the image, each coordinate with Gaussian noise. The camera's seat and
the print's jitter move a marker and its place at rest alike: the reference frame shows them, and they are no unknowns.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, Int

from sliplens.errors import ContactError
from sliplens.simulation.loading import load_at_margins
from sliplens.simulation.motion import move_markers
from sliplens.simulation.nuisances import Nuisances, Range, Touch
from sliplens.simulation.sensor import Sensor

Jacobian: TypeAlias = Float[np.ndarray, "coordinates unknowns"]

MARGIN = "margin"
"""The unknown that is asked for."""
_STEP = 1e-4
"""Step of the central differences: their error grows with its square, that of rounding (1e-12 px) over it."""


def _grasp(field: str, axis: int | None = None) -> Callable[[Touch, float], Touch]:
    """Shift a number of the grasp, or one of its pair."""

    def shift(touch: Touch, step: float) -> Touch:
        value = getattr(touch.grasp, field)
        moved = value + step if axis is None else tuple(part + step * (axis == at) for at, part in enumerate(value))
        return replace(touch, grasp=replace(touch.grasp, **{field: moved}))

    return shift


def _grow(field: str) -> Callable[[Touch, float], Touch]:
    """Multiply a number of the grasp."""
    return lambda touch, step: _grasp(field)(touch, getattr(touch.grasp, field) * float(np.expm1(step)))


NUISANCES: dict[str, Callable[[Touch, float], Touch]] = {
    "log_friction": _grow("friction"),
    # force, its drift, creep and stiffness all act through the contact radius alone: one unknown
    "log_load": _grow("normal_force_n"),
    "offset_x": _grasp("contact_offset", 0),
    "offset_y": _grasp("contact_offset", 1),
    "tilt_x_rad": _grasp("tilt_rad", 0),
    "tilt_y_rad": _grasp("tilt_rad", 1),
    "direction_rad": _grasp("shear_direction_rad"),
    "shear_exponent": _grasp("shear_exponent"),
    "marker_depth": lambda touch, step: replace(touch, marker_depth=touch.marker_depth + step),
}
"""Shift of a touch by each nuisance; lengths in radii of the contact's sphere, angles in radians, `log_` relative."""


@dataclass(frozen=True, kw_only=True)
class Sensitivity:
    """Derivatives of the marker positions in one frame for each margin, in pixels per unit of the unknown."""

    unknowns: tuple[str, ...]
    """The margin first."""
    jacobian: Float[np.ndarray, "frames coordinates unknowns"]


def visible_markers(sensor: Sensor) -> Int[np.ndarray, " markers"]:
    """Markers that lie inside the image at rest, at least their own radius from its border."""
    points = sensor.geometry.project(sensor.geometry.marker_positions())
    border = max(sensor.look.radius_px)
    return np.flatnonzero(np.all((points >= border) & (points <= sensor.image_size_px - 1 - border), axis=-1))


def marker_sensitivity(
    margins: Float[np.ndarray, " frames"], *, sensor: Sensor, touch: Touch, displacement: str | None = None
) -> Sensitivity:
    """Shift of the visible markers with the safety margin and with every nuisance, by central differences.

    `margins`: safety margins to look at, inside (0, 1).
    """
    if not np.all((margins > 0) & (margins < 1)):
        raise ContactError("safety margins must lie inside (0, 1), where the derivative exists; leave out the ends")
    seen, step = visible_markers(sensor), _STEP * np.minimum(margins, 1 - margins)

    def positions(margins: np.ndarray, touch: Touch) -> np.ndarray:
        loading = load_at_margins(margins, grasp=touch.grasp)
        motion = move_markers(sensor, touch, loading=loading, displacement=displacement)
        # from rest: a deeper marker also lies elsewhere at rest, and that the reference frame shows
        return (motion.centres_px - motion.rest_px)[:, seen].reshape(len(margins), -1)

    columns = [(positions(margins + step, touch) - positions(margins - step, touch)) / (2 * step[:, None])]
    # no marker lies above the skin
    start = replace(touch, marker_depth=max(touch.marker_depth, _STEP))
    for shift in NUISANCES.values():
        there, back = (positions(margins, shift(start, side * _STEP)) for side in (1, -1))
        columns.append((there - back) / (2 * _STEP))
    return Sensitivity(unknowns=(MARGIN, *NUISANCES), jacobian=np.stack(columns, axis=-1))


def prior_sigma(nuisances: Nuisances, *, wet: bool) -> dict[str, float]:
    """Standard deviation of what a trial draws for each nuisance, with the friction of a wet or a dry object.

    The draws are even, not Gaussian: their variances are matched. Of the logarithm of a product the variances add.
    """
    if wet:
        friction = np.hypot(_log_sigma(nuisances.wet_friction), _drift_sigma(nuisances.wet_friction_drift))
    else:
        friction = np.hypot(_log_sigma(nuisances.dry_friction), _log_sigma(nuisances.dry_friction_factor))
    creep = (1 + nuisances.creep[0], 1 + nuisances.creep[1])
    load = [_log_sigma(part) for part in (nuisances.normal_force_n, nuisances.modulus_factor, creep)]
    # even in direction and reach: each coordinate has half of the mean squared reach
    low, high = nuisances.contact_offset
    offset = np.sqrt((low**2 + low * high + high**2) / 6)
    tilt, direction = (float(np.radians(_sigma(part))) for part in (nuisances.tilt_deg, nuisances.shear_direction_deg))
    return {
        "log_friction": float(friction),
        "log_load": float(np.linalg.norm([*load, _drift_sigma(nuisances.normal_force_drift)])),
        "offset_x": float(offset),
        "offset_y": float(offset),
        "tilt_x_rad": tilt,
        "tilt_y_rad": tilt,
        "direction_rad": direction,
        "shear_exponent": _sigma(nuisances.shear_exponent),
        "marker_depth": _sigma(nuisances.marker_depth),
    }


def reading_gain(
    jacobian: Jacobian, unknowns: tuple[str, ...], *, noise_px: float, prior: Mapping[str, float]
) -> Float[np.ndarray, " coordinates"]:
    """Gain of the best linear estimator of the margin: how far its reading moves with each coordinate, per pixel.

    The margin's row of (J^T J / sigma^2 + diag(1 / prior^2))^-1 J^T / sigma^2: with infinite priors the best linear
    unbiased estimator, else the posterior mean.

    `jacobian`, `unknowns`: derivatives of the coordinates, as in `Sensitivity`; the margin first.
    """
    rows, scale = observations(jacobian, unknowns, noise_px, prior)
    return np.linalg.pinv(rows / scale)[0, : len(jacobian)] / (scale[0] * noise_px)


def observations(
    jacobian: Jacobian, unknowns: tuple[str, ...], noise_px: float, prior: Mapping[str, float]
) -> tuple[Float[np.ndarray, "rows kept"], Float[np.ndarray, " kept"]]:
    """Rows of the least squares, a prior being one more observation, and the length of each column.

    Metres, radians and shares stand in one matrix: a column over its length has no unit.
    """
    sigma = {MARGIN: np.inf, **prior}
    if not (noise_px > 0 and min(sigma.values()) > 0):
        raise ContactError("noise and priors must be positive; leave out of `prior` what is known")
    kept = [index for index, name in enumerate(unknowns) if name in sigma]
    rows = np.concatenate([jacobian[:, kept] / noise_px, np.diag([1 / sigma[unknowns[index]] for index in kept])])
    return rows, np.maximum(np.linalg.norm(rows, axis=0), np.finfo(float).tiny)


def _sigma(limits: Range) -> float:
    return (limits[1] - limits[0]) / np.sqrt(12)


def _drift_sigma(limits: Range) -> float:
    """Standard deviation of a relative change d p, p even in [-1, 1] through a trial: its variance is E[d^2] / 3."""
    low, high = limits
    return float(np.sqrt((low**2 + low * high + high**2) / 9))


def _log_sigma(limits: Range) -> float:
    """Standard deviation of the logarithm of an even draw, on a grid fine enough for four digits."""
    return float(np.std(np.log(np.linspace(*limits, 10_001))))
