"""Simulated fingertips with markers: shape and camera, gel, look and noise.

Lengths are in metres: x right, y down, z towards the object; the skin's foremost point is at its middle.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from torch import Tensor

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
    focal_px: float
    centre_px: tuple[float, float]
    """Pixel (x, y) at which the middle of the skin is seen."""
    spacing_m: float
    columns: int
    rows: int

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


Rgb: TypeAlias = tuple[float, float, float]
_NONE: Rgb = (0.0, 0.0, 0.0)
_FIELDS = 32
_PLAY_PX = 64  # how much larger than a frame the fields are: a frame's window lies anywhere in them


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Standard deviation of one frame's noise by channel, in grey levels, and its smoothness."""

    background: Rgb
    marker: Rgb
    edge: float
    """Excess of the noise of a marker's edge, where the video's compression rings, over that inside: at a share s of
    marker in the pixel the noise has s (1 + edge (1 - s)) of the marker's excess over the background's."""
    smoothness: float
    """Weight w of the neighbour's noise in a pixel; the lag-1 correlation is w / (1 + w^2)."""
    red_in_green: float
    """Correlation of red and green, which the camera's debayering ties together."""
    grain: Rgb
    """Unevenness of the print, which moves with a marker, over its contrast."""
    ragged_px: Rgb
    """Unevenness of a marker's edge."""


def pick_noise(frames: int, *, rng: np.random.Generator) -> Int[np.ndarray, "frames 2 3"]:
    """Draw two different fields of the bank for each frame, and where their windows begin: field, row, column."""
    first = rng.integers(_FIELDS, size=frames)
    second = (first + rng.integers(1, _FIELDS, size=frames)) % _FIELDS
    corner = rng.integers(_PLAY_PX + 1, size=(frames, 2, 2))
    return np.concatenate([np.stack([first, second], axis=-1)[..., None], corner], axis=-1)


def mix_noise(
    picks: Int[np.ndarray, "frames 2 3"], *, noise: Noise, image_size_px: int
) -> Float[Tensor, "3 frames size size"]:
    """Compute noise of unit variance for each frame.

    The sum of two windows out of 32 fields repeats after some 10^10 frames, and costs two reads and an addition.
    """
    bank = _noise_bank(noise, image_size_px + _PLAY_PX)
    size = image_size_px
    first, second = (
        torch.stack([bank[:, field, row : row + size, column : column + size] for field, row, column in part], dim=1)
        for part in (picks[:, 0], picks[:, 1])
    )
    return first + second


@lru_cache(maxsize=4)
def _noise_bank(noise: Noise, side: int) -> Float[Tensor, "3 fields side side"]:
    """Draw fields of variance 1/2, smooth over neighbours, red and green correlated; always the same."""
    white = np.random.default_rng(0).standard_normal((3, _FIELDS, side + 1, side + 1), dtype=np.float32)
    rows = white[:, :, :-1] + noise.smoothness * white[:, :, 1:]
    smooth = rows[..., :-1] + noise.smoothness * rows[..., 1:]
    smooth /= (1 + noise.smoothness**2) * np.sqrt(2)
    smooth[1] = noise.red_in_green * smooth[0] + np.sqrt(1 - noise.red_in_green**2) * smooth[1]
    return torch.from_numpy(smooth)


@dataclass(frozen=True, kw_only=True)
class MarkerLook:
    """Markers of a sensor, by channel in the order of the image file."""

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


@dataclass(frozen=True, kw_only=True)
class Light:
    """A coloured lamp at the side of the gel: skin that leans towards it brightens, skin that leans away darkens."""

    direction_deg: float
    """Direction it shines from, as seen in the image: 0 from the right, 90 from below."""
    share: Rgb
    """Share of the background's brightness."""
    fall: float
    """Share of its light won at the edge of the image near the lamp, and lost at the other."""
    relief: float
    """Relative change of its brightness for a slope of 1."""


@dataclass(frozen=True, kw_only=True)
class Glare:
    """Reflections of the lamps, evenly spaced on a circle round the view."""

    centre_px: tuple[float, float]
    """Centre (x, y) of the circle."""
    radius_px: float
    lamps: int = 6
    bearing_deg: float
    """Bearing of the first lamp, from the right towards below."""
    width_px: float
    """Standard deviation of a lamp's glare."""
    colour: Rgb
    """Grey levels that a lamp adds at its middle, to background and markers alike; what passes 255 is lost."""


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """A fingertip: its shape and camera, its gel, and how it looks.

    Colours are grey levels (0 to 255) in the order of the image file. Another geometry has the members of `Dome`.
    """

    name: str
    geometry: Dome | FlatPad
    youngs_modulus_pa: float
    poisson_ratio: float
    effective_modulus_pa: float | None = None
    """Modulus that the calibrated marker motion needs, core and large strains included; radius and modulus are not
    separable there. None where no motion was calibrated."""
    image_size_px: int
    look: MarkerLook
    background: Rgb
    """Colour in the middle of the image."""
    lights: tuple[Light, ...] = ()
    """Lamps that make slopes of the skin visible; none where the skin is lit evenly."""
    glare: Glare | None = None
    vignette: float
    """Brightness lost at half the image's diagonal, growing with the square of the distance from its middle."""
    sees_contact: bool = True
    """True where the object shines through the skin: a veil, a glow and the skin's grain in contact."""
    noise: Noise

    @property
    def displacements(self) -> tuple[str, ...]:
        """Displacement models of this sensor, its default first."""
        return ("half-space",) if self.effective_modulus_pa is None else ("calibrated", "half-space")


CHROMATOUCH = Sensor(
    name="chromatouch",
    geometry=Dome(
        radius_m=0.020, camera_offset=0.34, focal_px_per_rad=183.7, centre_px=(115.8, 111.3), ring_spacing_deg=12.9,
        ring_counts=(1, 6, 12, 17, 21, 25), ring_scale=(0.87, 1.03, 1.0, 1.07, 1.07, 1.0),
    ),
    youngs_modulus_pa=400_000.0, poisson_ratio=0.5, effective_modulus_pa=18_900.0,
    image_size_px=224,
    look=MarkerLook(
        radius_px=(7.16, 6.08, 5.75), edge_px=(0.73, 0.88, 0.72), contrast=(129.0, 166.0, 75.0),
        defocus_px=(0.45, 0.20, 0.10), focus_tilt=(5.5, 2.1), squeeze=(0.12, 0.05, -0.03),
        aslant_fade=(0.6, 0.23, 0.46), pressed_fade=(0.10, 0.055, 0.11),
    ),
    background=(212.0, 208.0, 128.0),
    glare=Glare(centre_px=(105.0, 112.0), radius_px=128.0, bearing_deg=-5.0, width_px=30.0, colour=(0.0, 84.0, 230.0)),
    vignette=0.2,
    noise=Noise(
        background=(2.3, 2.2, 2.2), marker=(8.8, 8.6, 2.8), edge=3.0, smoothness=0.2, red_in_green=0.5,
        grain=(0.12, 0.07, 0.03), ragged_px=(0.4, 0.35, 0.2),
    ),
)  # fmt: skip
"""The ChromaTouch of the thesis: Lin, Willemet, Bailleul and Wiertlewski, RoboSoft 2020; camera, looks and noise fitted
to its published difference images; gel as in Lin and Wiertlewski 2019 (SortaClear 12)."""

FLAT_GEL = Sensor(
    name="flat-gel",
    geometry=FlatPad(
        ball_radius_m=0.012, camera_distance_m=0.020, focal_px=340.0, centre_px=(111.5, 111.5),
        spacing_m=0.0019, columns=9, rows=9,
    ),
    youngs_modulus_pa=500_000.0, poisson_ratio=0.48,
    image_size_px=224,
    look=MarkerLook(radius_px=(5.6, 5.6, 5.6), edge_px=(0.9, 0.9, 0.9), contrast=(84.0, 104.0, 136.0)),
    background=(120.0, 140.0, 176.0),
    lights=(
        Light(direction_deg=180.0, share=(0.1, 0.5, 0.15), fall=0.8, relief=3.0),
        Light(direction_deg=-90.0, share=(0.1, 0.2, 0.55), fall=0.8, relief=3.0),
        Light(direction_deg=40.0, share=(0.6, 0.15, 0.2), fall=0.8, relief=3.0),
    ),
    vignette=0.25,
    sees_contact=False,
    noise=Noise(
        background=(2.0, 1.6, 2.2), marker=(2.0, 1.6, 2.2), edge=0.0, smoothness=0.3, red_in_green=0.3,
        grain=(0.05, 0.05, 0.05), ragged_px=(0.25, 0.25, 0.25),
    ),
)  # fmt: skip
"""A flat gel like that of a GelSight Mini with dots: a square grid under an opaque skin lit from three sides. Its
numbers are typical (assumed), not fitted to one device."""

SENSORS = {sensor.name: sensor for sensor in (CHROMATOUCH, FLAT_GEL)}
"""Sensors by name."""
