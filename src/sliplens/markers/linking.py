"""From one frame to the next: a step where the pattern moved little, a search where it may have jumped."""

from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

Places: TypeAlias = Float[np.ndarray, "markers 2"]
Spots: TypeAlias = Float[np.ndarray, "spots 2"]
Chosen: TypeAlias = Bool[np.ndarray, " markers"]

_NEIGHBOURS = 8
_FEWEST = 3
_KEPT = 16
_STIFFNESS = 0.3  # of the prior that holds slopes down where few neighbours are left


@dataclass(frozen=True, kw_only=True)
class Neighbours:
    """The nearest markers of each marker at rest."""

    index: Int[np.ndarray, "markers neighbours"]
    offset: Float[np.ndarray, "markers neighbours 2"]
    """Way from the marker, over the pitch."""
    pitch_px: Float[np.ndarray, " markers"]
    """Distance of the nearest one."""

    def weights(self, known: Chosen) -> Float[np.ndarray, "markers neighbours"]:
        """Weight of each neighbour in what the known ones tell of a marker; NaN where fewer than three are known.

        Least squares on a plane, whose value at the marker is a sum over its neighbours. Frame after frame mostly the
        same markers are known, so the last answers are kept.
        """
        key = known.tobytes()
        if key not in self._weights:
            if len(self._weights) == _KEPT:
                self._weights.clear()
            self._weights[key] = self._fit(known[self.index])
        return self._weights[key]

    @cached_property
    def _weights(self) -> dict[bytes, Float[np.ndarray, "markers neighbours"]]:
        return {}

    def _fit(self, usable: Bool[np.ndarray, "markers neighbours"]) -> Float[np.ndarray, "markers neighbours"]:
        near = np.exp(-(self.offset**2).sum(axis=-1) / (2 * 1.5**2))
        terms = np.concatenate([np.ones((*usable.shape, 1)), self.offset], axis=-1)
        weighted = np.swapaxes(terms * np.where(usable, near, 0.0)[..., None], 1, 2)
        normal = weighted @ terms
        normal[:, [1, 2], [1, 2]] += _STIFFNESS * 0.1
        normal[:, 0, 0] += 1e-9  # a marker without neighbours is answered below
        fit = np.linalg.solve(normal, weighted)
        return np.where(usable.sum(axis=1)[:, None] >= _FEWEST, fit[:, 0], np.nan)


def find_neighbours(place_px: Places) -> Neighbours:
    """Find the nearest eight markers of each, or all others where there are fewer."""
    distance = np.linalg.norm(place_px[:, None] - place_px[None], axis=-1)
    np.fill_diagonal(distance, np.inf)
    count = min(_NEIGHBOURS, len(place_px) - 1)
    index = np.argsort(distance, axis=1, kind="stable")[:, :count]
    pitch = distance.min(axis=1)
    offset = (place_px[index] - place_px[:, None]) / pitch[:, None, None]
    return Neighbours(index=index, offset=offset, pitch_px=pitch)


def predict_from_neighbours(neighbours: Neighbours, displacement_px: Places, known: Chosen) -> Places:
    """Displacement of each marker as its neighbours alone tell it, in pixels; NaN where fewer than three are known.

    A plane through the known neighbours' displacements, the near ones weighing most, its slopes held down a little.
    """
    values = np.where(known[:, None], displacement_px, 0.0)[neighbours.index]
    return (neighbours.weights(known)[:, None] @ values)[:, 0]


GATE = 0.45
"""Pitches, within which a marker may be taken for the one predicted: less than half, so that no other is nearer."""
_CLEAN_PX = 0.3  # of unlike steps: what jumps as a whole does not bend
_BENT_SHARE = 0.1  # of what a marker moves apart from most, by which bent skin may differ from a plane
_VOTES = 6  # shifts that are looked at
_FURTHEST = 5.0  # pitches


@dataclass(frozen=True, kw_only=True)
class Pairing:
    """Found spots for predicted markers."""

    spot: Int[np.ndarray, " markers"]
    """Spot of each marker; -1 for none."""
    support: float
    """Share of the markers expected in view that have a spot."""
    spread_px: float
    """Unlikeness of the steps where they are most alike: a touch bends some skin, a wrong match spoils all."""
    alike: int
    """Markers that step as their neighbours do, to the noise of a centre: hardly any of a wrong match."""
    step_px: Places
    """Step of each from where it was; NaN without a spot."""

    @property
    def paired(self) -> Chosen:
        """Markers with a spot."""
        return self.spot >= 0


def pair(
    predicted_px: Places, found_px: Spots, from_px: Places, *, neighbours: Neighbours, size: tuple[int, int]
) -> Pairing:
    """Pair markers and spots that are nearest to each other, and that lead back to where the markers were before.

    Forward: a marker's spot is the nearest to its predicted place, and the marker the nearest to the spot, less than
    0.45 of the pitch away. Backward: the spot, moved back by the step that the marker's neighbours made, must lie less
    than 0.45 of the pitch from this marker's own place.
    """
    spot = _mutual(predicted_px, found_px, reach_px=GATE * neighbours.pitch_px)
    step = np.full(predicted_px.shape, np.nan)
    step[spot >= 0] = found_px[spot[spot >= 0]] - from_px[spot >= 0]
    told = predict_from_neighbours(neighbours, step, np.all(np.isfinite(step), axis=1))
    error = np.linalg.norm(step - told, axis=1)
    astray = error > GATE * neighbours.pitch_px
    spot, step = np.where(astray, -1, spot), np.where(astray[:, None], np.nan, step)
    kept = np.isfinite(error) & ~astray
    error, told = error[kept], told[kept]
    bend = np.linalg.norm(told - np.median(told, axis=0), axis=1) if len(told) else error
    alike = int((error < _CLEAN_PX + _BENT_SHARE * bend).sum())
    bent = float(np.quantile(error, 0.25)) if len(error) else np.inf
    expected = np.all((predicted_px >= 0) & (predicted_px <= np.array([size[1] - 1, size[0] - 1])), axis=1)
    seen = expected & (spot >= 0)
    return Pairing(
        spot=spot,
        support=float(seen.sum() / max(1, expected.sum())),
        spread_px=min(bent, _from_commonest(step[np.all(np.isfinite(step), axis=1)])),
        alike=alike,
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
    predicted_px: Places, found_px: Spots, *, reach_px: Float[np.ndarray, " markers"]
) -> Int[np.ndarray, " markers"]:
    if not len(found_px):
        return np.full(len(predicted_px), -1)
    distance = np.linalg.norm(predicted_px[:, None] - found_px[None], axis=-1)
    distance = np.where(np.isfinite(distance), distance, np.inf)
    nearest = distance.argmin(axis=1)
    back = distance.argmin(axis=0)
    good = (back[nearest] == np.arange(len(predicted_px))) & (distance.min(axis=1) < reach_px)
    return np.where(good, nearest, -1)


def likely_shifts(places_px: Places, found_px: Spots, *, pitch_px: float) -> Float[np.ndarray, "shifts 2"]:
    """Shifts that bring many markers onto spots at once, most votes first: every pair votes for its difference."""
    ways = (found_px[None] - places_px[:, None]).reshape(-1, 2)
    # longer ones leave hardly any marker in view
    ways = ways[np.abs(ways).max(axis=1) < _FURTHEST * pitch_px]
    if not len(ways):
        return np.zeros((0, 2))
    keys = np.round(ways / (pitch_px / 3)).astype(np.int64)
    most = int(np.abs(keys).max()) + 1
    side = 2 * most + 1
    votes = np.bincount((keys + most) @ (side, 1), minlength=side**2).reshape(side, side)
    # a peak may lie on the border of cells: neighbours lend their votes
    around = sum(np.roll(votes, (down, along), axis=(0, 1)) for down in (-1, 0, 1) for along in (-1, 0, 1))
    cells = np.flatnonzero(votes)
    shifts: list[np.ndarray] = []
    for at in cells[np.argsort(-np.ravel(around)[cells], kind="stable")]:
        if len(shifts) == _VOTES:
            break
        cell = np.array(divmod(int(at), side)) - most
        shift = np.median(ways[np.abs(keys - cell).max(axis=1) <= 1], axis=0)
        if all(np.linalg.norm(shift - other) > 0.5 * pitch_px for other in shifts):
            shifts.append(shift)
    return np.array(shifts)


_CALM_STEP = 0.2  # pitches: a larger step may be one the other way round a regular grid
_CALM_SPREAD = 2.5  # times the usual one
_LEAST_SPREAD_PX = 0.15
_LEAST_SUPPORT = 0.6
_CALM_SUPPORT = 0.85  # of the usual one
_RIVAL_SUPPORT, _RIVAL_SPREAD = 0.85, 1.6  # of the best: whoever comes so near cannot be ruled out
_LEAST_SHARE = 0.3  # of all markers
_SMALL_STEP, _SMALL_SUPPORT = 0.25, 0.8
_FEW = 6  # markers that move alike: fewer may by chance
_STANDING_SHARE, _MOVING_SHARE = 0.25, 0.5  # of those with a spot, where it stands as it did and where it jumped
_MOST_SHARE = 0.7  # of all markers


@dataclass(frozen=True, kw_only=True)
class Usual:
    """Usual steps of this trial."""

    spread_px: float = np.inf
    support: float = 1.0

    def after(self, pairing: Pairing) -> "Usual":
        """Remember one more step."""
        spread = max(pairing.spread_px, _LEAST_SPREAD_PX / _CALM_SPREAD)
        if not np.isfinite(self.spread_px):
            return Usual(spread_px=spread, support=pairing.support)
        return Usual(spread_px=0.8 * self.spread_px + 0.2 * spread, support=0.8 * self.support + 0.2 * pairing.support)


def link(
    origins: list[Places], found_px: Spots, *, neighbours: Neighbours, size: tuple[int, int], usual: Usual, lost: bool
) -> Pairing | None:
    """Tell which marker is which, from places where they may have been, the likeliest first; None if it cannot be told.

    A small and smooth step is taken as it is. Otherwise all shifts that bring many markers onto spots are tried: on a
    regular grid a step of 0.6 pitches looks like one of 0.4 the other way. The right one keeps the small irregularities
    of the print, so that neighbours move alike. A step of less than a quarter pitch is believed unless another does
    clearly better, and so is a pattern that after a loss stands as it did, or as at rest, though most of it may be
    hidden. Of larger steps the best is believed only where no other does nearly as well.
    """
    step = _pair(origins[0], np.zeros(2), found_px, neighbours=neighbours, size=size)
    moved = np.linalg.norm(step.step_px, axis=1) / neighbours.pitch_px
    way = np.inf if lost or not step.paired.any() else float(np.nanmedian(moved))
    pitch = float(np.median(neighbours.pitch_px))
    # the first step has nothing to be compared with
    spread = usual.spread_px if np.isfinite(usual.spread_px) else 0.02 * pitch
    smooth = step.spread_px <= max(_CALM_SPREAD * spread, _LEAST_SPREAD_PX)
    if way <= _CALM_STEP and smooth and step.support >= _CALM_SUPPORT * usual.support:
        return step
    stands = [step, *(_pair(origin, np.zeros(2), found_px, neighbours=neighbours, size=size) for origin in origins[1:])]
    jumps = [
        _pair(origin, shift, found_px, neighbours=neighbours, size=size)
        for origin in origins
        for shift in likely_shifts(origin, found_px, pitch_px=pitch)
    ]
    tried = [*stands, *jumps]
    rivals = [
        one for one in tried if one.support >= _LEAST_SUPPORT and one.paired.sum() >= _LEAST_SHARE * len(origins[0])
    ]
    # first what hardly moved since it was seen, or stands as at rest again, however many are hidden or torn along
    for one in stands:
        moved = np.linalg.norm(one.step_px[one.paired], axis=1) / neighbours.pitch_px[one.paired]
        small = len(moved) > 0 and np.median(moved) < _SMALL_STEP
        known = one.support >= _SMALL_SUPPORT or _stands_out(one, tried, share=_STANDING_SHARE, rivals=1.0)
        if small and known and not any(_beats(other, one) for other in rivals):
            return one
    # of what is half hidden a part may fit elsewhere by chance
    most = _MOST_SHARE * len(origins[0])
    rivals = [
        one for one in rivals if one.paired.sum() >= most or _stands_out(one, tried, share=_MOVING_SHARE, rivals=0.5)
    ]
    if not rivals:
        return None
    best = max(rivals, key=lambda one: one.paired.sum() * one.support / (one.spread_px + 0.1))
    return None if any(_rules_out(other, best) for other in rivals) else best


def _stands_out(one: Pairing, tried: list[Pairing], *, share: float, rivals: float) -> bool:
    """Whether a share of the markers moves as their neighbours do, and in no other match more than so many of them."""
    fewest, most = max(_FEW, share * one.paired.sum()), rivals * one.alike
    return bool(one.alike >= fewest) and all(other.alike <= most for other in tried if _differs(other, one))


def _differs(other: Pairing, one: Pairing) -> bool:
    both = other.paired & one.paired
    return bool(not both.any() or np.mean(other.spot[both] != one.spot[both]) > 0.5)


def _beats(other: Pairing, small: Pairing) -> bool:
    """Whether a jump explains a frame clearly better: all moves alike, or a row more finds its place."""
    smoother = _RIVAL_SPREAD * other.spread_px + 0.02 < small.spread_px
    fuller = (
        other.paired.sum() > 1.04 * small.paired.sum()
        and other.support > small.support + 0.04
        and other.spread_px < min(1.2 * small.spread_px + 0.02, _CLEAN_PX)
    )
    return bool((smoother and other.paired.sum() >= _RIVAL_SUPPORT * small.paired.sum()) or fuller)


def _rules_out(other: Pairing, best: Pairing) -> bool:
    """Whether another pairing does nearly as well as the best, so that neither can be believed."""
    strong = other.paired.sum() >= _RIVAL_SUPPORT * best.paired.sum()
    return bool(_differs(other, best) and strong and other.spread_px < _RIVAL_SPREAD * best.spread_px + 0.02)


def _pair(
    origin_px: Places,
    shift_px: Float[np.ndarray, "2"],
    found_px: Spots,
    *,
    neighbours: Neighbours,
    size: tuple[int, int],
) -> Pairing:
    """Pair after a shift of all, then once more after the steps that neighbours made."""
    predicted = origin_px + shift_px
    pairing = pair(predicted, found_px, origin_px, neighbours=neighbours, size=size)
    told = predict_from_neighbours(neighbours, pairing.step_px, pairing.paired)
    refined = np.where(np.isfinite(told), origin_px + told, predicted)
    return pair(refined, found_px, origin_px, neighbours=neighbours, size=size)


_STRAY_PITCHES, _STRAY_SPREADS = 0.3, 6.0
_ROUNDS = 6
_ADJACENT, _NEAR = 1.6, 2.3  # pitches: next to each other, and so near that they may still contradict each other
_ALIKE = 0.5  # pitches, of displacement between two that stand together
_STRAIN = 0.55  # pixels of relative displacement per pixel of distance: more is no skin, but a wrong match


def drop_strays(neighbours: Neighbours, shift_px: Places, sound: Chosen) -> tuple[Chosen, Places]:
    """Drop markers that stray from their neighbours, worst first: one stray makes all round it look astray.

    Gives which may still be believed, and what the neighbours that remain say of each displacement.
    """
    while True:
        told = predict_from_neighbours(neighbours, shift_px, sound)
        error = np.where(sound, np.linalg.norm(shift_px - told, axis=1), np.nan)
        usual = np.nanmedian(error) if np.isfinite(error).any() else np.inf
        excess = np.nan_to_num(error / np.maximum(_STRAY_PITCHES * neighbours.pitch_px, _STRAY_SPREADS * usual))
        if excess.max() <= 1:
            return sound, told
        # several at a time where they are no neighbours of each other
        sound = sound & ~((excess > 1) & (excess >= excess[neighbours.index].max(axis=1)))


def drop_contradicting(neighbours: Neighbours, shift_px: Places, sound: Chosen) -> Chosen:
    """Drop groups that agree among themselves but contradict the largest group.

    A part of a grid that moved by most of a pitch is matched wrongly as a whole: no marker in it strays from the next.
    But where it meets the rest, the skin would have to be torn or folded.
    """
    both = sound[:, None] & sound[neighbours.index]
    apart = np.linalg.norm(neighbours.offset, axis=-1)
    relative = np.linalg.norm(shift_px[neighbours.index] - shift_px[:, None], axis=-1) / neighbours.pitch_px[:, None]
    against = both & (relative > _STRAIN * apart) & (apart < _NEAR)
    if not against.any():
        return sound
    joined = both & (relative < _ALIKE) & (apart < _ADJACENT)
    ends = np.nonzero(joined)[0], neighbours.index[joined]
    # bonds hold both ways
    _, label = connected_components(coo_array((joined[joined], ends), shape=(len(sound),) * 2), directed=False)
    main = label == np.bincount(label[sound]).argmax()
    rows, columns = np.nonzero(against)
    others = neighbours.index[rows, columns]
    apart_from_main = main[rows] != main[others]
    wrong = label[np.concatenate([rows[apart_from_main], others[apart_from_main]])]
    return sound & (main | ~np.isin(label, wrong))


def match_left_over(
    neighbours: Neighbours,
    spot: Int[np.ndarray, " markers"],
    sound: Chosen,
    told_px: Places,
    *,
    rest_px: Places,
    found_px: Spots,
) -> Int[np.ndarray, " markers"]:
    """Match markers that are not sound with spots that no sound one has, from known ground outwards.

    Where the skin moves more than half a pitch in one step, the nearest spot is the next marker's. Neighbours still
    move alike: from those that are sound each marker's place is told, and once it is found it tells of the next.
    """
    believed, spot = sound.copy(), np.where(sound, spot, -1)
    shift = np.full_like(rest_px, np.nan)
    shift[sound] = found_px[spot[sound]] - rest_px[sound]
    for _ in range(_ROUNDS):
        free = np.setdiff1d(np.arange(len(found_px)), spot[believed])
        open_ones = np.flatnonzero(~believed & np.all(np.isfinite(told_px), axis=1))
        if not len(free) or not len(open_ones):
            break
        places, reach_px = rest_px[open_ones] + told_px[open_ones], GATE * neighbours.pitch_px[open_ones]
        nearest = _mutual(places, found_px[free], reach_px=reach_px)
        taken = open_ones[nearest >= 0]
        if not len(taken):
            break
        spot[taken], believed[taken] = free[nearest[nearest >= 0]], True
        shift[taken] = found_px[spot[taken]] - rest_px[taken]
        told_px = predict_from_neighbours(neighbours, shift, believed)
    return spot
