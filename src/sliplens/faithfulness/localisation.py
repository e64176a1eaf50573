"""Localisation: whether a map lies where the truth lies, which a simulator knows."""

import numpy as np
from jaxtyping import Bool, Float

from sliplens.arrays import require_saliency
from sliplens.errors import InputError


def relevance_mass(saliency: Float[np.ndarray, "_ _"], truth: Bool[np.ndarray, "height width"]) -> float:
    """Share of a map's sum that lies inside the truth; NaN for a map that is zero.

    A map that knows nothing has the share of the image that the truth covers.

    References
    ----------
    Arras, Osman and Samek, *CLEVR-XAI* (2022): relevance mass accuracy.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.faithfulness.localisation import relevance_mass
    >>> relevance_mass(np.array([[0.6, 0.2, 0.2]]), np.array([[True, False, False]]))
    0.6
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

    Examples
    --------
    Of the two highest pixels one lies inside the truth:

    >>> import numpy as np
    >>> from sliplens.faithfulness.localisation import relevance_rank
    >>> relevance_rank(np.array([[0.9, 0.5, 0.1, 0.0]]), np.array([[True, False, True, False]]))
    0.5
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
