"""A flat gel with dots in a grid, seen by a camera behind it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from sliplens.errors import ContactError
from sliplens.simulation.geometry import require_positive, squared_distance


@dataclass(frozen=True, kw_only=True)
class FlatPad:
    """A flat gel pressed by a ball, its dots in a square grid, seen by a pinhole camera behind it.

    The origin is the middle of the skin.

    Raises
    ------
    ContactError
        If a length or a count is not positive.
    """

    ball_radius_m: float
    camera_distance_m: float
    """From the camera to the skin."""
    focal_px: float
    centre_px: tuple[float, float]
    """Where the middle of the skin is seen: x, y."""
    spacing_m: float
    columns: int
    rows: int

    def __post_init__(self) -> None:
        """Check what cannot occur."""
        require_positive(
            {
                "ball radius": self.ball_radius_m,
                "camera distance": self.camera_distance_m,
                "focal length": self.focal_px,
                "dot spacing": self.spacing_m,
                "number of columns": self.columns,
                "number of rows": self.rows,
            }
        )

    @property
    def sphere_radius_m(self) -> float:
        """Radius of the ball."""
        return self.ball_radius_m

    @property
    def markers(self) -> int:
        """How many dots there are."""
        return self.columns * self.rows

    def marker_scale(self) -> Float[np.ndarray, " markers"]:
        """Size of each dot at rest: all alike."""
        return np.ones(self.markers)

    def marker_positions(self, depth_m: float = 0.0) -> Float[np.ndarray, "markers 3"]:
        """Where the dots lie in the untouched gel.

        Raises
        ------
        ContactError
            If the depth is negative or reaches the camera.
        """
        if not 0 <= depth_m < self.camera_distance_m:
            raise ContactError(
                f"dots {depth_m:.3g} m under the skin do not lie between it and the camera at "
                f"{self.camera_distance_m:.3g} m; give a depth from 0 to less than that"
            )
        x = (np.arange(self.columns) - (self.columns - 1) / 2) * self.spacing_m
        y = (np.arange(self.rows) - (self.rows - 1) / 2) * self.spacing_m
        across, down = np.meshgrid(x, y)
        return np.stack([across.ravel(), down.ravel(), np.full(self.markers, -depth_m)], axis=-1)

    def skin_point(self, sideways_m: Float[np.ndarray, "2"]) -> Float[np.ndarray, "3"]:
        """Point of the skin at rest, so far from the axis."""
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
        """How far each pixel looks sideways (x and y) for each metre ahead."""
        return (pixels - np.asarray(self.centre_px)) / self.focal_px

    def face_distance_squared(
        self,
        rays: Float[np.ndarray, "height width 2"],
        *,
        contact_centre_m: Float[np.ndarray, "2"],
        indentation_m: Float[np.ndarray, " frames"],
    ) -> Float32[np.ndarray, "frames height width"]:
        """Squared distance from the contact's centre at which each ray meets the ball, in square metres.

        The ball's face is taken at the depth of the contact's edge, delta / 2, where it matters.
        """
        height = self.camera_distance_m - indentation_m / 2
        return squared_distance(rays, height=height, centre=contact_centre_m)
