"""What is simulated: fingertips with markers, as records."""

from dataclasses import dataclass

from sliplens.errors import ContactError
from sliplens.mechanics import reduced_modulus
from sliplens.simulation.dome import Dome
from sliplens.simulation.flat_pad import FlatPad
from sliplens.simulation.geometry import Geometry, require_positive
from sliplens.simulation.look import MarkerLook, Rgb
from sliplens.simulation.noise import Noise


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
class Glare:
    """Reflections of the lamps, evenly spaced on a circle round the view."""

    centre_px: tuple[float, float]
    """Of the circle: x, y."""
    radius_px: float
    lamps: int = 6
    bearing_deg: float
    """Where the first lamp is seen, from the right towards below."""
    width_px: float
    """Standard deviation of a lamp's glare."""
    colour: Rgb
    """Grey levels that a lamp adds at its middle, to background and markers alike; what passes 255 is lost."""


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """A fingertip: its shape and camera, its gel, and how it looks.

    Colours are grey levels (0 to 255) in the order of the image file.

    Raises
    ------
    ContactError
        If a modulus or the image size is not positive, or Poisson's ratio lies outside [0, 0.5].
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
    look: MarkerLook
    background: Rgb
    """In the middle of the image."""
    lights: tuple[Light, ...] = ()
    """What makes slopes of the skin visible; none where the skin is lit evenly."""
    glare: Glare | None = None
    vignette: float
    """Brightness lost at half the image's diagonal, growing with the square of the distance from its middle."""
    sees_contact: bool = True
    """Whether the object shines through the skin: a veil, a glow and the skin's grain in contact."""
    noise: Noise

    def __post_init__(self) -> None:
        """Check what cannot occur."""
        try:
            reduced_modulus(youngs_modulus_pa=self.youngs_modulus_pa, poisson_ratio=self.poisson_ratio)
            require_positive({"image size": self.image_size_px})
            if self.effective_modulus_pa is not None:
                require_positive({"effective modulus": self.effective_modulus_pa})
        except ContactError as error:
            raise ContactError(f"sensor {self.name}: {error}") from None

    @property
    def displacements(self) -> tuple[str, ...]:
        """Displacement models that this sensor can be moved by, its default first."""
        return ("half-space",) if self.effective_modulus_pa is None else ("calibrated", "half-space")


CHROMATOUCH = Sensor(
    name="chromatouch",
    geometry=Dome(
        radius_m=0.020,
        camera_offset=0.34,
        focal_px_per_rad=183.7,
        centre_px=(115.8, 111.3),
        ring_spacing_deg=12.9,
        ring_counts=(1, 6, 12, 17, 21, 25),
        ring_scale=(0.87, 1.03, 1.0, 1.07, 1.07, 1.0),
    ),
    youngs_modulus_pa=400_000.0,
    poisson_ratio=0.5,
    effective_modulus_pa=18_900.0,
    image_size_px=224,
    look=MarkerLook(
        radius_px=(7.16, 6.08, 5.75),
        edge_px=(0.73, 0.88, 0.72),
        contrast=(129.0, 166.0, 75.0),
        defocus_px=(0.45, 0.20, 0.10),
        focus_tilt=(5.5, 2.1),
        squeeze=(0.12, 0.05, -0.03),
        aslant_fade=(0.6, 0.23, 0.46),
        pressed_fade=(0.10, 0.055, 0.11),
    ),
    background=(212.0, 208.0, 128.0),
    glare=Glare(centre_px=(105.0, 112.0), radius_px=128.0, bearing_deg=-5.0, width_px=30.0, colour=(0.0, 84.0, 230.0)),
    vignette=0.2,
    noise=Noise(
        background=(2.3, 2.2, 2.2),
        marker=(8.8, 8.6, 2.8),
        edge=3.0,
        smoothness=0.2,
        red_in_green=0.5,
        grain=(0.12, 0.07, 0.03),
        ragged_px=(0.4, 0.35, 0.2),
    ),
)
"""The ChromaTouch of the thesis: Lin, Willemet, Bailleul and Wiertlewski, RoboSoft 2020; camera, looks and noise fitted
to its published difference images; gel as in Lin and Wiertlewski 2019 (SortaClear 12)."""

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
        background=(2.0, 1.6, 2.2),
        marker=(2.0, 1.6, 2.2),
        edge=0.0,
        smoothness=0.3,
        red_in_green=0.3,
        grain=(0.05, 0.05, 0.05),
        ragged_px=(0.25, 0.25, 0.25),
    ),
)
"""A flat gel like that of a GelSight Mini with dots: a square grid under an opaque skin lit from three sides. Its
numbers are typical (assumed), not fitted to one device."""

SENSORS = {sensor.name: sensor for sensor in (CHROMATOUCH, FLAT_GEL)}
"""Sensors by name."""
