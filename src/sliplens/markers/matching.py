"""Which marker is which: pairing predicted places with found ones, and telling a jump from a step."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from sliplens.markers.neighbours import Neighbours, predict_from_neighbours

GATE = 0.45
"""Pitches, within which a marker may be taken for the one predicted: less than half, so that no other is nearer."""
_VOTES = 6  # shifts that are looked at
_FURTHEST = 5.0  # pitches


@dataclass(frozen=True, kw_only=True)
class Pairing:
    """Found spots for predicted markers."""

    spot: Int[np.ndarray, " markers"]
    """Which spot each marker is; -1 for none."""
    support: float
    """Share of the markers expected in view that have a spot."""
    spread_px: float
    """How unlike steps are where they are most alike: a touch bends the skin in places, a wrong match spoils all. The
    lower quartile of the steps' distances from what their neighbours' steps say, or the lower fifth of those from the
    commonest step, whichever is less."""
    step_px: Float[np.ndarray, "markers 2"]
    """From where each was; NaN without a spot."""

    @property
    def paired(self) -> Bool[np.ndarray, " markers"]:
        """Markers with a spot."""
        return self.spot >= 0


def pair(
    predicted_px: Float[np.ndarray, "markers 2"],
    found_px: Float[np.ndarray, "spots 2"],
    *,
    from_px: Float[np.ndarray, "markers 2"],
    neighbours: Neighbours,
    expected: Bool[np.ndarray, " markers"],
) -> Pairing:
    """Pair markers and spots that are nearest to each other, and that lead back to where they came from.

    Forward: a marker's spot is the nearest to its predicted place, and the marker the nearest to the spot, less than
    0.45 of the pitch away. Backward: the spot, moved back by the step that the marker's neighbours made, must lie less
    than 0.45 of the pitch from this marker's own place.

    Parameters
    ----------
    predicted_px
        Where each marker is expected; NaN if nowhere.
    found_px
        What was found.
    from_px
        Where each marker was before; NaN where it was not seen.
    neighbours
        Of the markers at rest.
    expected
        Markers that should be in view.
    """
    spot = _mutual(predicted_px, found_px, reach_px=GATE * neighbours.pitch_px)
    step = np.full(predicted_px.shape, np.nan)
    if len(found_px):
        step = np.where(spot[:, None] >= 0, found_px[spot] - from_px, np.nan)
    known = np.all(np.isfinite(step), axis=1)
    told = predict_from_neighbours(neighbours, step, known)
    error = np.linalg.norm(step - told, axis=1)
    astray = error > GATE * neighbours.pitch_px
    spot, step = np.where(astray, -1, spot), np.where(astray[:, None], np.nan, step)
    error = error[np.isfinite(error) & ~astray]
    bent = float(np.quantile(error, 0.25)) if len(error) else np.inf
    seen = expected & (spot >= 0)
    return Pairing(
        spot=spot,
        support=float(seen.sum() / max(1, expected.sum())),
        spread_px=min(bent, _from_commonest(step[np.all(np.isfinite(step), axis=1)])),
        step_px=step,
    )


def _from_commonest(steps: Float[np.ndarray, "steps 2"]) -> float:
    """Lower fifth of the steps' distances from the commonest one: the skin far from a touch moves as one."""
    if not len(steps):
        return np.inf
    apart = np.hypot(*np.moveaxis(steps[:, None] - steps[None], -1, 0))
    fifth = int(0.2 * (len(steps) - 1))
    return float(np.partition(apart, fifth, axis=1)[:, fifth].min())


def _mutual(
    predicted_px: Float[np.ndarray, "markers 2"],
    found_px: Float[np.ndarray, "spots 2"],
    *,
    reach_px: Float[np.ndarray, " markers"],
) -> Int[np.ndarray, " markers"]:
    if not len(found_px):
        return np.full(len(predicted_px), -1)
    distance = np.linalg.norm(predicted_px[:, None] - found_px[None], axis=-1)
    distance = np.where(np.isfinite(distance), distance, np.inf)
    nearest = distance.argmin(axis=1)
    back = distance.argmin(axis=0)
    markers = np.arange(len(predicted_px))
    good = (back[nearest] == markers) & (distance[markers, nearest] < reach_px)
    return np.where(good, nearest, -1)


def likely_shifts(
    places_px: Float[np.ndarray, "markers 2"], found_px: Float[np.ndarray, "spots 2"], *, pitch_px: float
) -> Float[np.ndarray, "shifts 2"]:
    """Shifts that bring many markers onto spots at once, most votes first.

    Every pair of marker and spot votes for its difference; votes within a third of the pitch count together.
    """
    ways = (found_px[None] - places_px[:, None]).reshape(-1, 2)
    # longer ones leave hardly any marker in view
    ways = ways[np.abs(ways).max(axis=1) < _FURTHEST * pitch_px]
    if not len(ways):
        return np.zeros((0, 2))
    cell = pitch_px / 3
    keys = np.round(ways / cell).astype(np.int64)
    cells, inverse, votes = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    # a peak may lie on the border of cells: neighbours lend their votes
    near = (
        np.abs(cells[:, None] - cells[None]).max(axis=-1) <= 1 if len(cells) < 4000 else np.eye(len(cells), dtype=bool)
    )
    total = near @ votes
    shifts: list[np.ndarray] = []
    for at in np.argsort(-total, kind="stable"):
        if len(shifts) == _VOTES:
            break
        chosen = near[at][inverse.ravel()]
        shift = np.median(ways[chosen], axis=0)
        if all(np.linalg.norm(shift - other) > 0.5 * pitch_px for other in shifts):
            shifts.append(shift)
    return np.array(shifts)
