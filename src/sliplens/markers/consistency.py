"""Tracks that agree with their neighbours: strays are dropped, and what they left is matched anew."""

import numpy as np
from jaxtyping import Bool, Float, Int

from sliplens.markers.matching import GATE
from sliplens.markers.neighbours import Neighbours, predict_from_neighbours

_STRAY_PITCHES, _STRAY_SPREADS = 0.3, 6.0
_ROUNDS = 6
_ADJACENT, _NEAR = 1.6, 2.3  # pitches: next to each other, and so near that they may still contradict each other
_ALIKE = 0.5  # pitches, of displacement between two that stand together
_STRAIN = 0.55  # pixels of relative displacement per pixel of distance: more is no skin, but a wrong match


def drop_strays(
    neighbours: Neighbours, shift_px: Float[np.ndarray, "markers 2"], sound: Bool[np.ndarray, " markers"]
) -> tuple[Bool[np.ndarray, " markers"], Float[np.ndarray, "markers 2"]]:
    """Drop markers that stray from their neighbours, worst first: one stray makes all round it look astray.

    Parameters
    ----------
    neighbours
        Of the markers at rest.
    shift_px
        Displacement of each; NaN where it has none.
    sound
        Which may be believed so far.

    Returns
    -------
    tuple
        Which may still be believed, and what the neighbours that remain say of each displacement.
    """
    sound = sound.copy()
    told = predict_from_neighbours(neighbours, shift_px, sound)
    while True:
        error = np.where(sound, np.linalg.norm(shift_px - told, axis=1), np.nan)
        if not np.isfinite(error).any():
            return sound, told
        limit = np.maximum(_STRAY_PITCHES * neighbours.pitch_px, _STRAY_SPREADS * np.nanmedian(error))
        excess = np.nan_to_num(error / limit)
        if excess.max() <= 1:
            return sound, told
        # several at a time where they are no neighbours of each other
        sound &= ~((excess > 1) & (excess >= excess[neighbours.index].max(axis=1)))
        told = predict_from_neighbours(neighbours, shift_px, sound)


def drop_contradicting(
    neighbours: Neighbours, shift_px: Float[np.ndarray, "markers 2"], sound: Bool[np.ndarray, " markers"]
) -> Bool[np.ndarray, " markers"]:
    """Drop groups that agree among themselves but contradict the largest group.

    A part of a grid that moved by most of a pitch is matched wrongly as a whole: no marker in it strays from the next.
    But where it meets the rest, the skin would have to be torn or folded.

    Parameters
    ----------
    neighbours
        Of the markers at rest.
    shift_px
        Displacement of each; NaN where it has none.
    sound
        Which may be believed so far.
    """
    both = sound[:, None] & sound[neighbours.index]
    apart = np.linalg.norm(neighbours.offset, axis=-1)
    relative = np.linalg.norm(shift_px[neighbours.index] - shift_px[:, None], axis=-1) / neighbours.pitch_px[:, None]
    torn = both & (relative > _STRAIN * apart)
    against = torn & (apart < _NEAR)
    if not against.any():
        return sound
    joined = both & (relative < _ALIKE) & (apart < _ADJACENT)
    label = np.arange(len(sound))
    while True:
        # each takes the lowest label of its group, until none changes; bonds hold both ways
        lowest = label.copy()
        ends = np.where(joined, label[neighbours.index], len(label)).min(axis=1)
        np.minimum(lowest, ends, out=lowest)
        np.minimum.at(lowest, neighbours.index[joined], np.broadcast_to(lowest[:, None], joined.shape)[joined])
        if np.array_equal(lowest, label):
            break
        label = lowest
    largest = np.bincount(label[sound]).argmax()
    main = label == largest
    rows, columns = np.nonzero(against)
    others = neighbours.index[rows, columns]
    wrong = {int(label[one]) for one, other in zip(rows, others, strict=True) if main[one] != main[other]}
    wrong |= {int(label[other]) for one, other in zip(rows, others, strict=True) if main[one] != main[other]}
    return sound & (main | ~np.isin(label, list(wrong)))


def match_left_over(
    neighbours: Neighbours,
    spot: Int[np.ndarray, " markers"],
    sound: Bool[np.ndarray, " markers"],
    told_px: Float[np.ndarray, "markers 2"],
    *,
    rest_px: Float[np.ndarray, "markers 2"],
    found_px: Float[np.ndarray, "spots 2"],
) -> Int[np.ndarray, " markers"]:
    """Match markers that are not sound with spots that no sound one has, from known ground outwards.

    Where the skin moves more than half a pitch in one step, the nearest spot is the next marker's. Neighbours still
    move alike: from those that are sound each marker's place is told, and once it is found it tells of the next.

    Parameters
    ----------
    neighbours
        Of the markers at rest.
    spot
        Which spot each marker has; -1 for none.
    sound
        Which are believed.
    told_px
        Displacement of each as its sound neighbours tell it; NaN where they do not.
    rest_px, found_px
        x, y of the markers at rest, and of the spots.

    Returns
    -------
    Int[np.ndarray, " markers"]
        Spots, those of the sound markers as they were.
    """
    believed, spot = sound.copy(), np.where(sound, spot, -1)
    shift = (
        np.where(sound[:, None], found_px[spot] - rest_px, np.nan) if len(found_px) else np.full_like(rest_px, np.nan)
    )
    for _ in range(_ROUNDS):
        free = np.setdiff1d(np.arange(len(found_px)), spot[believed])
        open_ones = np.flatnonzero(~believed & np.all(np.isfinite(told_px), axis=1))
        if not len(free) or not len(open_ones):
            break
        places = rest_px[open_ones] + told_px[open_ones]
        distance = np.linalg.norm(places[:, None] - found_px[free][None], axis=-1)
        nearest, back = distance.argmin(axis=1), distance.argmin(axis=0)
        rows = np.arange(len(open_ones))
        good = (back[nearest] == rows) & (distance[rows, nearest] < GATE * neighbours.pitch_px[open_ones])
        if not good.any():
            break
        taken = open_ones[good]
        spot[taken], believed[taken] = free[nearest[good]], True
        shift[taken] = found_px[spot[taken]] - rest_px[taken]
        told_px = predict_from_neighbours(neighbours, shift, believed)
    return spot
