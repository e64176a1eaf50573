"""Frames of dots whose places are known, and simulated trials."""

import numpy as np
import pytest

from sliplens.simulation import CHROMATOUCH, FLAT_GEL, SimulationRecipe, plan_trials, simulate_trial

pytest.importorskip("cv2", reason="markers are found with OpenCV, of the extra `markers`")


def draw_dots(
    centres,
    *,
    size=(160, 200),
    radius=5.0,
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


@pytest.fixture(scope="session")
def trials():
    """A simulated trial of each sensor, to full slip and back."""
    return {
        sensor.name: simulate_trial(
            plan_trials(
                SimulationRecipe(dry_trials=3, wet_trials=0, frames_per_trial=40, release=True, sensor=sensor, seed=7)
            )[0]
        )
        for sensor in (CHROMATOUCH, FLAT_GEL)
    }


@pytest.fixture
def dots():
    return draw_dots


@pytest.fixture
def grid():
    return make_grid
