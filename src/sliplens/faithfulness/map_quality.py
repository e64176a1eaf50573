"""Map quality: what the eye judges of a map, as numbers, and whether it lies where the truth lies."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import map_coordinates
from scipy.spatial import KDTree

from sliplens.arrays import require_saliency
from sliplens.errors import InputError
from sliplens.explainers.maps import pearson_r

_SAMPLES = 33


def total_variation(saliency: Float[np.ndarray, "height width"]) -> float:
    """Mean absolute step between neighbouring pixels, over the range of the map: 1/3 for independent even noise."""
    span = float(np.ptp(saliency))
    if span == 0:
        return 0.0
    steps = (np.abs(np.diff(saliency, axis=axis)).ravel() for axis in (0, 1))
    return float(np.concatenate(list(steps)).mean()) / span


def gini(saliency: Float[np.ndarray, "height width"]) -> float:
    """Gini index of the sizes of a map's values: 0 where all are alike, towards 1 where one pixel has all.

    References
    ----------
    Chalasani et al., *Concise Explanations of Neural Networks using Adversarial Training* (2020), sparsity.
    """
    values = np.sort(np.abs(saliency).ravel())
    total = values.sum()
    if total == 0:
        return 0.0
    rank = np.arange(1, len(values) + 1)
    return float(2 * (rank * values).sum() / (len(values) * total) - (len(values) + 1) / len(values))


def resolution(saliency: Float[np.ndarray, "height width"], markers_px: Float[np.ndarray, "markers 2"]) -> float:
    """Depth of the valley between neighbouring markers (x, y) over the lower of their peaks, from 0 to 1.

    Pairs of which one has no relevance are left out; NaN if there is no other.
    """
    if len(markers_px) < 2:
        raise InputError("resolution needs two markers or more")
    _, nearest = KDTree(markers_px).query(markers_px, k=2)
    pairs = {(min(first, second), max(first, second)) for first, second in np.asarray(nearest).tolist()}
    depths = []
    for first, second in sorted(pairs):
        along = np.linspace(0, 1, _SAMPLES)[:, None]
        x, y = ((1 - along) * markers_px[first] + along * markers_px[second]).T
        values = map_coordinates(saliency, [y, x], order=1, mode="nearest")
        third = _SAMPLES // 3
        peaks = (values[: third + 1].max(), values[-third - 1 :].max())
        if min(peaks) > 0:
            depths.append(1 - float(values[third:-third].min()) / float(min(peaks)))
    return float(np.clip(np.mean(depths), 0, 1)) if depths else float("nan")


def stability(
    maps: Float[np.ndarray, "images height width"], others: Float[np.ndarray, "images height width"]
) -> Float[np.ndarray, " images"]:
    """Pearson's correlation of each map with its like, such as the next frame's; NaN where a map is constant."""
    pairs = zip(torch.tensor(maps), torch.tensor(others), strict=True)
    return np.array([pearson_r(map_, other) for map_, other in pairs])


def relevance_mass(saliency: Float[np.ndarray, "_ _"], truth: Bool[np.ndarray, "height width"]) -> float:
    """Share of a map's sum that lies inside the truth; NaN for a map that is zero.

    References
    ----------
    Arras, Osman and Samek, *CLEVR-XAI* (2022): relevance mass accuracy.
    """
    _require(saliency, truth)
    if saliency.min() < 0:
        raise InputError("relevance mass needs a map without negative values; take its positive part or its size")
    total = float(saliency.sum())
    return float(saliency[truth].sum()) / total if total > 0 else float("nan")


def relevance_rank(saliency: Float[np.ndarray, "_ _"], truth: Bool[np.ndarray, "height width"]) -> float:
    """Share of the K highest pixels that lie inside the truth, which has K pixels; ties count by chance.

    References
    ----------
    Arras, Osman and Samek, *CLEVR-XAI* (2022): relevance rank accuracy.
    """
    _require(saliency, truth)
    size = int(truth.sum())
    values, inside = saliency.ravel(), truth.ravel()
    cut = np.partition(values, -size)[-size]
    above, level = values > cut, values == cut
    # of the pixels at the cut, as many as are still wanted: on average their share inside
    wanted = size - int(above.sum())
    return float((inside[above].sum() + wanted * inside[level].mean()) / size)


def _require(saliency: Float[np.ndarray, "_ _"], truth: Bool[np.ndarray, "height width"]) -> None:
    require_saliency(saliency, truth.shape, where="the map")
    if not truth.any():
        raise InputError("the truth is nowhere in this frame; choose a frame in contact")
