"""What a marker's neighbours say of its displacement: a skin moves smoothly."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

_NEIGHBOURS = 8
_FEWEST = 3
_STIFFNESS = 0.3  # of the prior that holds slopes down where few neighbours are left


@dataclass(frozen=True, kw_only=True)
class Neighbours:
    """The nearest markers of each marker at rest."""

    index: Int[np.ndarray, "markers neighbours"]
    offset: Float[np.ndarray, "markers neighbours 2"]
    """From the marker, over the pitch."""
    pitch_px: Float[np.ndarray, " markers"]
    """Distance of the nearest one."""


def find_neighbours(place_px: Float[np.ndarray, "markers 2"]) -> Neighbours:
    """Find the nearest eight markers of each, or all others where there are fewer.

    Parameters
    ----------
    place_px
        x, y of at least two markers.
    """
    distance = np.linalg.norm(place_px[:, None] - place_px[None], axis=-1)
    np.fill_diagonal(distance, np.inf)
    count = min(_NEIGHBOURS, len(place_px) - 1)
    index = np.argsort(distance, axis=1, kind="stable")[:, :count]
    pitch = distance.min(axis=1)
    offset = (place_px[index] - place_px[:, None]) / pitch[:, None, None]
    return Neighbours(index=index, offset=offset, pitch_px=pitch)


def predict_from_neighbours(
    neighbours: Neighbours, displacement_px: Float[np.ndarray, "markers 2"], known: Bool[np.ndarray, " markers"]
) -> Float[np.ndarray, "markers 2"]:
    """Displacement of each marker as its neighbours alone tell it, in pixels.

    A plane through the known neighbours' displacements, the near ones weighing most, its slopes held down a little;
    NaN where fewer than three neighbours are known.

    Parameters
    ----------
    neighbours
        Of the markers at rest.
    displacement_px
        x, y of each marker; what is not known may be NaN.
    known
        Which markers may be believed.
    """
    usable = known[neighbours.index]
    values = np.where(usable[..., None], displacement_px[neighbours.index], 0.0)
    squared = (neighbours.offset**2).sum(axis=-1)
    weight = np.where(usable, np.exp(-squared / (2 * 1.5**2)), 0.0)
    terms = np.concatenate([np.ones((*weight.shape, 1)), neighbours.offset], axis=-1)
    weighted = terms * weight[..., None]
    normal = np.swapaxes(weighted, 1, 2) @ terms
    normal[:, [1, 2], [1, 2]] += _STIFFNESS * 0.1
    normal[:, 0, 0] += 1e-9  # a marker without neighbours is answered below
    fit = np.linalg.solve(normal, np.swapaxes(weighted, 1, 2) @ values)
    return np.where(usable.sum(axis=1)[:, None] >= _FEWEST, fit[:, 0], np.nan)
