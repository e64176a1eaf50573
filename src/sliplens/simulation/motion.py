"""Motion of the markers under load: a calibrated model and the exact half-space."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sliplens.errors import ContactError
from sliplens.mechanics import (
    contact_radius,
    hertz_displacement,
    indentation,
    partial_slip_displacement,
    reduced_modulus,
    stick_radius,
)
from sliplens.simulation.loading import Loading
from sliplens.simulation.nuisances import Grasp, Touch
from sliplens.simulation.sensor import Sensor

_FITTED_FRICTION = 0.775
"""Friction ascribed to the trial of the real images, which names none: the dry range's geometric mean (assumed)."""


@dataclass(frozen=True, kw_only=True)
class Displacement:
    """Give of a fingertip: an elastic half-space held by its base, and a shear of the whole skin."""

    layer: float
    """Indentation over Hertz's for the same contact: on a hard core the gel is a layer; a thin one has half of it."""
    local_friction: float
    """Share of the friction that shows as Cattaneo and Mindlin's local field."""
    clamp_exponent: float
    """The base holds the gel: local displacements fade with the cosine of the polar angle to this power."""
    skin_shear: float
    """Shear of the whole skin at full slip in the fitted trial, in radii; as Mindlin's it grows with mu P / a, that is
    with mu times the indentation, and with the pull as 1 - Gamma^p."""


DISPLACEMENTS = {
    # fitted, with the defaults of `Grasp`, to 34 markers x 4 frames of the published difference images
    "calibrated": Displacement(
        layer=0.69, local_friction=0.042 / _FITTED_FRICTION, clamp_exponent=0.76, skin_shear=0.0307
    ),
    # the exponent where a half-space alone was fitted to those markers
    "half-space": Displacement(layer=1.0, local_friction=1.0, clamp_exponent=1.6, skin_shear=0.0),
}
"""`calibrated` moves as the real ChromaTouch did, and its stick zone is nominal; `half-space` is exact mechanics."""


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Markers and contact through a trial; pixels are those of a camera that sits as drawn."""

    rest_px: Float[np.ndarray, "markers 2"]
    centres_px: Float[np.ndarray, "frames markers 2"]
    scale: Float[np.ndarray, "frames markers"]
    """Size over the size at rest; a marker that comes nearer looks larger."""
    touch: Float[np.ndarray, " frames"]
    """Indentation over that of the nominal grasp; 0 without contact."""
    nominal_radius_m: float
    """Contact radius of the nominal grasp."""
    contact_centre_m: Float[np.ndarray, "2"]
    pressure: Float[np.ndarray, "frames markers"]
    """Hertz's pressure on each marker over the peak of the nominal grasp's."""
    indentation_m: Float[np.ndarray, " frames"]
    contact_radius_m: Float[np.ndarray, " frames"]
    stick_radius_m: Float[np.ndarray, " frames"]


def move_markers(sensor: Sensor, touch: Touch, *, loading: Loading, displacement: str | None = None) -> Motion:
    """Displace a sensor's markers by a loading, and by the offset, tilt, shear and creep of the touch.

    `displacement`: a row of `DISPLACEMENTS`; the sensor's default if None.
    """
    name = sensor.displacements[0] if displacement is None else displacement
    if name not in sensor.displacements:
        raise ContactError(
            f"sensor {sensor.name} cannot be moved by {name!r}; choose {' or '.join(sensor.displacements)}"
        )
    model, grasp = DISPLACEMENTS[name], touch.grasp
    modulus_pa = sensor.youngs_modulus_pa
    if name == "calibrated" and sensor.effective_modulus_pa is not None:
        modulus_pa = sensor.effective_modulus_pa
    geometry = sensor.geometry
    sphere_m, depth_m = geometry.sphere_radius_m, touch.marker_depth * geometry.sphere_radius_m
    rest = geometry.marker_positions(depth_m)
    creep = 1 + grasp.creep * (1 - np.exp(-loading.held_s / grasp.creep_time_s))

    def radius(force_n: np.ndarray, factor: float) -> np.ndarray:
        modulus = reduced_modulus(youngs_modulus_pa=modulus_pa * factor, poisson_ratio=sensor.poisson_ratio)
        return np.asarray(contact_radius(force_n, sphere_radius_m=sphere_m, reduced_modulus_pa=modulus))

    contact_m = radius(loading.normal_force_n * creep, touch.modulus_factor)
    nominal_m = radius(np.array([Grasp().normal_force_n]), 1.0)
    sunken = (contact_m / nominal_m) ** 2
    clamp = geometry.slope_cosine(rest) ** model.clamp_exponent
    centre_m = np.asarray(grasp.contact_offset) * sphere_m
    from_centre = rest[:, :2] - centre_m
    distance = np.linalg.norm(from_centre, axis=-1)
    outward, inward = hertz_displacement(
        distance,
        depth_m,
        contact_radius_m=contact_m[:, None],
        sphere_radius_m=sphere_m,
        poisson_ratio=sensor.poisson_ratio,
    )
    yielding = model.layer * clamp
    outward, inward = outward * yielding / np.where(distance > 0, distance, 1), inward * yielding
    pull = np.array([np.cos(grasp.shear_direction_rad), np.sin(grasp.shear_direction_rad)])
    athwart = np.array([-pull[1], pull[0]])
    # a tilted object pushes a little sideways
    moved = rest + outward[..., None] * np.append(from_centre, np.zeros((len(rest), 1)), axis=1)
    moved += inward[..., None] * np.append(np.tan(grasp.tilt_rad), -1)
    for sign, *traction in loading.tractions:
        friction, margin = (values[:, None] for values in traction)
        along, across, sunk = partial_slip_displacement(
            from_centre @ pull,
            from_centre @ athwart,
            depth_m,
            friction_coefficient=friction * model.local_friction,
            safety_margin=margin,
            contact_radius_m=contact_m[:, None],
            sphere_radius_m=sphere_m,
            poisson_ratio=sensor.poisson_ratio,
        )
        skin = model.skin_shear * sphere_m * friction / _FITTED_FRICTION * sunken[:, None]
        along = (along + skin * (1 - margin**grasp.shear_exponent)) * (sign * clamp)
        moved[..., :2] += along[..., None] * pull + (across * (sign * clamp))[..., None] * athwart
        moved[..., 2] -= sunk * (sign * clamp)
    return Motion(
        rest_px=geometry.project(rest),
        centres_px=geometry.project(moved),
        scale=geometry.camera_distance(rest) / geometry.camera_distance(moved),
        touch=sunken,
        pressure=np.sqrt(np.maximum(contact_m[:, None] ** 2 - distance**2, 0)) / nominal_m,
        indentation_m=model.layer * np.asarray(indentation(contact_m, sphere_radius_m=sphere_m)),
        nominal_radius_m=float(nominal_m[0]),
        contact_centre_m=centre_m,
        contact_radius_m=contact_m,
        stick_radius_m=np.asarray(stick_radius(contact_m, np.nan_to_num(loading.stick_margin, nan=0.0))),
    )
