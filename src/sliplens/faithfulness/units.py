"""Units: what is removed at once, a pixel, a tile or a marker."""

import numpy as np
import torch
from jaxtyping import Float, Int

from sliplens.arrays import require_saliency
from sliplens.errors import InputError
from sliplens.explainers.occlusion import marker_regions, tile_regions

Units = Int[np.ndarray, "height width"]
"""Number of the unit that each pixel belongs to, from 0."""


def pixel_units(shape: tuple[int, int]) -> Units:
    """Each pixel by itself."""
    return np.arange(shape[0] * shape[1]).reshape(shape)


def tile_units(shape: tuple[int, int], *, size: int) -> Units:
    """Square tiles; those at the right and lower border are smaller where the image does not divide.

    Examples
    --------
    >>> from sliplens.faithfulness.units import tile_units
    >>> tile_units((2, 4), size=2)
    array([[0, 0, 1, 1],
           [0, 0, 1, 1]])
    """
    if size < 1:
        raise InputError(f"tiles of {size} pixels are impossible; choose 1 or more")
    return tile_regions(shape, tile_px=size).numpy()


def marker_units(shape: tuple[int, int], centres_px: Float[np.ndarray, "markers 2"], *, reach_px: float) -> Units:
    """Each pixel goes to the nearest marker; those farther from all than `reach_px` are one unit, the last.

    A marker's unit should reach as far as its radius, and as far as it moves.
    """
    if not len(centres_px):
        raise InputError("there is no marker to remove; choose pixels or tiles")
    return marker_regions(shape, torch.from_numpy(centres_px), radius_px=reach_px).numpy()


def unit_means(values: Float[np.ndarray, "height width"], units: Units) -> Float[np.ndarray, " units"]:
    """Mean of a map over each unit; NaN for one that no pixel belongs to."""
    count = np.bincount(units.ravel())
    with np.errstate(invalid="ignore"):
        return np.bincount(units.ravel(), weights=values.ravel()) / count


def unit_order(
    influence: Float[np.ndarray, "_ _"], units: Units, *, least_first: bool = False
) -> Int[np.ndarray, " pixels"]:
    """Flat pixel indices, unit by unit, from the most to the least influential, or the other way round.

    The mean of the map over a unit counts, so that large units have no advantage.

    Examples
    --------
    The right tile is brighter on average: its pixels go first.

    >>> import numpy as np
    >>> from sliplens.faithfulness.units import tile_units, unit_order
    >>> influence = np.array([[0.9, 0.0, 0.5, 0.6], [0.0, 0.0, 0.5, 0.6]])
    >>> unit_order(influence, tile_units((2, 4), size=2))
    array([2, 3, 6, 7, 0, 1, 4, 5])
    """
    require_saliency(influence, units.shape, where="the map to rank by")
    means = unit_means(influence, units)[units.ravel()]
    # units in order, the pixels of each in reading order: lexsort is stable, its last key counts first
    return np.lexsort((units.ravel(), means if least_first else -means))


def random_unit_order(units: Units, *, rng: np.random.Generator) -> Int[np.ndarray, " pixels"]:
    """Flat pixel indices, unit by unit, in random order: the control that every map has to beat."""
    rank = rng.permutation(int(units.max()) + 1)
    return np.argsort(rank[units.ravel()], kind="stable")
