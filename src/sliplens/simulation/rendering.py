"""From marker positions to camera frames, in batches on any device."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor

from sliplens.simulation.sensor import Sensor

_PATCH = 32
"""Side of the square in which a marker is drawn, in pixels; the widest marker's edge has faded by then."""


@dataclass(frozen=True, kw_only=True)
class Scene:
    """What the camera sees in a batch of frames, before noise."""

    centres_px: Float[np.ndarray, "frames markers 2"]
    size: Float[np.ndarray, "frames markers"]
    """Marker size over the sensor's `marker_radius_px`."""
    contrast: Float[np.ndarray, "frames markers"]
    """Marker contrast over the sensor's."""
    texture: Float32[np.ndarray, "markers side side 3"]
    """From `draw_texture`."""
    blur_px: Float[np.ndarray, " frames"]
    light: Float[np.ndarray, "height width 3"]
    """Brightness over the sensor's, the same for all frames."""
    haze: Float[np.ndarray, "height width 3"]
    """Grey levels that full contact adds."""
    depth: Float[np.ndarray, " frames"]
    """How much of the haze each frame has."""


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Standard deviation of one frame's noise by channel, in grey levels, and its smoothness."""

    background: tuple[float, float, float] = (2.2, 2.1, 2.0)
    marker: tuple[float, float, float] = (9.2, 9.0, 3.0)
    smoothness: float = 0.4
    """Weight of the neighbour's noise in a pixel; 0.4 gives a lag-1 correlation of 0.34."""
    red_in_green: float = 0.5
    """Correlation of red and green, which the camera's debayering ties together."""
    grain: tuple[float, float, float] = (0.13, 0.06, 0.07)
    """Unevenness of the print, which moves with a marker, over its contrast."""
    ragged_px: tuple[float, float, float] = (0.5, 0.35, 0.35)
    """Unevenness of a marker's edge."""


def draw_texture(markers: int, *, rng: np.random.Generator) -> Float32[np.ndarray, "markers side side 3"]:
    """Grain of the markers' print, of unit strength, red and green alike in half."""
    grain = rng.standard_normal((markers, _PATCH, _PATCH, 3), dtype=np.float32)
    grain[..., 1] = 0.5 * grain[..., 0] + 0.75**0.5 * grain[..., 1]
    return grain


def render(
    scene: Scene, *, sensor: Sensor, noise: Noise | None, rng: np.random.Generator, device: str | torch.device = "cpu"
) -> UInt8[np.ndarray, "frames height width 3"]:
    """Draw a batch of frames.

    Each marker is drawn in a patch of its own and added to the frame, so that a frame costs little more than its noise.
    The noise comes from NumPy and is drawn frame by frame: the frames do not depend on how they are batched.

    Parameters
    ----------
    scene
        Markers, light and blur.
    sensor
        Colours, marker sizes and image size.
    noise
        The noise; None for a clean image.
    rng
        Source of the noise.
    device
        Where to compute.
    """
    shade = _shade(scene, sensor=sensor, noise=noise, device=device)
    contrast = torch.tensor(sensor.marker_contrast, dtype=torch.float32, device=device)
    background = torch.tensor(sensor.background, dtype=torch.float32, device=device)
    light = torch.as_tensor(scene.light, dtype=torch.float32, device=device)
    haze = torch.as_tensor(scene.haze, dtype=torch.float32, device=device)
    depth = torch.as_tensor(scene.depth, dtype=torch.float32, device=device)[:, None, None, None]
    frames = torch.addcmul(background * light, shade, contrast * light, value=-1).addcmul_(depth, haze)
    if noise is not None:
        frames += _noise(shade, noise=noise, rng=rng)
    return frames.add_(0.5).clamp_(0, 255).to(torch.uint8).cpu().numpy()


def _shade(
    scene: Scene, *, sensor: Sensor, noise: Noise | None, device: str | torch.device
) -> Float[Tensor, "frames height width 3"]:
    """Share of the markers' contrast in each pixel: 0 in the background, about 1 in a marker."""
    size, frames = sensor.image_size_px, len(scene.centres_px)
    # markers that no pixel of the frame can see are left out; the padding takes the rest of those that stick out
    seen = np.all((scene.centres_px > -_PATCH / 2) & (scene.centres_px < size - 1 + _PATCH / 2), axis=-1)
    frame_index, marker_index = np.nonzero(seen)
    centres = torch.as_tensor(scene.centres_px[seen], dtype=torch.float32, device=device)
    radius = _column(scene.size[seen], device) * torch.tensor(sensor.marker_radius_px, device=device)
    # blur widens the logistic edge: its standard deviation is 1.81 widths
    edge = (
        torch.tensor(sensor.marker_edge_px, device=device).square()
        + (_column(scene.blur_px[frame_index], device) / 1.81).square()
    )
    corner = torch.floor(centres).to(torch.int64) - _PATCH // 2 + 1

    steps = torch.arange(_PATCH, device=device)
    dx = (corner[:, :1] + steps) - centres[:, :1]
    dy = (corner[:, 1:] + steps) - centres[:, 1:]
    distance = torch.sqrt(dy.square()[:, :, None] + dx.square()[:, None, :])
    slope = edge.rsqrt()[:, None, None, :]
    inward = radius[:, None, None, :] - distance[..., None]
    texture = None
    if noise is not None:
        texture = torch.as_tensor(scene.texture, device=device)[torch.as_tensor(marker_index, device=device)]
        inward.addcmul_(texture, torch.tensor(noise.ragged_px, device=device))
    patch = inward.mul_(slope).sigmoid_()
    if noise is not None and texture is not None:
        patch.mul_(texture.mul_(torch.tensor(noise.grain, device=device)).add_(1))
    patch *= torch.as_tensor(scene.contrast[seen], dtype=torch.float32, device=device)[:, None, None, None]

    side = size + 2 * _PATCH
    row = (corner[:, 1:] + steps + _PATCH) + side * torch.as_tensor(frame_index, device=device)[:, None]
    column = corner[:, :1] + steps + _PATCH
    target = row[:, :, None] * side + column[:, None, :]
    canvas = torch.zeros((frames * side * side, 3), dtype=torch.float32, device=device)
    canvas.index_add_(0, target.reshape(-1), patch.reshape(-1, 3))
    return canvas.reshape(frames, side, side, 3)[:, _PATCH:-_PATCH, _PATCH:-_PATCH]


def _noise(
    shade: Float[Tensor, "frames height width 3"], *, noise: Noise, rng: np.random.Generator
) -> Float[Tensor, "frames height width 3"]:
    """Noise as strong as a pixel's share of marker says, smoothed over neighbours.

    Four neighbours of two bytes each sum to what is close enough to normal (excess kurtosis -0.3), and much faster.
    """
    frames, height, width, _ = shade.shape
    count = (height + 1) * (width + 1) * 3
    # whole frames of bytes one after another, so that the batch size does not matter
    pairs = np.frombuffer(b"".join(rng.bytes(2 * count) for _ in range(frames)), dtype=np.uint8)
    pairs = torch.from_numpy(pairs.reshape(frames, 2, height + 1, width + 1, 3).copy()).to(shade.device)
    white = pairs[:, 0].to(torch.float32) + pairs[:, 1]
    rows = torch.add(white[:, :-1], white[:, 1:], alpha=noise.smoothness)
    smooth = torch.add(rows[:, :, :-1], rows[:, :, 1:], alpha=noise.smoothness)
    # a byte has mean 127.5 and variance (256^2 - 1) / 12
    smooth.sub_(2 * 127.5 * (1 + noise.smoothness) ** 2)
    smooth[..., 1].mul_((1 - noise.red_in_green**2) ** 0.5).add_(smooth[..., 0], alpha=noise.red_in_green)
    unit = (1 + noise.smoothness**2) * (2 * (256**2 - 1) / 12) ** 0.5
    background = torch.tensor(noise.background, device=shade.device) / unit
    marker = torch.tensor(noise.marker, device=shade.device) / unit
    return smooth.mul_(shade.clamp(0, 1).mul_(marker - background).add_(background))


def _column(values: Float[np.ndarray, " items"], device: str | torch.device) -> Float[Tensor, "items 1"]:
    return torch.as_tensor(values, dtype=torch.float32, device=device)[:, None]
