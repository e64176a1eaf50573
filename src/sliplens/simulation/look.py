"""How markers look to the camera, untouched and pressed: their size, contrast and sharpness by channel."""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from sliplens.simulation.geometry import Geometry, require_positive
from sliplens.simulation.nuisances import Unit

Rgb: TypeAlias = tuple[float, float, float]
_NONE: Rgb = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class MarkerLook:
    """Markers of a sensor, by channel in the order of the image file.

    Raises
    ------
    ContactError
        If a radius or an edge is not positive.
    """

    radius_px: Rgb
    """Dye may bleed: a marker wider in red than in blue draws the orange rim of the ChromaTouch's difference images."""
    edge_px: Rgb
    """Width of the logistic edge of a marker in focus."""
    contrast: Rgb
    """Grey levels by which a marker is darker than the background."""
    defocus_px: Rgb = _NONE
    """Width that the untouched gel's defocus adds in quadrature; pressing takes it away."""
    focus_tilt: tuple[float, float] = (0.0, 0.0)
    """Growth of the defocus along x and y, per radius of the contact's sphere."""
    squeeze: Rgb = _NONE
    """Growth of a marker under the peak pressure of the nominal grasp."""
    aslant_fade: Rgb = _NONE
    """Share of its contrast that a marker seen edge-on loses, growing with the squared sine of its slope."""
    pressed_fade: Rgb = _NONE
    """Share of its contrast that a marker loses in a nominal contact."""

    def __post_init__(self) -> None:
        """Check what cannot occur."""
        for name, values in (("marker radius", self.radius_px), ("marker edge", self.edge_px)):
            require_positive(
                {f"{name} in {channel}": one for channel, one in zip(("red", "green", "blue"), values, strict=True)}
            )


@dataclass(frozen=True, kw_only=True)
class DrawnMarkers:
    """Markers as they are drawn, by frame, marker and channel."""

    radius_px: Float[np.ndarray, "frames markers 3"]
    edge_px: Float[np.ndarray, "frames markers 3"]
    """Width of the logistic edge."""
    contrast: Float[np.ndarray, "frames markers 3"]
    """Over the sensor's own."""


def draw_look(
    look: MarkerLook,
    *,
    geometry: Geometry,
    unit: Unit,
    scale: Float[np.ndarray, "frames markers"],
    pressure: Float[np.ndarray, "frames markers"],
    touch: Float[np.ndarray, " frames"],
    blur_px: Float[np.ndarray, " frames"],
) -> DrawnMarkers:
    """Look of the markers under a load.

    A pressed marker is paler, for the object behind the thin skin throws light back, and it is sharp: pressing brings
    the gel into the focus that the untouched one is out of, most in red and to one side of the image. Markers seen
    aslant are paler, too.

    Parameters
    ----------
    look, geometry
        The sensor's.
    unit
        The built sensor's own sizes and contrasts.
    scale
        Size of each marker over its size at rest.
    pressure
        Pressure over the peak of the nominal grasp's.
    touch
        Indentation over that of the nominal grasp; 0 without contact.
    blur_px
        Standard deviation of the blur that the trial adds.
    """
    rest = geometry.marker_positions()
    aslant = 1 - geometry.slope_cosine(rest)[:, None] ** 2
    pressed = np.minimum(touch, 1)[:, None, None]
    tilt = np.maximum(1 + rest[:, :2] @ np.asarray(look.focus_tilt) / geometry.sphere_radius_m, 0)
    defocus = (1 - pressed) * tilt[:, None] * np.asarray(look.defocus_px)
    # the standard deviation of a logistic edge is 1.81 widths
    blur = blur_px[:, None, None] / 1.81
    size = geometry.marker_scale() * unit.radius_factor * scale
    return DrawnMarkers(
        radius_px=size[..., None] * (1 + pressure[..., None] * np.asarray(look.squeeze)) * np.asarray(look.radius_px),
        edge_px=np.sqrt(np.asarray(look.edge_px) ** 2 + defocus**2 + blur**2),
        contrast=unit.contrast_factor[:, None]
        * (1 - np.asarray(look.aslant_fade) * aslant)
        * (1 - np.asarray(look.pressed_fade) * pressed),
    )
