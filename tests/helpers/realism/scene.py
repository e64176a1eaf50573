"""The trial of the published difference images, real and simulated."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sliplens.images import absolute_difference, read_image
from sliplens.simulation.filming import Film, prepare_film
from sliplens.simulation.loading import load_at_margins
from sliplens.simulation.nuisances import Day, Grasp, Unit
from sliplens.simulation.sensor import CHROMATOUCH, Sensor

PUBLISHED = {51: np.nan, 80: 1.0, 357: 0.6, 433: 0.2, 547: 0.0}
"""Number and safety margin of the published images; the first is before contact."""

MARGINS = np.array([np.nan, 1.0, 0.8, 0.6, 0.4, 0.2, 0.0])
"""Margins that are simulated: those of the images, and those that only the table of markers has."""

SEEN = [1, 3, 5, 6]
"""Where the published frames in contact stand among them."""


@dataclass(frozen=True, kw_only=True)
class Simulated:
    """The simulated trial: its difference images, and where its markers really are."""

    images: np.ndarray
    """(margins, height, width, 3), as `MARGINS`."""
    rest_px: np.ndarray
    """(markers, 2)"""
    centres_px: np.ndarray
    """(margins, markers, 2)"""
    scale: np.ndarray
    """(margins, markers): size over that at rest."""


def read_real(folder: Path) -> np.ndarray:
    """Read the five real difference images, (frames, height, width, 3)."""
    labels = [100 if np.isnan(margin) else round(margin * 100) for margin in PUBLISHED.values()]
    names = [f"image_{number}.tiff_{label}.png" for number, label in zip(PUBLISHED, labels, strict=True)]
    return np.stack([read_image(folder / "difference" / name) for name in names])


def nominal_unit(markers: int) -> Unit:
    """Sensor built exactly as drawn, with so many markers."""
    ones = np.ones(markers)
    return Unit(
        marker_jitter_px=np.zeros((markers, 2)),
        marker_depth=0.0,
        radius_factor=ones,
        contrast_factor=ones,
        texture_seed=0,
    )


def without_noise(sensor: Sensor) -> Sensor:
    """Return a sensor with a camera without noise and an even print."""
    nothing = dict.fromkeys(("background", "marker", "grain", "ragged_px"), (0.0, 0.0, 0.0))
    return replace(sensor, noise=replace(sensor.noise, **nothing))


def film_of(
    margins: Sequence[float] | np.ndarray,
    *,
    grasp: Grasp,
    sensor: Sensor = CHROMATOUCH,
    day: Day | None = None,
    noise: bool = False,
    displacement: str | None = None,
) -> Film:
    """Film frames of given margins on the nominal sensor."""
    return prepare_film(
        sensor if noise else without_noise(sensor),
        loading=load_at_margins(np.array(margins), grasp=grasp),
        grasp=grasp,
        day=day or Day(),
        unit=nominal_unit(sensor.geometry.markers),
        rng=np.random.default_rng(0),
        displacement=displacement,
    )


def simulate() -> Simulated:
    """Simulate the trial with the fitted defaults of `Grasp`, on the nominal sensor."""
    film = film_of(MARGINS, grasp=Grasp(), noise=True)
    return Simulated(
        images=absolute_difference(film.draw(slice(0, len(MARGINS))).numpy(), film.draw_reference().numpy()),
        rest_px=film.marker_rest_px,
        centres_px=film.marker_px,
        scale=film.motion.scale,
    )
