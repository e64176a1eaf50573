"""Matching of markers from one frame to the next: a step where they moved little, a search after a jump."""

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
_CACHED = 16
_STIFFNESS = 0.3  # of the prior that limits slopes where few neighbours are usable


@dataclass(frozen=True, kw_only=True)
class Neighbours:
    """The nearest markers of each marker at rest."""

    index: Int[np.ndarray, "markers neighbours"]
    offset: Float[np.ndarray, "markers neighbours 2"]
    """Vector from the marker, over the pitch."""
    pitch_px: Float[np.ndarray, " markers"]
    """Distance of the nearest one."""

    def weights(self, usable: Chosen) -> Float[np.ndarray, "markers neighbours"]:
        """Compute the weight of each neighbour in a marker's prediction; NaN where fewer than three are usable.

        Least squares on a plane, whose value at the marker is a sum over its neighbours. Results are cached: mostly the
        same markers are usable frame after frame.
        """
        key = usable.tobytes()
        if key not in self._weights:
            if len(self._weights) == _CACHED:
                self._weights.clear()
            self._weights[key] = self._fit(usable[self.index])
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
        normal[:, 0, 0] += 1e-9  # for markers without neighbours, which are NaN below
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


def predict_from_neighbours(neighbours: Neighbours, displacement_px: Places, usable: Chosen) -> Places:
    """Predict each marker's displacement from its usable neighbours, in pixels; NaN where fewer than three are usable.

    A plane through the neighbours' displacements, the near ones weighing most, its slopes slightly damped.
    """
    values = np.where(usable[:, None], displacement_px, 0.0)[neighbours.index]
    return (neighbours.weights(usable)[:, None] @ values)[:, 0]


GATE = 0.45
"""Largest distance of a marker from its predicted place, in pitches: less than half, so that no other is nearer."""
_CLEAN_PX = 0.3  # of differing steps: a pattern that jumps as a whole does not bend
_BENT_SHARE = 0.1  # of a marker's motion against most others, by which bent skin may differ from a plane
_VOTES = 6  # shifts that are tried
_FURTHEST = 5.0  # pitches


@dataclass(frozen=True, kw_only=True)
class Pairing:
    """Spots matched to predicted markers."""

    spot: Int[np.ndarray, " markers"]
    """Spot of each marker; -1 for none."""
    support: float
    """Share of the markers expected in view that have a spot."""
    spread_px: float
    """Disagreement of the steps where they agree most: a touch bends part of the skin, a wrong match spoils all."""
    alike: int
    """Number of markers that move with their neighbours, to the noise of a centre: hardly any in a wrong match."""
    step_px: Places
    """Step of each from where it was; NaN without a spot."""

    @property
    def paired(self) -> Chosen:
        """Markers with a spot."""
        return self.spot >= 0


def pair(
    predicted_px: Places, spots_px: Spots, from_px: Places, *, neighbours: Neighbours, size: tuple[int, int]
) -> Pairing:
    """Pair markers and spots that are nearest to each other and lead back to the markers' last places.

    Forward: a marker's spot is the nearest to its predicted place, and the marker the nearest to the spot, less than
    0.45 of the pitch away. Backward: the spot, moved back by the step that the marker's neighbours made, must lie less
    than 0.45 of the pitch from this marker's own place.
    """
    spot = _mutual(predicted_px, spots_px, reach_px=GATE * neighbours.pitch_px)
    step = np.full(predicted_px.shape, np.nan)
    step[spot >= 0] = spots_px[spot[spot >= 0]] - from_px[spot >= 0]
    expected_step = predict_from_neighbours(neighbours, step, np.all(np.isfinite(step), axis=1))
    error = np.linalg.norm(step - expected_step, axis=1)
    astray = error > GATE * neighbours.pitch_px
    spot, step = np.where(astray, -1, spot), np.where(astray[:, None], np.nan, step)
    usable = np.isfinite(error) & ~astray
    error, expected_step = error[usable], expected_step[usable]
    bend = np.linalg.norm(expected_step - np.median(expected_step, axis=0), axis=1) if len(error) else error
    alike = int((error < _CLEAN_PX + _BENT_SHARE * bend).sum())
    bent = float(np.quantile(error, 0.25)) if len(error) else np.inf
    expected = np.all((predicted_px >= 0) & (predicted_px <= np.array([size[1] - 1, size[0] - 1])), axis=1)
    matched = expected & (spot >= 0)
    return Pairing(
        spot=spot,
        support=float(matched.sum() / max(1, expected.sum())),
        spread_px=min(bent, _from_commonest(step[np.all(np.isfinite(step), axis=1)])),
        alike=alike,
        step_px=step,
    )


def _from_commonest(steps: Float[np.ndarray, "steps 2"]) -> float:
    """Compute the lower fifth of the steps' distances from the commonest step: undisturbed skin moves as a whole."""
    if not len(steps):
        return np.inf
    apart = np.hypot(*np.moveaxis(steps[:, None] - steps[None], -1, 0))
    fifth = int(0.2 * (len(steps) - 1))
    return float(np.partition(apart, fifth, axis=1)[:, fifth].min())


def _mutual(
    predicted_px: Places, spots_px: Spots, *, reach_px: Float[np.ndarray, " markers"]
) -> Int[np.ndarray, " markers"]:
    if not len(spots_px):
        return np.full(len(predicted_px), -1)
    distance = np.linalg.norm(predicted_px[:, None] - spots_px[None], axis=-1)
    distance = np.where(np.isfinite(distance), distance, np.inf)
    nearest = distance.argmin(axis=1)
    back = distance.argmin(axis=0)
    good = (back[nearest] == np.arange(len(predicted_px))) & (distance.min(axis=1) < reach_px)
    return np.where(good, nearest, -1)


def likely_shifts(places_px: Places, spots_px: Spots, *, pitch_px: float) -> Float[np.ndarray, "shifts 2"]:
    """Find shifts that bring many markers onto spots at once; every pair votes for its difference."""
    ways = (spots_px[None] - places_px[:, None]).reshape(-1, 2)
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
_RIVAL_SUPPORT, _RIVAL_SPREAD = 0.85, 1.6  # of the best: a rival so near cannot be ruled out
_LEAST_SHARE = 0.3  # of all markers
_SMALL_STEP, _SMALL_SUPPORT = 0.25, 0.8
_FEW = 6  # markers that move alike: fewer may by chance
_STANDING_SHARE, _MOVING_SHARE = 0.25, 0.5  # of the matched markers, where the pattern stands and where it jumped
_MOST_SHARE = 0.7  # of all markers


@dataclass(frozen=True, kw_only=True)
class Usual:
    """Running mean of the steps of a trial."""

    spread_px: float = np.inf
    support: float = 1.0

    def after(self, pairing: Pairing) -> "Usual":
        """Return the mean with another step."""
        spread = max(pairing.spread_px, _LEAST_SPREAD_PX / _CALM_SPREAD)
        if not np.isfinite(self.spread_px):
            return Usual(spread_px=spread, support=pairing.support)
        return Usual(spread_px=0.8 * self.spread_px + 0.2 * spread, support=0.8 * self.support + 0.2 * pairing.support)


def link(
    origins: list[Places], spots_px: Spots, *, neighbours: Neighbours, size: tuple[int, int], usual: Usual, lost: bool
) -> Pairing | None:
    """Identify the markers of a frame from possible last places, the likeliest first; None where it is ambiguous.

    A small and smooth step is accepted. Otherwise all shifts that bring many markers onto spots are tried: on a regular
    grid a step of 0.6 pitches looks like one of 0.4 the other way. The right one preserves the small irregularities of
    the print, so that neighbours move alike. A step of less than a quarter pitch is accepted unless another fits
    clearly better, and so is a pattern that after a loss stands at its last place, or at rest, even if mostly hidden.
    Of larger steps the best is accepted only where no other fits nearly as well.
    """
    step = _pair(origins[0], np.zeros(2), spots_px, neighbours=neighbours, size=size)
    moved = np.linalg.norm(step.step_px, axis=1) / neighbours.pitch_px
    way = np.inf if lost or not step.paired.any() else float(np.nanmedian(moved))
    pitch = float(np.median(neighbours.pitch_px))
    # the first step has no mean to be compared with
    spread = usual.spread_px if np.isfinite(usual.spread_px) else 0.02 * pitch
    smooth = step.spread_px <= max(_CALM_SPREAD * spread, _LEAST_SPREAD_PX)
    if way <= _CALM_STEP and smooth and step.support >= _CALM_SUPPORT * usual.support:
        return step
    stands = [step, *(_pair(origin, np.zeros(2), spots_px, neighbours=neighbours, size=size) for origin in origins[1:])]
    jumps = [
        _pair(origin, shift, spots_px, neighbours=neighbours, size=size)
        for origin in origins
        for shift in likely_shifts(origin, spots_px, pitch_px=pitch)
    ]
    tried = [*stands, *jumps]
    fewest = _LEAST_SHARE * len(origins[0])
    rivals = [match for match in tried if match.support >= _LEAST_SUPPORT and match.paired.sum() >= fewest]
    # first a pattern that hardly moved, or stands at rest again, however many markers are hidden or dragged along
    for match in stands:
        moved = np.linalg.norm(match.step_px[match.paired], axis=1) / neighbours.pitch_px[match.paired]
        small = len(moved) > 0 and np.median(moved) < _SMALL_STEP
        certain = match.support >= _SMALL_SUPPORT or _stands_out(match, tried, share=_STANDING_SHARE, rivals=1.0)
        if small and certain and not any(_beats(other, match) for other in rivals):
            return match
    # part of a half hidden pattern may fit elsewhere by chance
    most = _MOST_SHARE * len(origins[0])
    rivals = [
        match
        for match in rivals
        if match.paired.sum() >= most or _stands_out(match, tried, share=_MOVING_SHARE, rivals=0.5)
    ]
    if not rivals:
        return None
    best = max(rivals, key=lambda match: match.paired.sum() * match.support / (match.spread_px + 0.1))
    return None if any(_rules_out(other, best) for other in rivals) else best


def _stands_out(match: Pairing, tried: list[Pairing], *, share: float, rivals: float) -> bool:
    """Check that a share of the markers moves with their neighbours, and fewer in every other match."""
    fewest, most = max(_FEW, share * match.paired.sum()), rivals * match.alike
    return bool(match.alike >= fewest) and all(other.alike <= most for other in tried if _differs(other, match))


def _differs(first: Pairing, second: Pairing) -> bool:
    both = first.paired & second.paired
    return bool(not both.any() or np.mean(first.spot[both] != second.spot[both]) > 0.5)


def _beats(other: Pairing, small: Pairing) -> bool:
    """Check whether a jump explains a frame clearly better: all markers move alike, or one more row is matched."""
    smoother = _RIVAL_SPREAD * other.spread_px + 0.02 < small.spread_px
    fuller = (
        other.paired.sum() > 1.04 * small.paired.sum()
        and other.support > small.support + 0.04
        and other.spread_px < min(1.2 * small.spread_px + 0.02, _CLEAN_PX)
    )
    return bool((smoother and other.paired.sum() >= _RIVAL_SUPPORT * small.paired.sum()) or fuller)


def _rules_out(other: Pairing, best: Pairing) -> bool:
    """Check whether another pairing fits nearly as well as the best, so that neither can be accepted."""
    strong = other.paired.sum() >= _RIVAL_SUPPORT * best.paired.sum()
    return bool(_differs(other, best) and strong and other.spread_px < _RIVAL_SPREAD * best.spread_px + 0.02)


def _pair(
    origin_px: Places,
    shift_px: Float[np.ndarray, "2"],
    spots_px: Spots,
    *,
    neighbours: Neighbours,
    size: tuple[int, int],
) -> Pairing:
    """Pair after a common shift, then again after the steps of the neighbours."""
    predicted = origin_px + shift_px
    pairing = pair(predicted, spots_px, origin_px, neighbours=neighbours, size=size)
    steps = predict_from_neighbours(neighbours, pairing.step_px, pairing.paired)
    refined = np.where(np.isfinite(steps), origin_px + steps, predicted)
    return pair(refined, spots_px, origin_px, neighbours=neighbours, size=size)


_STRAY_PITCHES, _STRAY_SPREADS = 0.3, 6.0
_ROUNDS = 6
_ADJACENT, _NEAR = 1.6, 2.3  # pitches: next to each other, and near enough to contradict each other
_ALIKE = 0.5  # pitches, of displacement between two that stand together
_STRAIN = 0.55  # pixels of relative displacement per pixel of distance: more is no skin, but a wrong match


def drop_strays(neighbours: Neighbours, shift_px: Places, sound: Chosen) -> tuple[Chosen, Places]:
    """Drop markers that stray from their neighbours, the worst first: a stray makes its neighbours look astray.

    Gives the sound markers, and the displacement of each as they predict it.
    """
    while True:
        predicted = predict_from_neighbours(neighbours, shift_px, sound)
        error = np.where(sound, np.linalg.norm(shift_px - predicted, axis=1), np.nan)
        usual = np.nanmedian(error) if np.isfinite(error).any() else np.inf
        excess = np.nan_to_num(error / np.maximum(_STRAY_PITCHES * neighbours.pitch_px, _STRAY_SPREADS * usual))
        if excess.max() <= 1:
            return sound, predicted
        # several at a time where they are not neighbours
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
    predicted_px: Places,
    *,
    rest_px: Places,
    spots_px: Spots,
) -> Int[np.ndarray, " markers"]:
    """Match markers that are not sound with free spots, outwards from the sound ones.

    Where the skin moves more than half a pitch in one step, the nearest spot is the next marker's. Neighbours still
    move alike: sound markers predict the places of those next to them, which then predict further ones.
    """
    matched, spot = sound.copy(), np.where(sound, spot, -1)
    shift = np.full_like(rest_px, np.nan)
    shift[sound] = spots_px[spot[sound]] - rest_px[sound]
    for _ in range(_ROUNDS):
        free = np.setdiff1d(np.arange(len(spots_px)), spot[matched])
        open_ones = np.flatnonzero(~matched & np.all(np.isfinite(predicted_px), axis=1))
        if not len(free) or not len(open_ones):
            break
        places, reach_px = rest_px[open_ones] + predicted_px[open_ones], GATE * neighbours.pitch_px[open_ones]
        nearest = _mutual(places, spots_px[free], reach_px=reach_px)
        taken = open_ones[nearest >= 0]
        if not len(taken):
            break
        spot[taken], matched[taken] = free[nearest[nearest >= 0]], True
        shift[taken] = spots_px[spot[taken]] - rest_px[taken]
        predicted_px = predict_from_neighbours(neighbours, shift, matched)
    return spot
