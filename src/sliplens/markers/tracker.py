"""Following markers from the untouched sensor through a trial."""

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
    """Spots that no known marker accounts for, until they have stayed long enough to be markers."""

    def __init__(self, *, pitch_px: float, size: tuple[int, int]) -> None:
        self._pitch, self._size = pitch_px, size
        self._known = np.zeros((0, 2))
        self._waiting: list[tuple[np.ndarray, int]] = []

    def forget(self) -> int:
        """Forget those that wait, after a jump; gives the number of known ones."""
        self._waiting = []
        return len(self._known)

    def update(self, spare: Markers, expected_px: Float[np.ndarray, "markers 2"]) -> TrackedFrame:
        """Follow the new markers, in the order they came, and admit more of the spots that no other marker took.

        A spot near where a marker of the reference is, or should be, may be its remains.
        """
        place, radius = np.full(self._known.shape, np.nan), np.full(len(self._known), np.nan)
        free = np.ones(len(spare), dtype=bool)
        for index, known in enumerate(self._known):
            distance = np.where(free, np.linalg.norm(spare.centre_px - known, axis=1), np.inf)
            if len(distance) and distance.min() < _REACH * self._pitch:
                at = int(distance.argmin())
                place[index], radius[index], free[at] = spare.centre_px[at], spare.radius_px[at], False
        self._known = np.where(np.isfinite(place), place, self._known)
        waiting = []
        for at in np.flatnonzero(free):
            spot = spare.centre_px[at]
            others = np.concatenate([expected_px, self._known])
            if np.linalg.norm(others - spot, axis=1).min() < _CLEAR * self._pitch:
                continue
            ages = [age for old, age in self._waiting if np.linalg.norm(old - spot) < _REACH * self._pitch]
            age = 1 + max(ages, default=0)
            if age < _STEADY_FRAMES:
                waiting.append((spot, age))
                continue
            self._known = np.concatenate([self._known, spot[None]])
            place, radius = np.concatenate([place, spot[None]]), np.append(radius, spare.radius_px[at])
        self._waiting = waiting
        status = np.where(np.isfinite(place[:, 0]), MarkerStatus.NEW, MarkerStatus.MISSING).astype(np.uint8)
        unknown = np.full_like(place, np.nan)
        return TrackedFrame(
            position_px=place,
            motion_px=unknown,
            size=self._size,
            radius_px=radius,
            deviation_px=unknown[:, 0],
            status=status,
        )


_FEWEST = 4
_RADIUS_CHANGE = (0.6, 1.6)  # of its own at rest, over what all markers changed by
_CONTRAST_LEFT = 0.45
_ROUNDNESS_LEFT, _ROUND = 0.75, 0.7


class Tracker:
    """Follows the markers of one sensor, frame by frame, as `track_markers` does those of a whole trial."""

    def __init__(self, reference: UInt8[np.ndarray, "height width 3"], kind: str | MarkerKind = "auto") -> None:
        found = detect_markers(reference, kind)
        self.rest = found.only(found.whole)
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
        found = detect_markers(frame, appearance=self.rest.appearance)
        rest = self.rest.centre_px
        pairing = link(
            [rest + self._shift, rest] if self._lost else [rest + self._shift],
            found.centre_px,
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
        return self._judge(found, pairing.spot)

    def _judge(self, found: Markers, spot: Int[np.ndarray, " markers"]) -> TrackedFrame:
        rest = self.rest.centre_px
        shift, changed, cut, sound, told = self._believe(found, spot)
        if not sound.all():
            spot = match_left_over(
                self._neighbours, spot, sound | changed | cut, told, rest_px=rest, found_px=found.centre_px
            )
            shift, _, cut, sound, told = self._believe(found, spot)
        place = rest + shift
        deviation = np.linalg.norm(shift - told, axis=1)
        status = np.full(len(rest), MarkerStatus.MISSING, dtype=np.uint8)
        status[spot >= 0] = MarkerStatus.BROKEN
        status[sound] = MarkerStatus.FOLLOWED
        # what was not seen goes on as its neighbours do, so that it is known when it comes back
        self._shift = np.where(sound[:, None], shift, np.where(np.isfinite(told), told, self._shift))
        status[cut | ((spot < 0) & self._leaves_view())] = MarkerStatus.OUTSIDE
        hidden = ~np.isin(status, (MarkerStatus.FOLLOWED, MarkerStatus.BROKEN))
        place[hidden] = np.nan
        spare = found.whole & ~np.isin(np.arange(len(found)), spot)
        new = self._newcomers.update(found.only(spare), np.where(np.isfinite(place), place, rest + self._shift))
        return TrackedFrame(
            position_px=np.concatenate([place, new.position_px]),
            motion_px=np.concatenate([place - rest, new.motion_px]),
            size=self._size,
            radius_px=np.concatenate([np.where(hidden, np.nan, _taken(found.radius_px, spot)), new.radius_px]),
            deviation_px=np.concatenate([np.where(hidden, np.nan, deviation), new.deviation_px]),
            status=np.concatenate([status, new.status]),
        )

    def _believe(self, found: Markers, spot: Int[np.ndarray, " markers"]) -> tuple[np.ndarray, ...]:
        """Shift of each marker, whether its spot has changed too much to be measured, whether the edge cuts it, whether
        it may be believed, and its displacement as its neighbours tell it.
        """
        paired = spot >= 0
        cut = np.zeros_like(paired)
        cut[paired] = ~found.whole[spot[paired]]
        changed = paired & _changed(self.rest, found, spot)
        shift = _taken(found.centre_px, spot) - self.rest.centre_px
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
    """Follow markers from the untouched sensor through a sequence of frames.

    Each marker keeps the identity it has in the reference frame. Every step is checked forwards (a spot belongs to the
    marker that is nearest, and the marker to the spot) and backwards (moved back as its neighbours moved, a spot must
    lead to where its own marker was). After a jump the pattern is found anew by its shape as a whole; where a regular
    grid fits in two ways, all markers are LOST until it can be told again.

    Parameters
    ----------
    frames
        T_1 to T_n, uint8 RGB (height, width, 3), of the reference's size.
    reference
        The untouched sensor T_0.
    kind
        Row of `KINDS`, or a kind of one's own.

    Raises
    ------
    ImageError
        If the reference is over- or underexposed or shows fewer than 4 whole markers, or a frame has another size.
    RecordingError
        If there is no frame.
    """
    tracker = Tracker(reference, kind)
    tracked = [tracker.update(frame) for frame in frames]
    if not tracked:
        raise RecordingError("there is no frame to follow markers into; give one or more beside the reference")
    return stack_tracks(tracked, rest_px=tracker.rest.centre_px, rest_radius_px=tracker.rest.radius_px)


def _taken(values: np.ndarray, spot: Int[np.ndarray, " markers"]) -> np.ndarray:
    """Values of each marker's spot; NaN without one."""
    taken = np.full((len(spot), *values.shape[1:]), np.nan)
    taken[spot >= 0] = values[spot[spot >= 0]]
    return taken


def _changed(rest: Markers, found: Markers, spot: Int[np.ndarray, " markers"]) -> Bool[np.ndarray, " markers"]:
    """Markers that differ from what they were, beyond what all of them do."""
    low, high = _RADIUS_CHANGE
    radius, contrast = (
        ratio / np.nanmedian(ratio) if np.isfinite(ratio).any() else ratio
        for ratio in (_taken(found.radius_px, spot) / rest.radius_px, _taken(found.contrast, spot) / rest.contrast)
    )
    roundness = _taken(found.roundness, spot)
    flat = (roundness < _ROUNDNESS_LEFT * rest.roundness) & (roundness < _ROUND)
    return (radius < low) | (radius > high) | (contrast < _CONTRAST_LEFT) | flat
