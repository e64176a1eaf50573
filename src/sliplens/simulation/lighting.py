"""How bright a fingertip's skin is, apart from its markers."""

import numpy as np
from jaxtyping import Float, Float32

from sliplens.simulation.geometry import pixel_grid
from sliplens.simulation.nuisances import Day, Grasp
from sliplens.simulation.sensor import Sensor

_WHITE = 258.0
"""Glare ends a little above white: the markers in it are seen, the noise is not."""
_GRAIN_PX = 2.2
"""Size of the pressed skin's grain."""
_GLOW_RADIUS = 0.935
"""Where the glow of the contact fades, over the radius of a nominal contact."""


def brightness(sensor: Sensor, *, day: Day) -> Float32[np.ndarray, "3 height width"]:
    """Brightness of the untouched skin over the sensor's background.

    Gain, white balance, vignette, lamps, and a linear fall of brightness across the image.
    """
    x, y = np.moveaxis(pixel_grid(sensor.image_size_px) / (sensor.image_size_px - 1) - 0.5, -1, 0)
    cos, sin = np.cos(day.gradient_direction_rad), np.sin(day.gradient_direction_rad)
    # the brightest corner keeps its level
    fall = 1 - day.gradient * (0.5 - (x * cos + y * sin) / (abs(cos) + abs(sin)))
    corner = 1 - sensor.vignette * 2 * (x**2 + y**2)
    even = day.gain * (fall * corner)[..., None] * np.asarray(day.white_balance)
    for lamp in sensor.lights:
        towards = 2 * (x * np.cos(np.radians(lamp.direction_deg)) + y * np.sin(np.radians(lamp.direction_deg)))
        even = even * (1 + lamp.fall * towards[..., None] * np.asarray(lamp.share))
    return _planes(even)


def empty_view(
    sensor: Sensor, *, day: Day, light: Float32[np.ndarray, "3 height width"]
) -> Float32[np.ndarray, "3 height width"]:
    """Untouched sensor without its markers, the lamps' glare included, in grey levels."""
    skin = np.asarray(sensor.background, dtype=np.float32)[:, None, None] * light
    glare = sensor.glare
    if glare is None:
        return skin
    bearings = np.radians(glare.bearing_deg) + 2 * np.pi * np.arange(glare.lamps) / glare.lamps
    lamps = np.asarray(glare.centre_px) + glare.radius_px * np.stack([np.cos(bearings), np.sin(bearings)], axis=-1)
    away = ((pixel_grid(sensor.image_size_px)[:, :, None] - lamps) ** 2).sum(axis=-1)
    spots = np.exp(-away / (2 * glare.width_px**2)).sum(axis=-1)
    return np.minimum(skin + _planes(day.glare * spots[..., None] * np.asarray(glare.colour)), np.float32(_WHITE))


def relief(sensor: Sensor, *, contact_px: Float[np.ndarray, "2"]) -> Float32[np.ndarray, "3 height width"] | None:
    """Relative change of brightness where the skin slopes by 1 away from a contact; None for a sensor without lamps.

    The dent is a hill to the camera inside: its flank towards a lamp brightens.
    """
    if not sensor.lights:
        return None
    away = pixel_grid(sensor.image_size_px) - contact_px
    bearing = np.arctan2(away[..., 1], away[..., 0])
    lamps = [
        lamp.relief * np.cos(bearing - np.radians(lamp.direction_deg))[..., None] * np.asarray(lamp.share)
        for lamp in sensor.lights
    ]
    return _planes(np.sum(lamps, axis=0))


def haze(
    sensor: Sensor,
    *,
    grasp: Grasp,
    contact_px: Float[np.ndarray, "2"],
    radius_px: float,
    rng: np.random.Generator,
) -> Float32[np.ndarray, "3 height width"]:
    """Grey levels that full contact adds: a veil, a glow where the object reflects the light, the grain of the skin.

    Parameters
    ----------
    sensor, grasp
        The fingertip, and the strength of veil and glow.
    contact_px, radius_px
        Where the camera sees the contact's centre, and how large its radius in a nominal grasp.
    rng
        Source of the grain.
    """
    if not sensor.sees_contact:
        return np.zeros((3, sensor.image_size_px, sensor.image_size_px), dtype=np.float32)
    square = ((pixel_grid(sensor.image_size_px) - contact_px) ** 2).sum(axis=-1)
    disc = np.exp(-((square / (_GLOW_RADIUS * radius_px) ** 2) ** 2))
    grain = grasp.skin_grain * _smooth_noise(sensor.image_size_px, rng=rng)
    return _planes(np.asarray(grasp.veil) + disc[..., None] * np.asarray(grasp.glow) + grain[..., None])


def _smooth_noise(size: int, *, rng: np.random.Generator) -> Float[np.ndarray, "size size"]:
    """Noise of unit variance that keeps its sign over a few pixels."""
    steps = np.arange(-8, 9)
    kernel = np.exp(-(steps**2) / (2 * _GRAIN_PX**2))
    kernel /= np.linalg.norm(kernel)
    windows = np.lib.stride_tricks.sliding_window_view
    rows = windows(rng.standard_normal((size + 16, size + 16)), len(kernel), axis=1) @ kernel
    return windows(rows, len(kernel), axis=0) @ kernel


def _planes(image: Float[np.ndarray, "height width 3"]) -> Float32[np.ndarray, "3 height width"]:
    return np.ascontiguousarray(np.moveaxis(image, -1, 0), dtype=np.float32)
