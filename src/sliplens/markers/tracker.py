"""Tracking of markers from the untouched sensor through a trial."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from sliplens.errors import ImageError, RecordingError
from sliplens.markers.detect import MarkerKind, Markers, detect_markers
from sliplens.markers.linking import Usual, drop_contradicting, drop_strays, find_neighbours, link, match_left_over
from sliplens.markers.tracks import MarkerStatus, TrackedFrame, Tracks, stack_tracks

_STEADY_FRAMES = 3  # in a row, before a spot counts as a marker: specks come and go
_REACH = 0.3  # pitches, between two frames
_CLEAR = 0.5  # pitches, from where a known marker should be


class Newcomers:
    """Spots outside the reference pattern, and those of them that stayed long enough to be markers."""

    def __init__(self, *, pitch_px: float, size: tuple[int, int]) -> None:
        self._pitch, self._size = pitch_px, size
        self._places = np.zeros((0, 2))
        self._candidates: list[tuple[np.ndarray, int]] = []

    def forget(self) -> int:
        """Forget the candidates after a jump; gives the number of new markers."""
        self._candidates = []
        return len(self._places)

    def update(self, spare: Markers, expected_px: Float[np.ndarray, "markers 2"]) -> TrackedFrame:
        """Follow the new markers, in order of appearance, and admit more from the unmatched spots.

        A spot near a marker of the reference, or near its expected place, may be its remains.
        """
        place, radius = np.full(self._places.shape, np.nan), np.full(len(self._places), np.nan)
        free = np.ones(len(spare), dtype=bool)
        for index, last in enumerate(self._places):
            distance = np.where(free, np.linalg.norm(spare.centre_px - last, axis=1), np.inf)
            if len(distance) and distance.min() < _REACH * self._pitch:
                at = int(distance.argmin())
                place[index], radius[index], free[at] = spare.centre_px[at], spare.radius_px[at], False
        self._places = np.where(np.isfinite(place), place, self._places)
        candidates = []
        for at in np.flatnonzero(free):
            spot = spare.centre_px[at]
            others = np.concatenate([expected_px, self._places])
            if np.linalg.norm(others - spot, axis=1).min() < _CLEAR * self._pitch:
                continue
            ages = [age for old, age in self._candidates if np.linalg.norm(old - spot) < _REACH * self._pitch]
            age = 1 + max(ages, default=0)
            if age < _STEADY_FRAMES:
                candidates.append((spot, age))
                continue
            self._places = np.concatenate([self._places, spot[None]])
            place, radius = np.concatenate([place, spot[None]]), np.append(radius, spare.radius_px[at])
        self._candidates = candidates
        status = np.where(np.isfinite(place[:, 0]), MarkerStatus.NEW, MarkerStatus.MISSING).astype(np.uint8)
        missing = np.full_like(place, np.nan)
        return TrackedFrame(
            position_px=place,
            motion_px=missing,
            size=self._size,
            radius_px=radius,
            deviation_px=missing[:, 0],
            status=status,
        )


_FEWEST = 4
_RADIUS_CHANGE = (0.6, 1.6)  # of the radius at rest, over the median change of all markers
_CONTRAST_LEFT = 0.45
_ROUNDNESS_LEFT, _ROUND = 0.75, 0.7


class Tracker:
    """Tracker of one sensor's markers, frame by frame."""

    def __init__(self, reference: UInt8[np.ndarray, "height width 3"], kind: str | MarkerKind = "auto") -> None:
        detected = detect_markers(reference, kind)
        self.rest = detected.only(detected.whole)
        if len(self.rest) < _FEWEST:
            raise ImageError(
                f"the reference shows {len(self.rest)} whole markers, at least {_FEWEST} are needed; name another kind"
            )
        height, width, _ = reference.shape
        self._size = height, width
        self._neighbours = find_neighbours(self.rest.centre_px)
        self._shift = np.zeros_like(self.rest.centre_px)
        self._usual, self._lost = Usual(), False
        self._newcomers = Newcomers(pitch_px=float(np.median(self._neighbours.pitch_px)), size=self._size)

    def update(self, frame: UInt8[np.ndarray, "_ _ 3"]) -> TrackedFrame:
        """Follow the markers into the next frame T_n, of the reference's size."""
        if frame.shape[:2] != self._size:
            raise ImageError(
                f"frame of {frame.shape[0]} x {frame.shape[1]} pixels against a reference of {self._size[0]} x "
                f"{self._size[1]}; record the reference with the same camera settings"
            )
        detected = detect_markers(frame, appearance=self.rest.appearance)
        rest = self.rest.centre_px
        pairing = link(
            [rest + self._shift, rest] if self._lost else [rest + self._shift],
            detected.centre_px,
            neighbours=self._neighbours,
            size=self._size,
            usual=self._usual,
            lost=self._lost,
        )
        self._lost = pairing is None
        if pairing is None:
            count = len(rest) + self._newcomers.forget()
            place, status = np.full((count, 2), np.nan), np.full(count, MarkerStatus.LOST, dtype=np.uint8)
            return TrackedFrame(
                position_px=place,
                motion_px=place,
                size=self._size,
                radius_px=place[:, 0],
                deviation_px=place[:, 0],
                status=status,
            )
        self._usual = self._usual.after(pairing)
        return self._update_status(detected, pairing.spot)

    def _update_status(self, detected: Markers, spot: Int[np.ndarray, " markers"]) -> TrackedFrame:
        rest = self.rest.centre_px
        shift, changed, cut, sound, predicted = self._select_sound(detected, spot)
        if not sound.all():
            spot = match_left_over(
                self._neighbours, spot, sound | changed | cut, predicted, rest_px=rest, spots_px=detected.centre_px
            )
            shift, _, cut, sound, predicted = self._select_sound(detected, spot)
        place = rest + shift
        deviation = np.linalg.norm(shift - predicted, axis=1)
        status = np.full(len(rest), MarkerStatus.MISSING, dtype=np.uint8)
        status[spot >= 0] = MarkerStatus.BROKEN
        status[sound] = MarkerStatus.FOLLOWED
        # undetected markers move on with their neighbours, so that they are identified when they come back
        self._shift = np.where(sound[:, None], shift, np.where(np.isfinite(predicted), predicted, self._shift))
        status[cut | ((spot < 0) & self._leaves_view())] = MarkerStatus.OUTSIDE
        hidden = ~np.isin(status, (MarkerStatus.FOLLOWED, MarkerStatus.BROKEN))
        place[hidden] = np.nan
        spare = detected.whole & ~np.isin(np.arange(len(detected)), spot)
        new = self._newcomers.update(detected.only(spare), np.where(np.isfinite(place), place, rest + self._shift))
        return TrackedFrame(
            position_px=np.concatenate([place, new.position_px]),
            motion_px=np.concatenate([place - rest, new.motion_px]),
            size=self._size,
            radius_px=np.concatenate([np.where(hidden, np.nan, _at_spots(detected.radius_px, spot)), new.radius_px]),
            deviation_px=np.concatenate([np.where(hidden, np.nan, deviation), new.deviation_px]),
            status=np.concatenate([status, new.status]),
        )

    def _select_sound(self, detected: Markers, spot: Int[np.ndarray, " markers"]) -> tuple[np.ndarray, ...]:
        """Compare markers with their spots and neighbours."""
        paired = spot >= 0
        cut = np.zeros_like(paired)
        cut[paired] = ~detected.whole[spot[paired]]
        changed = paired & _changed(self.rest, detected, spot)
        shift = _at_spots(detected.centre_px, spot) - self.rest.centre_px
        sound = drop_contradicting(self._neighbours, shift, paired & ~changed & ~cut)
        return shift, changed, cut, *drop_strays(self._neighbours, shift, sound)

    def _leaves_view(self) -> Bool[np.ndarray, " markers"]:
        place, edge = self.rest.centre_px + self._shift, (self.rest.radius_px + 1.5)[:, None]
        far = np.array([self._size[1] - 1, self._size[0] - 1])
        return np.any((place < edge) | (place > far - edge), axis=1)


def track_markers(
    frames: Iterable[UInt8[np.ndarray, "_ _ 3"]],
    reference: UInt8[np.ndarray, "height width 3"],
    kind: str | MarkerKind = "auto",
) -> Tracks:
    """Track markers from the untouched sensor through a sequence of frames.

    Each marker keeps its identity of the reference frame. Every step is checked forwards (spot and marker must be
    nearest to each other) and backwards (moved back with its neighbours, a spot must lead to its marker's last place).
    After a jump the pattern is matched by its shape as a whole; where a regular grid fits in two ways, all markers are
    LOST until one fits better.

    Parameters
    ----------
    frames
        T_1 to T_n, uint8 RGB (height, width, 3), of the reference's size.
    reference
        The untouched sensor T_0.
    kind
        Row of `KINDS`, or another `MarkerKind`.
    """
    tracker = Tracker(reference, kind)
    tracked = [tracker.update(frame) for frame in frames]
    if not tracked:
        raise RecordingError("there is no frame to track markers in; give one or more beside the reference")
    return stack_tracks(tracked, rest_px=tracker.rest.centre_px, rest_radius_px=tracker.rest.radius_px)


def _at_spots(values: np.ndarray, spot: Int[np.ndarray, " markers"]) -> np.ndarray:
    """Return the values of each marker's spot; NaN without one."""
    at_spots = np.full((len(spot), *values.shape[1:]), np.nan)
    at_spots[spot >= 0] = values[spot[spot >= 0]]
    return at_spots


def _changed(rest: Markers, detected: Markers, spot: Int[np.ndarray, " markers"]) -> Bool[np.ndarray, " markers"]:
    """Find markers that changed beyond the change of all markers."""
    low, high = _RADIUS_CHANGE
    radius, contrast = (
        ratio / np.nanmedian(ratio) if np.isfinite(ratio).any() else ratio
        for ratio in (
            _at_spots(getattr(detected, name), spot) / getattr(rest, name) for name in ("radius_px", "contrast")
        )
    )
    roundness = _at_spots(detected.roundness, spot)
    flat = (roundness < _ROUNDNESS_LEFT * rest.roundness) & (roundness < _ROUND)
    return (radius < low) | (radius > high) | (contrast < _CONTRAST_LEFT) | flat
