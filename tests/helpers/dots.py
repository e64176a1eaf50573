"""Frames of dots whose places are known."""

import numpy as np


def draw_dots(
    centres,
    *,
    size=(160, 200),
    radius: float | np.ndarray = 5.0,
    edge=0.6,
    background=(180, 170, 160),
    marker=(30, 25, 20),
    noise=0.0,
    rng=None,
):
    """Discs with a logistic edge; pixel centres at whole numbers."""
    rows, columns = np.mgrid[: size[0], : size[1]]
    share = np.zeros(size)
    for index, (x, y) in enumerate(np.asarray(centres, dtype=float)):
        own = np.broadcast_to(radius, len(centres))[index]
        distance = np.clip((np.hypot(columns - x, rows - y) - own) / edge, -40, 40)
        share = np.maximum(share, 1 / (1 + np.exp(distance)))
    image = np.array(background) + share[..., None] * (np.array(marker, dtype=float) - np.array(background))
    if noise:
        assert rng is not None  # noise is drawn
        image = image + rng.normal(0, noise, image.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def make_grid(*, columns=6, rows=5, pitch=26.0, at=(32.0, 26.0), jitter=0.0, rng=None):
    """Places of a square grid, x and y."""
    x, y = np.meshgrid(np.arange(columns) * pitch + at[0], np.arange(rows) * pitch + at[1])
    places = np.stack([x.ravel(), y.ravel()], axis=-1)
    if not jitter:
        return places
    assert rng is not None  # irregularities are drawn
    return places + rng.normal(0, jitter, places.shape)
