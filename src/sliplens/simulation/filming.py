"""A loaded fingertip filmed: the reference frame and the frames of a trial."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, UInt8

from sliplens.simulation.loading import Loading
from sliplens.simulation.motion import move_markers
from sliplens.simulation.nuisances import Day, Grasp, Unit
from sliplens.simulation.rendering import Noise, Scene, draw_texture, render
from sliplens.simulation.sensor import Sensor

_BATCH = 16
"""Frames drawn at once: enough to keep two cores busy, few enough for their caches."""

_FADE = 0.05
"""Contrast that markers lose in contact."""

_GLOW_RADIUS_PX = 58.0
"""Where the glow of the contact fades."""


def film(
    sensor: Sensor,
    *,
    loading: Loading,
    grasp: Grasp,
    day: Day,
    unit: Unit,
    rng: np.random.Generator,
    noise: Noise | None,
    device: str | torch.device = "cpu",
    on_frames: Callable[[int, int], None] | None = None,
) -> tuple[UInt8[np.ndarray, "height width 3"], UInt8[np.ndarray, "frames height width 3"]]:
    """Film a loaded fingertip.

    Parameters
    ----------
    sensor
        The fingertip.
    loading
        Forces and margins of every frame.
    grasp, day, unit
        What stays the same in the trial, on its day and for the built sensor.
    rng
        Source of noise and of the focus' wander.
    noise
        The camera's noise; None films without it.
    device
        Where to draw.
    on_frames
        Called with the frames done and the frames in all, after each batch.

    Returns
    -------
    reference, frames
        The untouched sensor, and the trial.
    """
    motion = move_markers(sensor, loading=loading, grasp=grasp, modulus_factor=day.modulus_factor)
    rest = sensor.project(sensor.marker_positions())
    # drawn before the noise, so that a clean film differs in its noise alone
    blur = grasp.blur_px * rng.uniform(0.8, 1.2, len(loading.time_s) + 1)
    light = _light(sensor, day=day)
    haze = _haze(sensor, grasp=grasp)
    texture = draw_texture(len(rest), rng=np.random.default_rng(unit.texture_seed))

    def view(centres: np.ndarray, scale: np.ndarray, depth: np.ndarray, blur_px: np.ndarray) -> np.ndarray:
        scene = Scene(
            centres_px=_through_camera(centres + unit.marker_jitter_px, day=day, sensor=sensor),
            size=sensor.marker_scale() * unit.radius_factor * scale,
            contrast=unit.contrast_factor * (1 - _FADE * depth[:, None]),
            texture=texture,
            blur_px=blur_px,
            light=light,
            haze=haze,
            depth=depth,
        )
        return render(scene, sensor=sensor, noise=noise, rng=rng, device=device)

    reference = view(rest[None], np.ones((1, len(rest))), np.zeros(1), blur[:1])[0]
    count = len(loading.time_s)
    frames = np.empty((count, *reference.shape), dtype=np.uint8)
    for start in range(0, count, _BATCH):
        part = slice(start, min(start + _BATCH, count))
        frames[part] = view(motion.centres_px[part], motion.scale[part], motion.depth[part], blur[1:][part])
        if on_frames is not None:
            on_frames(part.stop, count)
    return reference, frames


def _through_camera(
    centres_px: Float[np.ndarray, "frames markers 2"], *, day: Day, sensor: Sensor
) -> Float[np.ndarray, "frames markers 2"]:
    """Turn and shift the image as the camera was seated that day."""
    cos, sin = np.cos(day.camera_rotation_rad), np.sin(day.camera_rotation_rad)
    middle = np.asarray(sensor.centre_px)
    return (centres_px - middle) @ np.array([[cos, sin], [-sin, cos]]) + middle + np.asarray(day.camera_shift_px)


def _light(sensor: Sensor, *, day: Day) -> Float[np.ndarray, "height width 3"]:
    """Gain, white balance, vignette, and a linear fall of brightness across the image."""
    across = np.linspace(-0.5, 0.5, sensor.image_size_px)
    cos, sin = np.cos(day.gradient_direction_rad), np.sin(day.gradient_direction_rad)
    # the brightest corner keeps its level
    ramp = across[None, :] * cos + across[:, None] * sin
    fall = 1 - day.gradient * (0.5 - ramp / (abs(cos) + abs(sin)))
    corner = 1 - sensor.vignette * 2 * (across[None, :] ** 2 + across[:, None] ** 2)
    return day.gain * (fall * corner)[..., None] * np.asarray(day.white_balance)


def _haze(sensor: Sensor, *, grasp: Grasp) -> Float[np.ndarray, "height width 3"]:
    """Grey levels that full contact adds: a veil over all, and a glow where the object reflects the light."""
    pixels = np.arange(sensor.image_size_px)
    spread = sensor.focal_px_per_rad / (1 + sensor.camera_offset)
    x = pixels[None, :] - sensor.centre_px[0] - spread * grasp.contact_offset[0]
    y = pixels[:, None] - sensor.centre_px[1] - spread * grasp.contact_offset[1]
    disc = np.exp(-(((x**2 + y**2) / _GLOW_RADIUS_PX**2) ** 2))
    return np.asarray(grasp.veil) + disc[..., None] * np.asarray(grasp.glow)
