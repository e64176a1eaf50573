"""From marker positions to camera frames, in batches on any device."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int, UInt8
from torch import Tensor

from sliplens.simulation.geometry import pixel_grid
from sliplens.simulation.nuisances import Day, Grasp
from sliplens.simulation.sensor import DrawnMarkers, Noise, NoisePicks, Sensor, mix_noise

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
    sensor: Sensor, *, grasp: Grasp, contact_px: Float[np.ndarray, "2"], radius_px: float, rng: np.random.Generator
) -> Float32[np.ndarray, "3 height width"]:
    """Grey levels that full contact adds: a veil, a glow where the object reflects the light, the grain of the skin.

    `contact_px`, `radius_px`: where the camera sees the contact's centre, and how large its radius in a nominal grasp.
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


_PATCH = 32
"""Side of the square in which a marker is drawn, in pixels; the widest marker's edge has faded by then."""


@dataclass(frozen=True, kw_only=True)
class View:
    """View of the camera as far as it is the same in all frames of a trial."""

    texture: Float32[np.ndarray, "3 markers side side"]
    """Grain of the print, from `draw_texture`."""
    light: Float32[np.ndarray, "3 height width"]
    """Brightness over the sensor's."""
    empty: Float32[np.ndarray, "3 height width"]
    """The untouched sensor without its markers, in grey levels."""
    haze: Float32[np.ndarray, "3 height width"]
    """Grey levels that full contact adds."""
    relief: Float32[np.ndarray, "3 height width"] | None
    """Relative change of brightness where the skin slopes by 1; None where slopes do not show."""


@dataclass(frozen=True, kw_only=True)
class Scene:
    """View of the camera in a batch of frames, before noise."""

    view: View
    centres_px: Float[np.ndarray, "frames markers 2"]
    markers: DrawnMarkers
    touch: Float[np.ndarray, " frames"]
    """Share of the haze that each frame has."""
    slope: Float32[np.ndarray, "frames height width"] | None
    """Slope of the skin, downwards away from the contact's centre."""
    noise: NoisePicks


def draw_texture(markers: int, *, rng: np.random.Generator) -> Float32[np.ndarray, "3 markers side side"]:
    """Grain of the markers' print, of unit strength, red and green alike in half."""
    grain = rng.standard_normal((3, markers, _PATCH, _PATCH), dtype=np.float32)
    grain[1] = 0.5 * grain[0] + 0.75**0.5 * grain[1]
    return grain


def render(
    scene: Scene, *, sensor: Sensor, noise: Noise | None, device: str | torch.device = "cpu"
) -> UInt8[Tensor, "frames height width 3"]:
    """Draw a batch of frames; nothing in it depends on which frames are drawn together.

    Each marker is drawn in a patch of its own and added to the frame, so that a frame costs little more than its noise.
    Devices agree within one grey level: they round sums of four terms in another order.
    """
    # one plane a channel: a channel's constant then meets whole rows of pixels, which vectorises
    view, shade = scene.view, _shade(scene, size_px=sensor.image_size_px, noise=noise, device=device)
    contrast = _tensor(view.light, device)[:, None] * _channels(sensor.look.contrast, device)
    frames = torch.addcmul(_tensor(view.empty, device)[:, None], shade, contrast, value=-1)
    if view.relief is not None and scene.slope is not None:
        frames *= 1 + _tensor(scene.slope, device) * _tensor(view.relief, device)[:, None]
    frames.addcmul_(_tensor(scene.touch, device)[:, None, None], _tensor(view.haze, device)[:, None])
    if noise is not None:
        background = _channels(noise.background, device)
        excess, share = _channels(noise.marker, device) - background, shade.clamp_(0, 1)
        strength = torch.addcmul((1 + noise.edge) * excess, share, noise.edge * excess, value=-1)
        strength.mul_(share).add_(background)
        frames.addcmul_(
            strength, mix_noise(scene.noise, noise=noise, image_size_px=sensor.image_size_px, device=device)
        )
    frames.add_(0.5).clamp_(0, 255)
    pixels = torch.empty((*frames.shape[1:], 3), dtype=torch.uint8, device=device)
    for channel, plane in enumerate(frames):  # converts and interleaves in one go
        pixels[..., channel].copy_(plane)
    return pixels


def _shade(
    scene: Scene, *, size_px: int, noise: Noise | None, device: str | torch.device
) -> Float[Tensor, "3 frames height width"]:
    """Share of the markers' contrast in each pixel: 0 in the background, about 1 in a marker."""
    frames = len(scene.centres_px)
    # markers that no pixel of the frame can see are left out; the padding takes the rest of those that stick out
    seen = np.all((scene.centres_px > -_PATCH / 2) & (scene.centres_px < size_px - 1 + _PATCH / 2), axis=-1)
    frame_index, marker_index = np.nonzero(seen)
    centres = _tensor(scene.centres_px[seen], device)
    drawn = scene.markers
    radius, edge, contrast = (
        _items(values[seen], device) for values in (drawn.radius_px, drawn.edge_px, drawn.contrast)
    )
    corner = torch.floor(centres).to(torch.int64) - _PATCH // 2 + 1

    steps = torch.arange(_PATCH, device=device)
    dx = (corner[:, :1] + steps) - centres[:, :1]
    dy = (corner[:, 1:] + steps) - centres[:, 1:]
    distance = torch.sqrt(dy.square()[:, :, None] + dx.square()[:, None, :])
    texture = None
    if noise is None:
        patch = radius - distance
    else:
        texture = _tensor(scene.view.texture, device)[:, torch.as_tensor(marker_index, device=device)]
        patch = texture * _channels(noise.ragged_px, device)
        patch.add_(radius).sub_(distance)
    patch.div_(edge).sigmoid_()
    if noise is not None and texture is not None:
        patch.mul_(texture.mul_(_channels(noise.grain, device)).add_(1))
    patch.mul_(contrast)

    return _place(patch, corner=corner, frame=frame_index, frames=frames, size_px=size_px)


def _place(
    patch: Float[Tensor, "3 items side side"],
    *,
    corner: Int[Tensor, "items 2"],
    frame: Int[np.ndarray, " items"],
    frames: int,
    size_px: int,
) -> Float[Tensor, "3 frames height width"]:
    """Add each patch to its frame, its first pixel at a corner (x, y); what sticks out is cut off."""
    side = size_px + 2 * _PATCH
    canvas = torch.zeros((3, frames, side, side), dtype=torch.float32, device=patch.device)
    add = add_slices if patch.device.type == "cpu" else scatter
    add(canvas, patch, corner=corner + _PATCH, frame=frame)
    return canvas[:, :, _PATCH:-_PATCH, _PATCH:-_PATCH]


def add_slices(
    canvas: Float[Tensor, "3 frames height width"],
    patch: Float[Tensor, "3 items side side"],
    *,
    corner: Int[Tensor, "items 2"],
    frame: Int[np.ndarray, " items"],
) -> None:
    """Add patches to a canvas in place, one after another: several times faster than `scatter` on a processor."""
    target, source, side = canvas.numpy(), patch.numpy(), patch.shape[-1]
    for item, (index, (column, row)) in enumerate(zip(frame.tolist(), corner.tolist(), strict=True)):
        target[:, index, row : row + side, column : column + side] += source[:, item]


def scatter(
    canvas: Float[Tensor, "3 frames height width"],
    patch: Float[Tensor, "3 items side side"],
    *,
    corner: Int[Tensor, "items 2"],
    frame: Int[np.ndarray, " items"],
) -> None:
    """Add patches to a canvas in place, all at once: for a GPU."""
    steps = torch.arange(patch.shape[-1], device=patch.device)
    row = corner[:, 1:] + steps + canvas.shape[2] * torch.as_tensor(frame, device=patch.device)[:, None]
    pixel = row[:, :, None] * canvas.shape[3] + (corner[:, :1] + steps)[:, None, :]
    canvas.view(3, -1).index_add_(1, pixel.reshape(-1), patch.reshape(3, -1))


def _tensor(values: np.ndarray, device: str | torch.device) -> Tensor:
    return torch.as_tensor(values, dtype=torch.float32, device=device)


def _channels(values: tuple[float, float, float], device: str | torch.device) -> Float[Tensor, "3 1 1 1"]:
    return torch.tensor(values, dtype=torch.float32, device=device).reshape(3, 1, 1, 1)


def _items(values: Float[np.ndarray, "items 3"], device: str | torch.device) -> Float[Tensor, "3 items 1 1"]:
    return _tensor(values, device).T[:, :, None, None].contiguous()
