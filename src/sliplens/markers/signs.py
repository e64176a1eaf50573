"""Which end of a doublet is the older one: the skin moves smoothly, and outwards where it is pressed."""

import numpy as np
from jaxtyping import Float

_SWEEPS = 20


def resolve_signs(
    place_px: Float[np.ndarray, "markers 2"], way_px: Float[np.ndarray, "markers 2"], *, pressed: bool
) -> Float[np.ndarray, " markers"]:
    """Signs, 1 or -1, that make neighbouring displacements agree.

    Signs spread from the longest displacement to its neighbours, strongest agreement first, and are then flipped one by
    one while that brings them closer to what the neighbours say.

    Parameters
    ----------
    place_px
        x, y of each marker.
    way_px
        Displacement of each, up to its sign.
    pressed
        Choose the sign of all so that the displacements point away from their middle; left as it falls if False.
    """
    distance = np.linalg.norm(place_px[:, None] - place_px[None], axis=-1)
    np.fill_diagonal(distance, np.inf)
    pitch = np.median(distance.min(axis=1))
    closeness = np.exp(-0.5 * (distance / (1.2 * pitch)) ** 2)
    # long displacements that lie along one line bind most
    bond = closeness * (way_px @ way_px.T)
    signs = np.zeros(len(place_px))
    signs[np.argmax(np.linalg.norm(way_px, axis=1))] = 1
    while not signs.all():
        pull = np.where(signs[:, None] != 0, signs[:, None] * bond, 0)
        pull[:, signs != 0] = 0
        told, at = np.unravel_index(np.argmax(np.abs(pull)), pull.shape)
        if not pull[told, at]:
            signs[signs == 0] = 1  # nothing binds the rest: they did not move, or move athwart or far away
            break
        signs[at] = np.sign(pull[told, at])
    for _ in range(_SWEEPS):
        field = bond @ signs
        wrong = signs * field < 0
        if not wrong.any():
            break
        # one at a time: two neighbours that flip together stay apart
        signs[np.argmin(signs * field)] *= -1
    outward = (place_px - place_px.mean(axis=0)) * way_px
    if pressed and (outward.sum(axis=1) * signs).sum() < 0:
        signs = -signs
    return signs
