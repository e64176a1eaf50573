"""Shapes of fingertips: places of the markers, their images, and the contact of the skin.

Lengths are in metres: x right, y down, z towards the object; the skin's foremost point is at its middle.
"""

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, Float32

from sliplens.errors import ContactError

Frames: TypeAlias = Float[np.ndarray, " frames"]
Point: TypeAlias = Float[np.ndarray, "2"]
Rays: TypeAlias = Float[np.ndarray, "height width 2"]
Maps: TypeAlias = Float32[np.ndarray, "frames height width"]


def _squared_distance(rays: Rays, *, height: Frames, centre: Point) -> Maps:
    """Squared distance |h u - c|^2 between a point c and where rays of slope u are at heights h."""
    slope, along = (rays**2).sum(axis=-1).astype(np.float32), (rays @ (2 * centre)).astype(np.float32)
    up = height.astype(np.float32)[:, None, None]
    square = up * slope
    square -= along
    square *= up
    square += np.float32(centre @ centre)
    # rounding may leave a little less than nothing at the centre
    return np.maximum(square, 0, out=square)


def require_positive(**values: float | int) -> None:
    """Check the lengths and counts of a shape, named in words."""
    for name, value in values.items():
        if not value > 0:
            raise ContactError(f"{name.replace('_', ' ')} must be positive, got {value:.3g}; check the sensor's sheet")


def pixel_grid(size_px: int) -> Float[np.ndarray, "size size 2"]:
    """Coordinates (x, y) of every pixel of a square image."""
    steps = np.arange(size_px, dtype=np.float64)
    return np.stack(np.meshgrid(steps, steps), axis=-1)


@dataclass(frozen=True, kw_only=True)
class Dome:
    """A dome pressed on a flat, seen by an equidistant fisheye (image radius = focal length x angle).

    The origin is the dome's centre. Markers stand in rings round the apex, each ring with one straight up.
    """

    radius_m: float
    camera_offset: float
    """Distance of the camera behind the dome's centre, in dome radii."""
    focal_px_per_rad: float
    centre_px: tuple[float, float]
    """Pixel (x, y) at which the apex is seen."""
    ring_spacing_deg: float
    ring_counts: tuple[int, ...]
    """Markers in each ring, from the one at the apex outwards."""
    ring_scale: tuple[float, ...]
    """Marker size by ring."""

    def __post_init__(self) -> None:
        require_positive(
            dome_radius=self.radius_m, focal_length=self.focal_px_per_rad, ring_spacing=self.ring_spacing_deg
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
        """Number of markers."""
        return sum(self.ring_counts)

    def marker_scale(self) -> Float[np.ndarray, " markers"]:
        """Size of each marker at rest, over the sensor's marker radius."""
        return np.repeat(self.ring_scale, self.ring_counts)

    def marker_positions(self, depth_m: float = 0.0) -> Float[np.ndarray, "markers 3"]:
        """Places of the markers under the skin of the untouched dome, in metres."""
        if not 0 <= depth_m < self.radius_m:
            raise ContactError(
                f"markers {depth_m:.3g} m under the skin lie outside a dome of radius {self.radius_m:.3g} m; "
                "give a depth from 0 to less than the radius"
            )
        theta = np.repeat(np.arange(len(self.ring_counts)) * math.radians(self.ring_spacing_deg), self.ring_counts)
        # rows run down, so straight up is -90 degrees
        phi = np.concatenate([2 * math.pi * np.arange(count) / count - math.pi / 2 for count in self.ring_counts])
        direction = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
        return direction * (self.radius_m - depth_m)

    def skin_point(self, sideways_m: Point) -> Float[np.ndarray, "3"]:
        """Point of the skin at rest at a distance (x, y) from the axis."""
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
        """Slopes (x, y) of the pixels' lines of sight: metres sideways for each metre ahead."""
        away = (pixels - np.asarray(self.centre_px)) / self.focal_px_per_rad
        # rays at a right angle to the axis never meet the object; these stay finite and far away
        angle = np.minimum(np.linalg.norm(away, axis=-1), 1.5)
        return away * (np.tan(angle) / np.where(angle > 0, angle, 1))[..., None]

    def face_distance_squared(self, rays: Rays, *, contact_centre_m: Point, indentation_m: Frames) -> Maps:
        """Squared distance from the contact's centre at which each ray meets the object's face, in square metres.

        The face is the plane that Hertz's displacement makes of the sphere near its apex:
        z = R - delta + |c|^2 / (2 R) - c . (x, y) / R, with the contact's centre c.
        """
        centre = contact_centre_m
        height = self.radius_m * (1 + self.camera_offset) - indentation_m + centre @ centre / (2 * self.radius_m)
        return _squared_distance(rays / (1 + rays @ centre / self.radius_m)[..., None], height=height, centre=centre)


@dataclass(frozen=True, kw_only=True)
class FlatPad:
    """A flat gel pressed by a ball, its dots in a square grid, seen by a pinhole camera behind it.

    The origin is the middle of the skin.
    """

    ball_radius_m: float
    camera_distance_m: float
    """Distance from the camera to the skin."""
    focal_px: float
    centre_px: tuple[float, float]
    """Pixel (x, y) at which the middle of the skin is seen."""
    spacing_m: float
    columns: int
    rows: int

    def __post_init__(self) -> None:
        require_positive(ball_radius=self.ball_radius_m, camera_distance=self.camera_distance_m)
        require_positive(focal_length=self.focal_px, dot_spacing=self.spacing_m)
        require_positive(number_of_columns=self.columns, number_of_rows=self.rows)

    @property
    def sphere_radius_m(self) -> float:
        """Radius of the ball."""
        return self.ball_radius_m

    @property
    def markers(self) -> int:
        """Number of dots."""
        return self.columns * self.rows

    def marker_scale(self) -> Float[np.ndarray, " markers"]:
        """Size of each dot at rest: all alike."""
        return np.ones(self.markers)

    def marker_positions(self, depth_m: float = 0.0) -> Float[np.ndarray, "markers 3"]:
        """Places of the dots in the untouched gel, in metres."""
        if not 0 <= depth_m < self.camera_distance_m:
            raise ContactError(
                f"dots {depth_m:.3g} m under the skin do not lie between it and the camera at "
                f"{self.camera_distance_m:.3g} m; give a depth from 0 to less than that"
            )
        x = (np.arange(self.columns) - (self.columns - 1) / 2) * self.spacing_m
        y = (np.arange(self.rows) - (self.rows - 1) / 2) * self.spacing_m
        across, down = np.meshgrid(x, y)
        return np.stack([across.ravel(), down.ravel(), np.full(self.markers, -depth_m)], axis=-1)

    def skin_point(self, sideways_m: Point) -> Float[np.ndarray, "3"]:
        """Point of the skin at rest at a distance (x, y) from the axis."""
        return np.append(sideways_m, 0.0)

    def slope_cosine(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
        """Cosine of the skin's slope: 1, for it is flat."""
        return np.ones(points.shape[:-1])

    def project(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Pixel coordinates (x, y) of points."""
        scale = self.focal_px / (self.camera_distance_m + points[..., 2])
        return np.asarray(self.centre_px) + points[..., :2] * scale[..., None]

    def camera_distance(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
        """Distance of points from the camera."""
        return np.linalg.norm(points + np.array([0.0, 0.0, self.camera_distance_m]), axis=-1)

    def rays(self, pixels: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Slopes (x, y) of the pixels' lines of sight: metres sideways for each metre ahead."""
        return (pixels - np.asarray(self.centre_px)) / self.focal_px

    def face_distance_squared(self, rays: Rays, *, contact_centre_m: Point, indentation_m: Frames) -> Maps:
        """Squared distance from the contact's centre at which each ray meets the ball, in square metres.

        The ball's face is taken at the depth of the contact's edge, delta / 2, where it matters.
        """
        height = self.camera_distance_m - indentation_m / 2
        return _squared_distance(rays, height=height, centre=contact_centre_m)


Geometry: TypeAlias = Dome | FlatPad
"""Shape of a fingertip; another one has the same properties and methods."""
