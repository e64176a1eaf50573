"""What is simulated: fingertips with markers, as records."""

from dataclasses import dataclass
from typing import TypeAlias

from sliplens.errors import ContactError
from sliplens.mechanics import reduced_modulus
from sliplens.simulation.dome import Dome
from sliplens.simulation.flat_pad import FlatPad
from sliplens.simulation.geometry import Geometry, require_positive

Rgb: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Light:
    """A coloured lamp at the side of the gel: skin that leans towards it brightens, skin that leans away darkens."""

    direction_deg: float
    """From where it shines, as seen in the image: 0 from the right, 90 from below."""
    share: Rgb
    """Of the background's brightness."""
    fall: float
    """Share of that won at the edge of the image near the lamp, and lost at the other."""
    relief: float
    """Relative change of its brightness for a slope of 1."""


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """A fingertip: its shape and camera, its gel, and how it looks.

    Colours are grey levels (0 to 255) in the order of the image file.

    Raises
    ------
    ContactError
        If a modulus, a force or the image size is not positive, Poisson's ratio is outside [0, 0.5], or the calibrated
        motion is asked of a sensor that has no effective modulus.
    """

    name: str
    geometry: Geometry
    youngs_modulus_pa: float
    """Of the gel."""
    poisson_ratio: float
    effective_modulus_pa: float | None = None
    """What the calibrated marker motion needs, core and large strains included; radius and modulus are not separable
    there. None where no motion was calibrated."""
    image_size_px: int
    marker_radius_px: Rgb
    """Dye may bleed: a marker wider in red than in blue draws the orange rim of the ChromaTouch's difference images."""
    marker_edge_px: Rgb
    """Width of the logistic edge."""
    background: Rgb
    """In the middle of the image."""
    lights: tuple[Light, ...] = ()
    """What makes slopes of the skin visible; none where the skin is lit evenly."""
    marker_contrast: Rgb
    """How much darker a marker is than the background."""
    vignette: float
    """Brightness lost at half the image's diagonal, growing with the square of the distance from its middle."""
    sees_contact: bool = True
    """Whether the object shines through the skin: a veil and a glow in contact."""

    def __post_init__(self) -> None:
        """Check what cannot occur."""
        try:
            reduced_modulus(youngs_modulus_pa=self.youngs_modulus_pa, poisson_ratio=self.poisson_ratio)
            positive = {"image size": self.image_size_px, **_rgb("marker radius", self.marker_radius_px)}
            if self.effective_modulus_pa is not None:
                positive["effective modulus"] = self.effective_modulus_pa
            require_positive({**positive, **_rgb("marker edge", self.marker_edge_px)})
        except ContactError as error:
            raise ContactError(f"sensor {self.name}: {error}") from None

    @property
    def displacements(self) -> tuple[str, ...]:
        """Displacement models that this sensor can be moved by, its default first."""
        return ("half-space",) if self.effective_modulus_pa is None else ("calibrated", "half-space")


def _rgb(name: str, values: Rgb) -> dict[str, float]:
    return {f"{name} in {channel}": value for channel, value in zip(("red", "green", "blue"), values, strict=True)}


CHROMATOUCH = Sensor(
    name="chromatouch",
    geometry=Dome(
        radius_m=0.020,
        camera_offset=0.34,
        focal_px_per_rad=185.0,
        centre_px=(115.7, 111.2),
        ring_spacing_deg=12.9,
        ring_counts=(1, 6, 12, 17, 21, 25),
        ring_scale=(0.87, 0.99, 1.0, 1.03, 1.03, 1.0),
    ),
    youngs_modulus_pa=400_000.0,
    poisson_ratio=0.5,
    effective_modulus_pa=29_000.0,
    image_size_px=224,
    marker_radius_px=(7.5, 6.4, 6.0),
    marker_edge_px=(1.05, 1.0, 0.95),
    background=(212.0, 208.0, 128.0),
    marker_contrast=(116.0, 170.0, 71.0),
    vignette=0.2,
)
"""The ChromaTouch of the thesis: Lin, Willemet, Bailleul and Wiertlewski, RoboSoft 2020; camera, marker sizes and
contrast fitted to its published difference images; gel as in Lin and Wiertlewski 2019 (SortaClear 12)."""

FLAT_GEL = Sensor(
    name="flat-gel",
    geometry=FlatPad(
        ball_radius_m=0.012,
        camera_distance_m=0.020,
        focal_px=340.0,
        centre_px=(111.5, 111.5),
        spacing_m=0.0019,
        columns=9,
        rows=9,
    ),
    youngs_modulus_pa=500_000.0,
    poisson_ratio=0.48,
    image_size_px=224,
    marker_radius_px=(5.6, 5.6, 5.6),
    marker_edge_px=(0.9, 0.9, 0.9),
    background=(120.0, 140.0, 176.0),
    lights=(
        Light(direction_deg=180.0, share=(0.1, 0.5, 0.15), fall=0.8, relief=3.0),
        Light(direction_deg=-90.0, share=(0.1, 0.2, 0.55), fall=0.8, relief=3.0),
        Light(direction_deg=40.0, share=(0.6, 0.15, 0.2), fall=0.8, relief=3.0),
    ),
    marker_contrast=(84.0, 104.0, 136.0),
    vignette=0.25,
    sees_contact=False,
)
"""A flat gel like that of a GelSight Mini with dots: a square grid under an opaque skin lit from three sides. Its
numbers are typical (assumed), not fitted to one device."""

SENSORS = {sensor.name: sensor for sensor in (CHROMATOUCH, FLAT_GEL)}
"""Sensors by name."""
