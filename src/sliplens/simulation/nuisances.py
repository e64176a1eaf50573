"""Nuisances: differences between days, sensors, trials and frames, and how they are drawn."""

import math
from dataclasses import dataclass, fields, replace
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from sliplens.errors import ContactError

Range: TypeAlias = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Nuisances:
    """Ranges of all that a network must not rely on, each (low, high) and drawn evenly.

    Friction and normal force are drawn independently: were they tied, the size of the contact alone would give the
    safety margin. Offsets and depths are in radii of the contact's sphere, angles in degrees, image lengths in pixels,
    brightness in grey levels. A range that runs downwards or holds impossible values is a `ContactError`.
    """

    dry_friction: Range = (0.5, 1.2)
    """Friction of a day's dry object; days are spread over the range."""
    dry_friction_factor: Range = (0.9, 1.1)
    """Friction of a dry trial over its day's."""
    wet_friction: Range = (0.15, 0.7)
    wet_friction_drift: Range = (-0.15, 0.15)
    """Relative change over a wet trial."""
    kinetic_ratio: Range = (0.7, 0.9)
    """Kinetic over static friction."""
    stick_slip_share: Range = (0.0, 0.5)
    """Share of static less kinetic friction that a sliding contact regains before it slips again."""
    stick_slip_hz: Range = (2.0, 8.0)
    normal_force_n: Range = (0.5, 2.0)
    normal_force_drift: Range = (-0.05, 0.05)
    modulus_factor: Range = (0.8, 1.2)
    contact_offset: Range = (0.0, 0.12)
    tilt_deg: Range = (-5.0, 5.0)
    shear_direction_deg: Range = (75.0, 105.0)
    """Direction of the pull; 90 is down the image, as in the thesis."""
    shear_exponent: Range = (0.45, 0.7)
    creep: Range = (0.03, 0.08)
    creep_time_s: Range = (0.5, 3.0)
    white_balance: Range = (0.95, 1.05)
    gain: Range = (0.9, 1.1)
    illumination_gradient: Range = (0.0, 0.25)
    """Brightness lost across the image, in a direction drawn by day."""
    glare: Range = (0.5, 1.1)
    """Strength of the lamps' reflections over the sensor's."""
    camera_shift_px: Range = (-3.0, 3.0)
    camera_rotation_deg: Range = (-3.0, 3.0)
    sensor_gain: Range = (1.0, 1.0)
    """Gain of a sensor's camera, which `gain` changes by day; in the same way for the next five."""
    sensor_white_balance: Range = (1.0, 1.0)
    sensor_gradient: Range = (0.0, 0.0)
    sensor_glare: Range = (1.0, 1.0)
    sensor_shift_px: Range = (0.0, 0.0)
    sensor_rotation_deg: Range = (0.0, 0.0)
    frame_turn_deg: Range = (0.0, 0.0)
    """Turn of the camera against the reference frame, drawn for each frame."""
    frame_zoom: Range = (1.0, 1.0)
    """Magnification of each frame over that of the reference frame."""
    marker_jitter_px: float = 0.4
    """Standard deviation of the markers' centres, by sensor."""
    marker_depth: Range = (0.0, 0.1)
    """Depth of a sensor's markers under the skin."""
    marker_radius: Range = (0.95, 1.05)
    marker_contrast: Range = (0.85, 1.15)
    blur_px: Range = (0.0, 1.0)
    veil: Range = (2.5, 6.0)
    """Grey levels by which the whole image brightens in contact."""
    glow: Range = (2.0, 8.0)
    """Grey levels by which the contact brightens beyond that."""
    skin_grain: Range = (0.8, 2.4)
    """Standard deviation of the grey levels by which pressed skin shows its grain."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            low, high = value if isinstance(value, tuple) else (value, value)
            least, most = _LIMITS.get(field.name, (-_MOST, _MOST))
            if not least <= low <= high <= most:
                raise ContactError(f"{field.name} is {value}; give a low, then a high, from {least:g} to {most:g}")


_MOST, _SMALL = 1e6, 1e-6
_LIMITS: dict[str, Range] = {
    **dict.fromkeys(("dry_friction", "dry_friction_factor", "wet_friction", "normal_force_n"), (_SMALL, _MOST)),
    **dict.fromkeys(("modulus_factor", "shear_exponent", "creep_time_s", "stick_slip_hz"), (_SMALL, _MOST)),
    **dict.fromkeys(("white_balance", "gain", "marker_radius", "marker_contrast"), (_SMALL, _MOST)),
    **dict.fromkeys(("sensor_gain", "sensor_white_balance", "frame_zoom"), (_SMALL, _MOST)),
    **dict.fromkeys(("creep", "glare", "sensor_glare", "skin_grain", "marker_jitter_px", "blur_px"), (0.0, _MOST)),
    **dict.fromkeys(("stick_slip_share", "illumination_gradient", "sensor_gradient"), (0.0, 1.0)),
    **dict.fromkeys(("contact_offset", "marker_depth"), (0.0, 0.5)),
    **dict.fromkeys(("normal_force_drift", "wet_friction_drift"), (-0.5, 0.5)),
    "kinetic_ratio": (_SMALL, 1.0),
}
"""Smallest and largest value of a range."""


@dataclass(frozen=True, kw_only=True)
class CameraSetup:
    """Pose and light of a camera: its shift and turn in the image, gain, white balance, light gradient and glare."""

    gain: float = 1.0
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    gradient: float = 0.0
    gradient_direction_rad: float = 0.0
    glare: float = 1.0
    camera_shift_px: tuple[float, float] = (0.0, 0.0)
    camera_rotation_rad: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Day(CameraSetup):
    """Draws of a day: the friction of the dry object, the gel's stiffness, light and camera."""

    friction: float = 0.775
    modulus_factor: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Unit:
    """Draws of one built sensor: places, size and dye of its markers."""

    marker_jitter_px: Float[np.ndarray, "markers 2"]
    marker_depth: float
    """Depth of the markers under the skin, in radii of the contact's sphere."""
    radius_factor: Float[np.ndarray, " markers"]
    contrast_factor: Float[np.ndarray, " markers"]
    texture_seed: int
    """Seed of the grain of its print."""


@dataclass(frozen=True, kw_only=True)
class Grasp:
    """Draws of one trial; the defaults are fitted to the trial of the real images, as far as they show it."""

    friction: float = 0.775
    """Coefficient of friction: unpublished, so the geometric mean of the dry range (assumed)."""
    friction_drift: float = 0.0
    kinetic_ratio: float = 1.0
    stick_slip_share: float = 0.0
    stick_slip_hz: float = 4.0
    normal_force_n: float = 1.86
    """Force that gives the fitted radius of contact with the sensor's effective modulus."""
    normal_force_drift: float = 0.0
    contact_offset: tuple[float, float] = (0.092, -0.033)
    tilt_rad: tuple[float, float] = (0.0, 0.0)
    shear_direction_rad: float = 1.512
    shear_exponent: float = 0.495
    creep: float = 0.0
    creep_time_s: float = 1.0
    blur_px: float = 0.0
    veil: tuple[float, float, float] = (5.3, 4.8, 4.2)
    glow: tuple[float, float, float] = (4.0, 3.8, 2.6)
    skin_grain: float = 1.5
    modulus_factor: float = 1.0
    """That of the day."""
    marker_depth: float = 0.03
    """Depth of the sensor's markers under the skin, in radii of the contact's sphere."""


_BUILT_IN = tuple(map("sensor_{}".format, ("gain", "white_balance", "gradient", "glare", "shift_px", "rotation_deg")))
_DAILY = ("gain", "white_balance", "illumination_gradient", "glare", "camera_shift_px", "camera_rotation_deg")


def draw_camera(nuisances: Nuisances, *, rng: np.random.Generator, ranges: tuple[str, ...] = _BUILT_IN) -> CameraSetup:
    """Draw a camera and its lamps from some ranges: as built into a sensor (`sensor_...`), or their daily change."""
    gain, white_balance, gradient, glare, shift_px, rotation_deg = (getattr(nuisances, name) for name in ranges)
    return CameraSetup(
        gain=rng.uniform(*gain),
        white_balance=_three(rng, white_balance),
        gradient=rng.uniform(*gradient),
        gradient_direction_rad=rng.uniform(-np.pi, np.pi),
        glare=rng.uniform(*glare),
        camera_shift_px=(rng.uniform(*shift_px), rng.uniform(*shift_px)),
        camera_rotation_rad=float(np.radians(rng.uniform(*rotation_deg))),
    )


def mount_camera(day: Day, camera: CameraSetup) -> Day:
    """Return a day as the camera of a sensor sees it: shifts, turns and gradients add, gains and glare multiply.

    Examples
    --------
    >>> mount_camera(Day(camera_shift_px=(0.1, 0.0)), CameraSetup(camera_shift_px=(2.0, 1.0))).camera_shift_px
    (2.1, 1.0)
    """
    slopes = [part.gradient * np.exp(1j * part.gradient_direction_rad) for part in (day, camera)]
    slope = complex(sum(slopes))
    red, green, blue = (change * fixed for change, fixed in zip(day.white_balance, camera.white_balance, strict=True))
    (x, y), (fixed_x, fixed_y) = day.camera_shift_px, camera.camera_shift_px
    return replace(
        day,
        gain=day.gain * camera.gain,
        white_balance=(red, green, blue),
        gradient=abs(slope),
        gradient_direction_rad=float(np.angle(slope)),
        glare=day.glare * camera.glare,
        camera_shift_px=(x + fixed_x, y + fixed_y),
        camera_rotation_rad=day.camera_rotation_rad + camera.camera_rotation_rad,
    )


def draw_day(nuisances: Nuisances, *, quantile: float, rng: np.random.Generator) -> Day:
    """Draw a day; `quantile` places its dry friction in the range, from 0 to 1, so that days can be spread."""
    low, high = nuisances.dry_friction
    modulus_factor = rng.uniform(*nuisances.modulus_factor)
    camera = draw_camera(nuisances, rng=rng, ranges=_DAILY)
    return Day(friction=low + quantile * (high - low), modulus_factor=modulus_factor, **vars(camera))


def draw_unit(nuisances: Nuisances, *, markers: int, rng: np.random.Generator) -> Unit:
    """Draw a built sensor."""
    return Unit(
        marker_jitter_px=rng.normal(0, nuisances.marker_jitter_px, (markers, 2)),
        marker_depth=rng.uniform(*nuisances.marker_depth),
        # one factor for the whole print, and a little for each marker
        radius_factor=rng.uniform(*nuisances.marker_radius) * rng.normal(1, 0.01, markers),
        contrast_factor=rng.uniform(*nuisances.marker_contrast) * rng.normal(1, 0.03, markers),
        texture_seed=int(rng.integers(2**32)),
    )


def draw_grasp(nuisances: Nuisances, *, day: Day, wet: bool, rng: np.random.Generator) -> Grasp:
    """Draw a trial of a day."""
    # every trial draws equally often, so that dry and wet twins differ in friction alone
    dry_factor, wet_friction = rng.uniform(*nuisances.dry_friction_factor), rng.uniform(*nuisances.wet_friction)
    drift = rng.uniform(*nuisances.wet_friction_drift)
    reach, bearing = rng.uniform(*nuisances.contact_offset), rng.uniform(-np.pi, np.pi)

    def drawn(*names: str) -> dict[str, float]:
        return {name: rng.uniform(*getattr(nuisances, name)) for name in names}

    return Grasp(
        friction=wet_friction if wet else day.friction * dry_factor,
        friction_drift=drift if wet else 0.0,
        **drawn("kinetic_ratio", "stick_slip_share", "stick_slip_hz", "normal_force_n", "normal_force_drift"),
        contact_offset=(float(reach * np.cos(bearing)), float(reach * np.sin(bearing))),
        tilt_rad=(math.radians(rng.uniform(*nuisances.tilt_deg)), math.radians(rng.uniform(*nuisances.tilt_deg))),
        shear_direction_rad=math.radians(rng.uniform(*nuisances.shear_direction_deg)),
        **drawn("shear_exponent", "creep", "creep_time_s", "blur_px"),
        veil=_three(rng, nuisances.veil),
        glow=_three(rng, nuisances.glow),
        skin_grain=rng.uniform(*nuisances.skin_grain),
    )


def _three(rng: np.random.Generator, limits: Range) -> tuple[float, float, float]:
    first, second, third = rng.uniform(*limits, size=3)
    return float(first), float(second), float(third)
