"""What is simulated: a dome of gel, the fisheye camera inside it, and the markers under its skin."""

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from sliplens.errors import ContactError

Rgb: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """A fingertip with markers in rings round its apex, seen from within.

    Positions are in units of the dome's radius with the origin at the dome's centre: x right, y down, z towards the
    apex. Colours are grey levels (0 to 255) in the order of the image file.

    Raises
    ------
    ContactError
        If a length, a modulus or the image size is not positive, or the camera lies outside the dome.
    """

    name: str
    dome_radius_m: float
    youngs_modulus_pa: float
    """Effective: what the marker motion needs, the acrylic core included; dome radius and modulus are not separable."""
    poisson_ratio: float
    camera_offset: float
    """How far the camera lies behind the dome's centre, in dome radii."""
    focal_px_per_rad: float
    image_size_px: int
    centre_px: tuple[float, float]
    """Where the apex is seen: x, y."""
    ring_spacing_deg: float
    ring_counts: tuple[int, ...]
    """Markers in each ring, from the one at the apex outwards; each ring has one straight up."""
    marker_radius_px: Rgb
    """The dye bleeds: a marker is wider in red than in blue, which draws the orange rim of the difference images."""
    marker_edge_px: Rgb
    """Width of the logistic edge."""
    ring_scale: tuple[float, ...]
    """Marker size by ring, over `marker_radius_px`."""
    background: Rgb
    marker_contrast: Rgb
    """How much darker a marker is than the background."""
    vignette: float
    """Brightness lost at half the image's diagonal, growing with the square of the distance from its middle."""

    def __post_init__(self) -> None:
        """Check what cannot occur."""
        positive = {
            "dome radius": self.dome_radius_m,
            "Young's modulus": self.youngs_modulus_pa,
            "focal length": self.focal_px_per_rad,
            "image size": self.image_size_px,
            "ring spacing": self.ring_spacing_deg,
        }
        for name, value in positive.items():
            if not value > 0:
                raise ContactError(f"sensor {self.name}: {name} must be positive, got {value:.3g}; check the sheet")
        if not -1 < self.camera_offset < 1:
            raise ContactError(
                f"sensor {self.name}: the camera lies {self.camera_offset:.3g} dome radii behind the centre, "
                "outside the dome; give an offset between -1 and 1"
            )
        if len(self.ring_scale) != len(self.ring_counts):
            raise ContactError(
                f"sensor {self.name} has {len(self.ring_counts)} rings but {len(self.ring_scale)} marker sizes; "
                "give one a ring"
            )

    def marker_rings(self) -> np.ndarray:
        """Ring of each marker, 0 at the apex; shape (markers,)."""
        return np.repeat(np.arange(len(self.ring_counts)), self.ring_counts)

    def marker_scale(self) -> Float[np.ndarray, " markers"]:
        """Size of each marker at rest, over `marker_radius_px`."""
        return np.asarray(self.ring_scale)[self.marker_rings()]

    def marker_positions(self) -> Float[np.ndarray, "markers 3"]:
        """Where the markers lie on the untouched dome, in dome radii."""
        polar, azimuth = [], []
        for ring, count in enumerate(self.ring_counts):
            polar += [ring * math.radians(self.ring_spacing_deg)] * count
            # rows run down, so straight up is -90 degrees
            azimuth += [2 * math.pi * index / count - math.pi / 2 for index in range(count)]
        theta, phi = np.asarray(polar), np.asarray(azimuth)
        return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)

    def project(self, positions: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Pixel coordinates (x, y) of points, through an equidistant fisheye (image radius = f x angle).

        Parameters
        ----------
        positions
            Points in dome radii.
        """
        sideways = np.hypot(positions[..., 0], positions[..., 1])
        depth = positions[..., 2] + self.camera_offset
        angle = np.arctan2(sideways, depth)
        on_axis = sideways < 1e-9
        scale = np.where(on_axis, 1 / depth, angle / np.where(on_axis, 1, sideways)) * self.focal_px_per_rad
        return np.asarray(self.centre_px) + positions[..., :2] * scale[..., None]

    def camera_distance(self, positions: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
        """Distance of points from the camera, in dome radii."""
        return np.linalg.norm(positions + np.array([0.0, 0.0, self.camera_offset]), axis=-1)


CHROMATOUCH = Sensor(
    name="chromatouch",
    dome_radius_m=0.020,
    youngs_modulus_pa=29_000.0,
    poisson_ratio=0.5,
    camera_offset=0.34,
    focal_px_per_rad=185.0,
    image_size_px=224,
    centre_px=(115.7, 111.2),
    ring_spacing_deg=12.9,
    ring_counts=(1, 6, 12, 17, 21, 25),
    marker_radius_px=(7.5, 6.4, 6.0),
    marker_edge_px=(1.05, 1.0, 0.95),
    ring_scale=(0.87, 0.99, 1.0, 1.03, 1.03, 1.0),
    background=(212.0, 208.0, 128.0),
    marker_contrast=(116.0, 170.0, 71.0),
    vignette=0.2,
)
"""The ChromaTouch of the thesis: Lin, Willemet, Bailleul and Wiertlewski, RoboSoft 2020; camera, marker sizes and
contrast fitted to its published difference images."""
