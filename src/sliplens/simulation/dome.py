"""A dome with markers in rings, seen by a fisheye camera inside it."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from sliplens.errors import ContactError
from sliplens.simulation.geometry import require_positive, squared_distance


@dataclass(frozen=True, kw_only=True)
class Dome:
    """A dome pressed on a flat, seen by an equidistant fisheye (image radius = focal length x angle).

    The origin is the dome's centre. Markers stand in rings round the apex, each ring with one straight up.

    Raises
    ------
    ContactError
        If a length is not positive, the camera is outside the dome, or a marker is.
    """

    radius_m: float
    camera_offset: float
    """How far the camera lies behind the dome's centre, in dome radii."""
    focal_px_per_rad: float
    centre_px: tuple[float, float]
    """Where the apex is seen: x, y."""
    ring_spacing_deg: float
    ring_counts: tuple[int, ...]
    """Markers in each ring, from the one at the apex outwards."""
    ring_scale: tuple[float, ...]
    """Marker size by ring."""

    def __post_init__(self) -> None:
        """Check what cannot occur."""
        require_positive(
            {
                "dome radius": self.radius_m,
                "focal length": self.focal_px_per_rad,
                "ring spacing": self.ring_spacing_deg,
            }
        )
        if not -1 < self.camera_offset < 1:
            raise ContactError(
                f"the camera lies {self.camera_offset:.3g} dome radii behind the centre, outside the dome; "
                "give an offset between -1 and 1"
            )
        if len(self.ring_scale) != len(self.ring_counts):
            raise ContactError(
                f"the dome has {len(self.ring_counts)} rings but {len(self.ring_scale)} marker sizes; give one a ring"
            )
        outermost = (len(self.ring_counts) - 1) * self.ring_spacing_deg
        if outermost > 90:
            raise ContactError(
                f"the outermost ring would lie {outermost:.4g} degrees from the apex, outside the dome, which ends at "
                "90; use fewer rings or space them closer"
            )

    @property
    def sphere_radius_m(self) -> float:
        """Radius of the dome."""
        return self.radius_m

    @property
    def markers(self) -> int:
        """How many markers there are."""
        return sum(self.ring_counts)

    def marker_rings(self) -> np.ndarray:
        """Ring of each marker, 0 at the apex; shape (markers,)."""
        return np.repeat(np.arange(len(self.ring_counts)), self.ring_counts)

    def marker_scale(self) -> Float[np.ndarray, " markers"]:
        """Size of each marker at rest, over the sensor's marker radius."""
        return np.asarray(self.ring_scale)[self.marker_rings()]

    def marker_positions(self, depth_m: float = 0.0) -> Float[np.ndarray, "markers 3"]:
        """Where the markers lie on the untouched dome.

        Raises
        ------
        ContactError
            If the depth is negative or reaches the dome's centre.
        """
        if not 0 <= depth_m < self.radius_m:
            raise ContactError(
                f"markers {depth_m:.3g} m under the skin lie outside a dome of radius {self.radius_m:.3g} m; "
                "give a depth from 0 to less than the radius"
            )
        polar, azimuth = [], []
        for ring, count in enumerate(self.ring_counts):
            polar += [ring * math.radians(self.ring_spacing_deg)] * count
            # rows run down, so straight up is -90 degrees
            azimuth += [2 * math.pi * index / count - math.pi / 2 for index in range(count)]
        theta, phi = np.asarray(polar), np.asarray(azimuth)
        direction = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
        return direction * (self.radius_m - depth_m)

    def skin_point(self, sideways_m: Float[np.ndarray, "2"]) -> Float[np.ndarray, "3"]:
        """Point of the skin at rest, so far from the axis."""
        return np.append(sideways_m, np.sqrt(self.radius_m**2 - sideways_m @ sideways_m))

    def slope_cosine(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
        """Cosine of the polar angle; 0 below the equator."""
        return np.clip(points[..., 2] / np.linalg.norm(points, axis=-1), 0, 1)

    def project(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Pixel coordinates (x, y) of points."""
        sideways = np.hypot(points[..., 0], points[..., 1])
        ahead = points[..., 2] + self.camera_offset * self.radius_m
        on_axis = sideways < 1e-9 * self.radius_m
        angle_per_m = np.where(on_axis, 1 / ahead, np.arctan2(sideways, ahead) / np.where(on_axis, 1, sideways))
        return np.asarray(self.centre_px) + points[..., :2] * (angle_per_m * self.focal_px_per_rad)[..., None]

    def camera_distance(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
        """Distance of points from the camera."""
        return np.linalg.norm(points + np.array([0.0, 0.0, self.camera_offset * self.radius_m]), axis=-1)

    def rays(self, pixels: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """How far each pixel looks sideways (x and y) for each metre ahead."""
        away = (pixels - np.asarray(self.centre_px)) / self.focal_px_per_rad
        # rays at a right angle to the axis never meet the object; these stay finite and far away
        angle = np.minimum(np.linalg.norm(away, axis=-1), 1.5)
        return away * (np.tan(angle) / np.where(angle > 0, angle, 1))[..., None]

    def face_distance_squared(
        self,
        rays: Float[np.ndarray, "height width 2"],
        *,
        contact_centre_m: Float[np.ndarray, "2"],
        indentation_m: Float[np.ndarray, " frames"],
    ) -> Float32[np.ndarray, "frames height width"]:
        """Squared distance from the contact's centre at which each ray meets the object's face, in square metres.

        The face is the plane that Hertz's displacement makes of the sphere near its apex:
        z = R - delta + |c|^2 / (2 R) - c . (x, y) / R, with the contact's centre c.
        """
        centre = contact_centre_m
        height = self.radius_m * (1 + self.camera_offset) - indentation_m + centre @ centre / (2 * self.radius_m)
        return squared_distance(rays / (1 + rays @ centre / self.radius_m)[..., None], height=height, centre=centre)
