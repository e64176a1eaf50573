"""Shapes of fingertips: where the markers lie, where the camera sees them, and where the skin touches.

Lengths are in metres: x right, y down, z towards the object; the skin's foremost point is at its middle.
"""

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float32

from sliplens.errors import ContactError


@runtime_checkable
class Geometry(Protocol):
    """What the simulator asks of a fingertip's shape."""

    @property
    def sphere_radius_m(self) -> float:
        """Radius of the sphere in the contact: the fingertip's own, or that of the ball pressed on a flat one."""
        ...

    @property
    def centre_px(self) -> tuple[float, float]:
        """Where the camera sees the skin's middle: x, y."""
        ...

    @property
    def markers(self) -> int:
        """How many markers there are."""
        ...

    def marker_scale(self) -> Float[np.ndarray, " markers"]:
        """Size of each marker at rest, over the sensor's marker radius."""
        ...

    def marker_positions(self, depth_m: float = 0.0) -> Float[np.ndarray, "markers 3"]:
        """Where the markers lie at rest, so deep under the skin."""
        ...

    def skin_point(self, sideways_m: Float[np.ndarray, "2"]) -> Float[np.ndarray, "3"]:
        """Point of the skin at rest, so far from the axis."""
        ...

    def slope_cosine(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
        """Cosine between the skin's normal at rest and the camera's axis."""
        ...

    def project(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Pixel coordinates (x, y) of points."""
        ...

    def camera_distance(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
        """Distance of points from the camera."""
        ...

    def rays(self, pixels: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """How far each pixel looks sideways (x and y) for each metre ahead."""
        ...

    def face_distance_squared(
        self,
        rays: Float[np.ndarray, "height width 2"],
        *,
        contact_centre_m: Float[np.ndarray, "2"],
        indentation_m: Float[np.ndarray, " frames"],
    ) -> Float32[np.ndarray, "frames height width"]:
        """Squared distance from the contact's centre at which each ray meets the object's face, in square metres."""
        ...


def squared_distance(
    rays: Float[np.ndarray, "height width 2"],
    *,
    height: Float[np.ndarray, " frames"],
    centre: Float[np.ndarray, "2"],
) -> Float32[np.ndarray, "frames height width"]:
    """Squared distance |h u - c|^2 between a point c and where rays of slope u are at heights h."""
    slope, along = (rays**2).sum(axis=-1).astype(np.float32), (rays @ (2 * centre)).astype(np.float32)
    up = height.astype(np.float32)[:, None, None]
    square = up * slope
    square -= along
    square *= up
    square += np.float32(centre @ centre)
    # rounding may leave a little less than nothing at the centre
    return np.maximum(square, 0, out=square)


def require_positive(values: Mapping[str, float | int]) -> None:
    """Check the lengths and counts of a shape.

    Raises
    ------
    ContactError
        Naming the first that is not positive.
    """
    for name, value in values.items():
        if not value > 0:
            raise ContactError(f"{name} must be positive, got {value:.3g}; check the sensor's sheet")


def pixel_grid(size_px: int) -> Float[np.ndarray, "size size 2"]:
    """Coordinates (x, y) of every pixel of a square image."""
    steps = np.arange(size_px, dtype=np.float64)
    return np.stack(np.meshgrid(steps, steps), axis=-1)
