"""Checks on arrays that several floors share."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from sliplens.errors import SaliencyError


def require_saliency(
    saliency: Float[np.ndarray, "height width"], shape: Sequence[int], *, where: str = "the saliency map"
) -> Float[np.ndarray, "height width"]:
    """Return the map unchanged when it is finite and has the image's height and width, its shape in pixels.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.arrays import require_saliency
    >>> require_saliency(np.array([[0.0, np.nan]]), (1, 2))
    Traceback (most recent call last):
        ...
    sliplens.errors.SaliencyError: the saliency map holds NaN or infinity in 1 of 2 pixels; explain the frame again, ...
    """
    height, width = shape
    if saliency.shape != (height, width):
        raise SaliencyError(
            f"{where} has shape {tuple(saliency.shape)} but its image is {height} x {width} pixels; "
            "explain the same frames that are scored"
        )
    bad = int(np.size(saliency) - np.count_nonzero(np.isfinite(saliency)))
    if bad:
        raise SaliencyError(
            f"{where} holds NaN or infinity in {bad} of {saliency.size} pixels; "
            "explain the frame again, or drop it from the set"
        )
    return saliency
