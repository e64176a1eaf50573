"""Numbers by which difference images are compared."""

import numpy as np
from scipy.ndimage import gaussian_filter

from realism.scene import Simulated
from sliplens.simulation.sensor import CHROMATOUCH

_BLUR_PX = 3
_BORDER_PX = 12


def correlations(real: np.ndarray, simulated: np.ndarray) -> np.ndarray:
    """Correlation of each pair of images, grey and softened by 3 px."""
    soft = [gaussian_filter(images.mean(axis=-1), (0, _BLUR_PX, _BLUR_PX)) for images in (real, simulated)]
    return np.array([np.corrcoef(one.ravel(), other.ravel())[0, 1] for one, other in zip(*soft, strict=True)])


def top_over_bottom(images: np.ndarray) -> np.ndarray:
    """Mean of the upper half over that of the lower half."""
    half = images.shape[1] // 2
    return images[:, :half].mean(axis=(1, 2, 3)) / images[:, half:].mean(axis=(1, 2, 3))


def regions(simulated: Simulated, index: int) -> dict[str, np.ndarray]:
    """Pixels of the lobes, the rim and the background of one frame, from the geometry of the simulated markers.

    Lobes lie 2 px or more inside a marker at rest and 1 px outside all displaced ones, or the other way round; the
    rim 0.5 to 2.5 px outside every marker, at rest and displaced; the background 8 px or more outside. Markers are as
    large as they are in green. Lobes and rims of markers within 12 px of the border are left out.
    """
    radius = CHROMATOUCH.look.radius_px[1] * CHROMATOUCH.geometry.marker_scale()
    at_rest = radius - _distance(simulated.rest_px)
    displaced = radius * simulated.scale[index] - _distance(simulated.centres_px[index])
    whole = np.all(
        (simulated.rest_px > _BORDER_PX) & (simulated.rest_px < CHROMATOUCH.image_size_px - _BORDER_PX), axis=-1
    )
    ours = whole[np.argmax(np.maximum(at_rest, displaced), axis=-1)]
    old, new = at_rest.max(axis=-1), displaced.max(axis=-1)
    inside = np.maximum(old, new)
    return {
        "lobes": ours & (((old > 2) & (new < -1)) | ((new > 2) & (old < -1))),
        "rim": ours & (inside < -0.5) & (inside > -2.5),
        "background": inside < -8,
    }


def colour_errors(real: np.ndarray, simulated: Simulated, frames: list[int]) -> dict[str, np.ndarray]:
    """Simulated less real mean colour of each region in grey levels, (frames, 3) each."""
    errors: dict[str, list[np.ndarray]] = {}
    for image, index in zip(real, frames, strict=True):
        for name, region in regions(simulated, index).items():
            error = simulated.images[index][region].mean(axis=0) - image[region].mean(axis=0)
            errors.setdefault(name, []).append(error)
    return {name: np.array(values) for name, values in errors.items()}


def _distance(places_px: np.ndarray) -> np.ndarray:
    row, column = np.mgrid[: CHROMATOUCH.image_size_px, : CHROMATOUCH.image_size_px]
    return np.hypot(column[..., None] - places_px[:, 0], row[..., None] - places_px[:, 1])
