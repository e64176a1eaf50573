"""Where the markers go under load: the calibrated model, fitted to the markers of the real ChromaTouch."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sliplens.mechanics import (
    contact_radius,
    normal_displacement,
    partial_slip_displacement,
    reduced_modulus,
)
from sliplens.simulation.loading import Loading
from sliplens.simulation.nuisances import Grasp
from sliplens.simulation.sensor import Sensor

_SHEAR = 0.0322
"""Shear of the whole skin at full slip in the fitted trial, in dome radii."""
_LOCAL_FRICTION = 0.049
"""Friction whose Cattaneo-Mindlin field the fitted trial shows on top of that shear."""
_CLAMP_EXPONENT = 0.41
"""The base holds the gel: displacements fade with the cosine of the polar angle to this power."""
_FITTED_FRICTION = 0.775
"""Friction ascribed to the fitted trial, which names none: the geometric mean of the dry range (assumed)."""
_FITTED_CONTACT = 0.451
"""Contact radius of the fitted trial, in dome radii."""
_TURN = 0.15
"""Far from the apex markers turn away from the camera as the dome flattens: size lost at the equator."""
# the six above and the defaults of `Grasp` were fitted to 35 markers x 4 frames of the published difference images,
# each located by fitting two blurred discs to its crescents: rms 0.48 px a coordinate, of a motion of 4.1 px


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Markers through a trial, as the camera sees them."""

    centres_px: Float[np.ndarray, "frames markers 2"]
    scale: Float[np.ndarray, "frames markers"]
    """Size over the size at rest: what comes nearer looks larger."""
    depth: Float[np.ndarray, " frames"]
    """Indentation over that of the fitted trial; 0 without contact."""


def move_markers(sensor: Sensor, *, loading: Loading, grasp: Grasp, modulus_factor: float = 1.0) -> Motion:
    """Displace a sensor's markers by a loading.

    Hertz's normal field and a weak Cattaneo-Mindlin field, both faded towards the base, and a shear of the whole skin
    that grows as 1 - Gamma^p. The shear is calibrated, not derived: its stick zone is nominal.

    Parameters
    ----------
    sensor
        The sensor.
    loading
        Forces and margins of every frame.
    grasp
        Contact offset, tilt, direction and exponent of the shear, creep.
    modulus_factor
        Stiffness of the gel over the sensor's nominal one.
    """
    rest = sensor.marker_positions()
    modulus = reduced_modulus(
        youngs_modulus_pa=sensor.youngs_modulus_pa * modulus_factor, poisson_ratio=sensor.poisson_ratio
    )
    creep = 1 + grasp.creep * (1 - np.exp(-loading.held_s / grasp.creep_time_s))
    radius = contact_radius(
        loading.normal_force_n * creep, sphere_radius_m=sensor.dome_radius_m, reduced_modulus_pa=modulus
    )
    a = np.asarray(radius)[:, None] / sensor.dome_radius_m
    x = rest[:, 0] - grasp.contact_offset[0]
    y = rest[:, 1] - grasp.contact_offset[1]
    cosine = np.clip(rest[:, 2], 0, 1)
    clamp = cosine**_CLAMP_EXPONENT

    inward = normal_displacement(np.hypot(x, y), contact_radius_m=a, sphere_radius_m=1.0) * clamp
    along, across = _shear(x, y, a=a, cosine=cosine, clamp=clamp, loading=loading, grasp=grasp, sensor=sensor)
    cos, sin = np.cos(grasp.shear_direction_rad), np.sin(grasp.shear_direction_rad)
    depth = (a[:, 0] / _FITTED_CONTACT) ** 2
    # a tilted object pushes a little sideways
    push_x, push_y = np.tan(grasp.tilt_rad[0]), np.tan(grasp.tilt_rad[1])
    moved = rest + np.stack(
        [along * cos - across * sin + push_x * inward, along * sin + across * cos + push_y * inward, -inward], axis=-1
    )
    return Motion(
        centres_px=sensor.project(moved),
        scale=sensor.camera_distance(rest)
        / sensor.camera_distance(moved)
        * (1 - _TURN * depth[:, None] * (1 - cosine**2)),
        depth=depth,
    )


def _shear(
    x: Float[np.ndarray, " markers"],
    y: Float[np.ndarray, " markers"],
    *,
    a: Float[np.ndarray, "frames 1"],
    cosine: Float[np.ndarray, " markers"],
    clamp: Float[np.ndarray, " markers"],
    loading: Loading,
    grasp: Grasp,
    sensor: Sensor,
) -> tuple[Float[np.ndarray, "frames markers"], Float[np.ndarray, "frames markers"]]:
    """Give the displacement along and across the pull, in dome radii."""
    margin = np.nan_to_num(loading.safety_margin, nan=1.0)[:, None]
    friction = loading.friction_coefficient[:, None] / _FITTED_FRICTION
    cos, sin = np.cos(grasp.shear_direction_rad), np.sin(grasp.shear_direction_rad)
    local_along, local_across = partial_slip_displacement(
        x * cos + y * sin,
        y * cos - x * sin,
        contact_radius_m=a,
        sphere_radius_m=1.0,
        friction_coefficient=_LOCAL_FRICTION * friction,
        safety_margin=margin,
        poisson_ratio=sensor.poisson_ratio,
    )
    # as Mindlin's, the whole shear at slip is proportional to mu P / a, that is to mu a^2
    whole = _SHEAR * friction * (a / _FITTED_CONTACT) ** 2 * (1 - margin**grasp.shear_exponent)
    return whole * cosine + local_along * clamp, local_across * clamp
