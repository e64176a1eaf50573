"""Markers that the reference frame does not show."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from sliplens.markers.detect import Markers
from sliplens.markers.tracks import MarkerStatus

_STEADY_FRAMES = 3  # in a row, before a spot counts as a marker: specks come and go
_REACH = 0.3  # pitches, between two frames
_CLEAR = 0.5  # pitches, from where a known marker should be


@dataclass(frozen=True, kw_only=True)
class NewPlaces:
    """New markers of one frame, in the order they came."""

    place_px: Float[np.ndarray, "new 2"]
    radius_px: Float[np.ndarray, " new"]
    status: UInt8[np.ndarray, " new"]


class Newcomers:
    """Spots that no known marker accounts for, until they have stayed long enough to be markers.

    Parameters
    ----------
    pitch_px
        Typical distance of two markers.
    """

    def __init__(self, *, pitch_px: float) -> None:
        self._pitch = pitch_px
        self._known = np.zeros((0, 2))
        self._waiting: list[tuple[np.ndarray, int]] = []

    def forget(self) -> int:
        """Forget those that wait, after a jump; gives the number of known ones."""
        self._waiting = []
        return len(self._known)

    def update(self, spare: Markers, expected_px: Float[np.ndarray, "markers 2"]) -> NewPlaces:
        """Follow the new markers and admit more.

        Parameters
        ----------
        spare
            Spots of the frame that no marker of the reference took.
        expected_px
            Where the markers of the reference are, or should be: a spot near one may be its remains.
        """
        place, radius = np.full(self._known.shape, np.nan), np.full(len(self._known), np.nan)
        free = np.ones(len(spare), dtype=bool)
        for index, known in enumerate(self._known):
            distance = np.where(free, np.linalg.norm(spare.centre_px - known, axis=1), np.inf)
            if len(distance) and distance.min() < _REACH * self._pitch:
                at = int(distance.argmin())
                place[index], radius[index], free[at] = spare.centre_px[at], spare.radius_px[at], False
        seen = np.all(np.isfinite(place), axis=1)
        self._known = np.where(seen[:, None], place, self._known)
        waiting = []
        for at in np.flatnonzero(free):
            spot = spare.centre_px[at]
            others = np.concatenate([expected_px, self._known])
            if np.linalg.norm(others - spot, axis=1).min() < _CLEAR * self._pitch:
                continue
            age = max(
                (age for old, age in self._waiting if np.linalg.norm(old - spot) < _REACH * self._pitch), default=0
            )
            if age + 1 < _STEADY_FRAMES:
                waiting.append((spot, age + 1))
                continue
            self._known = np.concatenate([self._known, spot[None]])
            place, radius = np.concatenate([place, spot[None]]), np.append(radius, spare.radius_px[at])
        self._waiting = waiting
        seen = np.all(np.isfinite(place), axis=1)
        status = np.where(seen, MarkerStatus.NEW, MarkerStatus.MISSING).astype(np.uint8)
        return NewPlaces(place_px=place, radius_px=radius, status=status)
