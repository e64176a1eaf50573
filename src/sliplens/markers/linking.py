"""Matching of markers from one frame to the next: a step where they moved little, a search after a jump."""

from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int

Places: TypeAlias = Float[np.ndarray, "markers 2"]
Spots: TypeAlias = Float[np.ndarray, "spots 2"]
Chosen: TypeAlias = Bool[np.ndarray, " markers"]
Matches: TypeAlias = Int[np.ndarray, " markers"]

GATE = 0.45
"""Largest distance of a marker from its predicted place, in pitches: less than half, so that no other is nearer."""
_NEIGHBOURS, _FEWEST = 8, 3
_STIFFNESS = 0.03  # of the prior that limits slopes where few neighbours are usable
_CLEAN_PX = 0.3  # of differing steps: a pattern that jumps as a whole does not bend
_BENT_SHARE = 0.1  # of a marker's motion against most others, by which bent skin may differ from a plane
_VOTES, _FURTHEST = 6, 5.0  # shifts that are tried, and the longest in pitches
_CALM_STEP = 0.2  # pitches: a larger step may be one the other way round a regular grid
_CALM_SPREAD, _CALM_SUPPORT = 2.5, 0.85  # of the usual ones
_LEAST_SPREAD_PX, _LEAST_SUPPORT = 0.15, 0.6
_RIVAL_SUPPORT, _RIVAL_SPREAD = 0.85, 1.6  # of the best: a rival so near cannot be ruled out
_LEAST_SHARE, _MOST_SHARE = 0.3, 0.7  # of all markers
_SMALL_STEP, _SMALL_SUPPORT = 0.25, 0.8
_FEW = 6  # markers that move alike: fewer may by chance
_STANDING_SHARE, _MOVING_SHARE = 0.25, 0.5  # of the matched markers, where the pattern stands and where it jumped
_STRAY_PITCHES, _STRAY_SPREADS = 0.3, 6.0
_ROUNDS = 6
_ADJACENT, _NEAR = 1.6, 2.3  # pitches: next to each other, and near enough to contradict each other
_ALIKE = 0.5  # pitches, of displacement between two that stand together
_STRAIN = 0.55  # pixels of relative displacement per pixel of distance: more is no skin, but a wrong match


@dataclass(frozen=True, kw_only=True)
class Pairing:
    """Spots matched to predicted markers."""

    spot: Matches
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


class Pattern:
    """Markers at rest with their nearest eight, and the running mean of the steps of a trial."""

    def __init__(self, place_px: Places, *, size: tuple[int, int]) -> None:
        self._rest, self._size = place_px, size
        distance = np.linalg.norm(place_px[:, None] - place_px[None], axis=-1)
        np.fill_diagonal(distance, np.inf)
        self._near = np.argsort(distance, axis=1, kind="stable")[:, : min(_NEIGHBOURS, len(place_px) - 1)]
        self._pitch = distance.min(axis=1)
        self._offset = (place_px[self._near] - place_px[:, None]) / self._pitch[:, None, None]
        # mostly the same markers are usable frame after frame
        self._weights = lru_cache(maxsize=16)(self._fit)
        self._usual = np.array([np.inf, 1.0])
        """Usual spread and support of a pairing."""

    def _fit(self, usable: bytes) -> Float[np.ndarray, "markers neighbours"]:
        """Fit a plane by least squares: its value at a marker is a weighted sum over the neighbours."""
        valid = np.frombuffer(usable, dtype=bool)[self._near]
        near = np.exp(-(self._offset**2).sum(axis=-1) / (2 * 1.5**2))
        terms = np.concatenate([np.ones((*valid.shape, 1)), self._offset], axis=-1)
        weighted = np.swapaxes(terms * np.where(valid, near, 0.0)[..., None], 1, 2)
        normal = weighted @ terms
        normal[:, [1, 2], [1, 2]] += _STIFFNESS
        normal[:, 0, 0] += 1e-9  # for markers without neighbours, which are NaN below
        fit = np.linalg.solve(normal, weighted)
        return np.where(valid.sum(axis=1)[:, None] >= _FEWEST, fit[:, 0], np.nan)

    def predict(self, displacement_px: Places, usable: Chosen) -> Places:
        """Predict each displacement from the usable neighbours, in pixels; NaN where fewer than three are usable."""
        values = np.where(usable[:, None], displacement_px, 0.0)[self._near]
        return (self._weights(usable.tobytes())[:, None] @ values)[:, 0]

    def link(self, origins: list[Places], spots_px: Spots, *, lost: bool) -> Pairing | None:
        """Identify the markers of a frame from possible last places, the likeliest first; None where it is ambiguous.

        A small and smooth step is accepted. Otherwise all shifts that bring many markers onto spots are tried: on a
        regular grid a step of 0.6 pitches looks like one of 0.4 the other way. The right one preserves the small
        irregularities of the print, so that neighbours move alike. A step of less than a quarter pitch is accepted
        unless another fits clearly better, and so is a pattern that after a loss stands at its last place, or at rest,
        even if mostly hidden. Of larger steps the best is accepted only where no other fits nearly as well.
        """
        step = self._pair_twice(origins[0], np.zeros(2), spots_px)
        if not lost and self._is_calm(step):
            return step
        pitch = float(np.median(self._pitch))
        stands = [step, *(self._pair_twice(origin, np.zeros(2), spots_px) for origin in origins[1:])]
        shifts = [(origin, shift) for origin in origins for shift in likely_shifts(origin, spots_px, pitch_px=pitch)]
        tried = [*stands, *(self._pair_twice(origin, shift, spots_px) for origin, shift in shifts)]
        least, most = _LEAST_SHARE * len(self._rest), _MOST_SHARE * len(self._rest)
        rivals = [match for match in tried if match.support >= _LEAST_SUPPORT and match.paired.sum() >= least]
        # first a pattern that hardly moved, or stands at rest again, however many markers are hidden or dragged along
        for match in stands:
            moved = np.linalg.norm(match.step_px[match.paired], axis=1) / self._pitch[match.paired]
            small = len(moved) > 0 and np.median(moved) < _SMALL_STEP
            certain = match.support >= _SMALL_SUPPORT or _stands_out(match, tried, share=_STANDING_SHARE, rivals=1.0)
            if small and certain and not any(_beats(other, match) for other in rivals):
                return match
        # part of a half hidden pattern may fit elsewhere by chance
        rivals = [
            match
            for match in rivals
            if match.paired.sum() >= most or _stands_out(match, tried, share=_MOVING_SHARE, rivals=0.5)
        ]
        best = max(rivals, key=lambda match: match.paired.sum() * match.support / (match.spread_px + 0.1), default=None)
        return None if best is None or any(_rules_out(other, best) for other in rivals) else best

    def accept(self, origin_px: Places, spots_px: Spots, spot: Matches) -> Pairing | None:
        """Accept spots measured at the last places of the markers, -1 for none, where the step is small and smooth."""
        pairing = self._judge(origin_px, spots_px, spot, origin_px)
        return pairing if self._is_calm(pairing) else None

    def note(self, pairing: Pairing | None) -> None:
        """Update the usual spread and support by a pairing that was accepted."""
        if pairing is not None:
            new = np.array([max(pairing.spread_px, _LEAST_SPREAD_PX / _CALM_SPREAD), pairing.support])
            self._usual = 0.8 * self._usual + 0.2 * new if np.isfinite(self._usual[0]) else new

    def _is_calm(self, step: Pairing) -> bool:
        moved = np.linalg.norm(step.step_px, axis=1) / self._pitch
        spread_px, support = self._usual.tolist()
        if not np.isfinite(spread_px):  # the first step has no mean to be compared with
            spread_px = 0.02 * float(np.median(self._pitch))
        smooth = step.spread_px <= max(_CALM_SPREAD * spread_px, _LEAST_SPREAD_PX)
        small = bool(step.paired.any()) and float(np.nanmedian(moved)) <= _CALM_STEP
        return small and smooth and step.support >= _CALM_SUPPORT * support

    def _pair_twice(self, origin_px: Places, shift_px: Float[np.ndarray, "2"], spots_px: Spots) -> Pairing:
        """Pair markers and spots nearest to each other after a common shift, then again after the neighbours' steps.

        Forward, a spot lies less than 0.45 of the pitch from the predicted place. Backward, it lies as near to the
        marker's own last place once it is moved back by the step of the marker's neighbours.
        """
        places, reach_px = origin_px + shift_px, GATE * self._pitch
        pairing = self._judge(places, spots_px, _mutual(places, spots_px, reach_px=reach_px), origin_px)
        steps = self.predict(pairing.step_px, pairing.paired)
        places = np.where(np.isfinite(steps), origin_px + steps, places)
        return self._judge(places, spots_px, _mutual(places, spots_px, reach_px=reach_px), origin_px)

    def _judge(self, predicted_px: Places, spots_px: Spots, spot: Matches, from_px: Places) -> Pairing:
        """Drop spots that do not lead back, and measure how well the others agree."""
        step = np.full(predicted_px.shape, np.nan)
        step[spot >= 0] = spots_px[spot[spot >= 0]] - from_px[spot >= 0]
        expected_step = self.predict(step, np.all(np.isfinite(step), axis=1))
        error = np.linalg.norm(step - expected_step, axis=1)
        astray = error > GATE * self._pitch
        spot, step = np.where(astray, -1, spot), np.where(astray[:, None], np.nan, step)
        usable = np.isfinite(error) & ~astray
        error, expected_step = error[usable], expected_step[usable]
        bend = np.linalg.norm(expected_step - np.median(expected_step, axis=0), axis=1) if len(error) else error
        bent = float(np.quantile(error, 0.25)) if len(error) else np.inf
        far = np.array([self._size[1] - 1, self._size[0] - 1])
        expected = np.all((predicted_px >= 0) & (predicted_px <= far), axis=1)
        return Pairing(
            spot=spot,
            support=float((expected & (spot >= 0)).sum() / max(1, expected.sum())),
            spread_px=min(bent, _from_commonest(step[np.all(np.isfinite(step), axis=1)])),
            alike=int((error < _CLEAN_PX + _BENT_SHARE * bend).sum()),
            step_px=step,
        )

    def drop_strays(self, shift_px: Places, sound: Chosen) -> tuple[Chosen, Places]:
        """Drop markers that stray from their neighbours, the worst first: a stray makes its neighbours look astray.

        Returns the sound markers, and the displacement of each as they predict it.
        """
        while True:
            predicted = self.predict(shift_px, sound)
            error = np.where(sound, np.linalg.norm(shift_px - predicted, axis=1), np.nan)
            usual = np.nanmedian(error) if np.isfinite(error).any() else np.inf
            excess = np.nan_to_num(error / np.maximum(_STRAY_PITCHES * self._pitch, _STRAY_SPREADS * usual))
            if excess.max() <= 1:
                return sound, predicted
            # several at a time where they are not neighbours
            sound = sound & ~((excess > 1) & (excess >= excess[self._near].max(axis=1)))

    def drop_contradicting(self, shift_px: Places, sound: Chosen) -> Chosen:
        """Drop groups that agree among themselves but contradict the largest group.

        A part of a grid that moved by most of a pitch is matched wrongly as a whole: no marker in it strays from the
        next. But where it meets the rest, the skin would have to be torn or folded.
        """
        from scipy.sparse import coo_array  # noqa: PLC0415 (takes a quarter of a second, and predictions need none)
        from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

        both = sound[:, None] & sound[self._near]
        apart = np.linalg.norm(self._offset, axis=-1)
        relative = np.linalg.norm(shift_px[self._near] - shift_px[:, None], axis=-1) / self._pitch[:, None]
        against = both & (relative > _STRAIN * apart) & (apart < _NEAR)
        if not against.any():
            return sound
        joined = both & (relative < _ALIKE) & (apart < _ADJACENT)
        ends = np.nonzero(joined)[0], self._near[joined]
        # bonds hold both ways
        _, label = connected_components(coo_array((joined[joined], ends), shape=(len(sound),) * 2), directed=False)
        main = label == np.bincount(label[sound]).argmax()
        rows, columns = np.nonzero(against)
        others = self._near[rows, columns]
        apart_from_main = main[rows] != main[others]
        wrong = label[np.concatenate([rows[apart_from_main], others[apart_from_main]])]
        return sound & (main | ~np.isin(label, wrong))

    def match_left_over(self, spot: Matches, sound: Chosen, predicted_px: Places, spots_px: Spots) -> Matches:
        """Match markers that are not sound with free spots, outwards from the sound ones.

        Where the skin moves more than half a pitch in one step, the nearest spot is the next marker's. Neighbours still
        move alike: sound markers predict the places of those next to them, which then predict further ones.
        """
        matched, spot = sound.copy(), np.where(sound, spot, -1)
        shift = np.full_like(self._rest, np.nan)
        shift[sound] = spots_px[spot[sound]] - self._rest[sound]
        for _ in range(_ROUNDS):
            free = np.setdiff1d(np.arange(len(spots_px)), spot[matched])
            unmatched = np.flatnonzero(~matched & np.all(np.isfinite(predicted_px), axis=1))
            if not len(free) or not len(unmatched):
                break
            places = self._rest[unmatched] + predicted_px[unmatched]
            nearest = _mutual(places, spots_px[free], reach_px=GATE * self._pitch[unmatched])
            taken = unmatched[nearest >= 0]
            if not len(taken):
                break
            spot[taken], matched[taken] = free[nearest[nearest >= 0]], True
            shift[taken] = spots_px[spot[taken]] - self._rest[taken]
            predicted_px = self.predict(shift, matched)
        return spot


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
    """Find the spot of each marker that is nearest to it, and it to the spot, within reach; -1 for none."""
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


def _stands_out(match: Pairing, tried: list[Pairing], *, share: float, rivals: float) -> bool:
    """Check that a share of the markers moves with their neighbours, and fewer in every other match."""
    fewest, most = max(_FEW, share * match.paired.sum()), rivals * match.alike
    return bool(match.alike >= fewest) and all(other.alike <= most for other in tried if _differs(other, match))


def _differs(first: Pairing, second: Pairing) -> bool:
    """Check that two matches give most markers different spots."""
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
