"""Centres and radii to a fraction of a pixel, of all markers at once."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

_INNER, _OUTER = 1.55, 2.1  # radii of the ring in which the background is seen
_CORE = 0.5  # radii, of what is surely marker
_REACH = 1.6  # radii, beyond which nothing belongs to the marker
_LOW, _HIGH = 0.25, 0.75  # of the contrast: below is background, above marker, however it speckles
_ROUNDS = 3  # of moving the window onto what it found
_SLOPE_SHARE = 0.5  # of the contrast that the background may change by across a radius


@dataclass(frozen=True, kw_only=True)
class Shapes:
    """What was measured on spots."""

    centre_px: Float[np.ndarray, "spots 2"]
    radius_px: Float[np.ndarray, " spots"]
    contrast: Float[np.ndarray, " spots"]
    roundness: Float[np.ndarray, " spots"]
    """Shorter over longer axis, 1 for a disc."""
    noise: Float[np.ndarray, " spots"]
    """Standard deviation of the background around it."""


@dataclass(frozen=True, kw_only=True)
class _Window:
    """What windows of one size share; pixels in one row."""

    half: int
    x: Float32[np.ndarray, " pixels"]
    y: Float32[np.ndarray, " pixels"]
    ring: Bool[np.ndarray, " pixels"]
    means: Float32[np.ndarray, "pixels 4"]
    """Averages over the ring (level, slope along x, slope along y) and over the core."""
    plane: Float32[np.ndarray, "3 pixels"]
    """1, x and y."""
    moments: Float32[np.ndarray, "pixels 6"]
    """1, x, y, x^2, y^2 and xy."""


@lru_cache(maxsize=32)
def _window(radius_px: float) -> _Window:
    half = int(np.ceil(_OUTER * radius_px))
    y, x = (axis.ravel().astype(np.float32) for axis in np.mgrid[-half : half + 1, -half : half + 1])
    distance = np.hypot(x, y)
    ring, core = (distance > _INNER * radius_px) & (distance < _OUTER * radius_px), distance <= _CORE * radius_px
    means = [ring / ring.sum(), ring * x / (x[ring] @ x[ring]), ring * y / (y[ring] @ y[ring]), core / core.sum()]
    one = np.ones_like(x)
    return _Window(
        half=half,
        x=x,
        y=y,
        ring=ring,
        means=np.stack(means, axis=1).astype(np.float32),
        plane=np.stack([one, x, y]),
        moments=np.stack([one, x, y, x * x, y * y, x * y], axis=1),
    )


def measure_spots(
    signal: Float32[np.ndarray, "height width"], near_px: Float[np.ndarray, "spots 2"], *, radius_px: float
) -> Shapes:
    """Measure the spots near some places: centroid and area of what passes half of the contrast.

    The background is a plane, fitted in a ring around each spot. A pixel counts as marker from a quarter (not at all)
    to three quarters (wholly) of the contrast: so speckle inside a marker does not move its centre, while its edge
    still does by fractions of a pixel.

    Parameters
    ----------
    signal
        High on markers.
    near_px
        x, y of each spot, to about a third of a radius.
    radius_px
        About how large they are.
    """
    window = _window(round(max(radius_px, 1.5), 1))
    height, width = signal.shape
    pad = window.half + 1
    padded = np.pad(signal, pad, mode="edge")
    whole = np.clip(np.round(near_px), 0, (width - 1, height - 1)).astype(np.int64)
    patches = _cut(padded, whole, window, pad)
    level, slope_x, slope_y, core = (patches @ window.means).T
    contrast = core - level
    limit = _SLOPE_SHARE * np.abs(contrast) / radius_px
    slopes = np.stack([level, np.clip(slope_x, -limit, limit), np.clip(slope_y, -limit, limit)], axis=1)
    patches -= slopes @ window.plane
    noise = patches[:, window.ring].std(axis=1)
    patches *= (1 / ((_HIGH - _LOW) * np.where(contrast > 1e-3, contrast, 1e-3)))[:, None]
    patches -= np.float32(_LOW / (_HIGH - _LOW))
    share = np.clip(patches, 0, 1, out=patches)
    offset = np.zeros((len(whole), 2), dtype=np.float32)
    moments = np.ones((len(whole), 6), dtype=np.float32)
    for _ in range(_ROUNDS):
        x, y = window.x - offset[:, :1], window.y - offset[:, 1:]
        near = np.sqrt(x * x + y * y)
        part = share * np.clip(np.subtract(_REACH * radius_px + 0.5, near, out=near), 0, 1, out=near)
        moments = part @ window.moments
        moments[:, 1:] /= np.maximum(moments[:, :1], 1e-6)
        offset = moments[:, 1:3]
    mass, mean_x, mean_y, mean_xx, mean_yy, mean_xy = moments.T
    spread_x, spread_y = mean_xx - mean_x**2, mean_yy - mean_y**2
    middle, half = (spread_x + spread_y) / 2, np.hypot((spread_x - spread_y) / 2, mean_xy - mean_x * mean_y)
    return Shapes(
        centre_px=(whole + offset).astype(np.float64),
        radius_px=np.sqrt(mass / np.pi).astype(np.float64),
        contrast=contrast.astype(np.float64),
        roundness=np.sqrt(np.clip((middle - half) / np.maximum(middle + half, 1e-9), 0, 1)).astype(np.float64),
        noise=noise.astype(np.float64),
    )


def _cut(
    padded: Float32[np.ndarray, "rows columns"], whole: Int[np.ndarray, "spots 2"], window: _Window, pad: int
) -> Float32[np.ndarray, "spots pixels"]:
    steps = np.arange(-window.half, window.half + 1) + pad
    rows, columns = whole[:, 1, None] + steps, whole[:, 0, None] + steps
    return padded[rows[:, :, None], columns[:, None, :]].reshape(len(whole), (2 * window.half + 1) ** 2)
