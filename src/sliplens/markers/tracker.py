"""Tracking of markers from the untouched sensor through a trial."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from sliplens.errors import ImageError, RecordingError
from sliplens.markers.detect import MarkerKind, Markers, detect_markers, measure_markers
from sliplens.markers.linking import Pairing, Pattern

_RADIUS_CHANGE = (0.6, 1.6)  # of the radius at rest, over the median change of all markers
_CONTRAST_LEFT = 0.45
_ROUNDNESS_LEFT, _ROUND = 0.75, 0.7
_WHOLE_EVERY = 10  # frames, of which one is searched as a whole


class MarkerStatus(IntEnum):
    """State of a marker in a frame; only followed markers have a displacement."""

    FOLLOWED = 0
    """Detected, and identified with a marker of the reference frame."""
    MISSING = 1
    """Should be in view but was not detected."""
    BROKEN = 2
    """Detected, but changed in size or shape, or astray from its neighbours: its centre is unreliable."""
    OUTSIDE = 3
    """Cut by the edge of the frame, or beyond it."""
    LOST = 4
    """The pattern jumped so far that markers cannot be identified."""


@dataclass(frozen=True, kw_only=True)
class Tracks:
    """Markers of a frame, or of consecutive frames; pixel coordinates are (x, y), pixel centres at whole numbers."""

    rest_px: Float[np.ndarray, "markers 2"]
    """Places in the reference frame T_0."""
    position_px: Float[np.ndarray, "*frames markers 2"]
    """NaN where a marker was not detected whole."""
    size: tuple[int, int]
    """Height and width of the picture, in pixels."""
    radius_px: Float[np.ndarray, "*frames markers"]
    deviation_px: Float[np.ndarray, "*frames markers"]
    """Distance of a marker's displacement from that of the skin around it; NaN where either is unknown."""
    status: UInt8[np.ndarray, "*frames markers"]
    """`MarkerStatus` of each."""

    @property
    def followed(self) -> Bool[np.ndarray, "*frames markers"]:
        """Markers that have a displacement."""
        return self.status == MarkerStatus.FOLLOWED

    @property
    def displacement_px(self) -> Float[np.ndarray, "*frames markers 2"]:
        """T_n less T_0, x and y; NaN where a marker was not followed."""
        return np.where(self.followed[..., None], self.position_px - self.rest_px, np.nan)


class Tracker:
    """Tracker of one sensor's markers, frame by frame."""

    def __init__(self, reference: UInt8[np.ndarray, "height width 3"], kind: str | MarkerKind = "auto") -> None:
        detected = detect_markers(reference, kind)
        self.rest = detected.only(detected.whole)
        height, width, _ = reference.shape
        self._size = height, width
        self._pattern = Pattern(self.rest.centre_px, size=self._size)
        self._shift, self._lost = np.zeros_like(self.rest.centre_px), False
        self._followed, self._since_whole = np.zeros(len(self.rest), dtype=bool), _WHOLE_EVERY
        place, unknown = self.rest.centre_px, np.full(len(self.rest), np.nan)
        self._unidentified = Tracks(
            rest_px=place, position_px=np.full_like(place, np.nan), size=self._size, radius_px=unknown,
            deviation_px=unknown, status=np.full(len(place), MarkerStatus.LOST, dtype=np.uint8),
        )  # fmt: skip

    def update(self, frame: UInt8[np.ndarray, "_ _ 3"]) -> Tracks:
        """Follow the markers into the next frame T_n, of the reference's size.

        Markers are measured around their last places. The whole frame is searched every tenth time, and at once where
        a marker that was followed is not found there or the step is not small and smooth.
        """
        if frame.shape[:2] != self._size:
            raise ImageError(
                f"frame of {frame.shape[0]} x {frame.shape[1]} pixels against a reference of {self._size[0]} x "
                f"{self._size[1]}; record the reference with the same camera settings"
            )
        rest = self.rest.centre_px
        detected, pairing = self._measure_near(frame) or self._search(frame)
        self._lost = pairing is None
        if pairing is None:
            self._since_whole = _WHOLE_EVERY
            return self._unidentified
        spot = pairing.spot
        shift, changed, cut, sound, predicted = self._select_sound(detected, spot)
        if not sound.all():
            certain = sound | changed | cut
            spot = self._pattern.match_left_over(spot, certain, predicted, detected.centre_px)
            shift, _, cut, sound, predicted = self._select_sound(detected, spot)
        status = np.full(len(rest), MarkerStatus.MISSING, dtype=np.uint8)
        status[spot >= 0] = MarkerStatus.BROKEN
        status[sound], self._followed = MarkerStatus.FOLLOWED, sound
        # undetected markers move on with their neighbours, so that they are identified when they come back
        self._shift = np.where(sound[:, None], shift, np.where(np.isfinite(predicted), predicted, self._shift))
        last, edge = rest + self._shift, (self.rest.radius_px + 1.5)[:, None]
        leaves = np.any((last < edge) | (last > np.array([self._size[1] - 1, self._size[0] - 1]) - edge), axis=1)
        status[cut | ((spot < 0) & leaves)] = MarkerStatus.OUTSIDE
        hidden = ~np.isin(status, (MarkerStatus.FOLLOWED, MarkerStatus.BROKEN))
        place, deviation = rest + shift, np.linalg.norm(shift - predicted, axis=1)
        radius = _at_spots(detected.radius_px, spot)
        place[hidden], radius[hidden], deviation[hidden] = np.nan, np.nan, np.nan
        return replace(self._unidentified, position_px=place, radius_px=radius, deviation_px=deviation, status=status)

    def _measure_near(self, frame: UInt8[np.ndarray, "_ _ 3"]) -> tuple[Markers, Pairing] | None:
        """Measure the markers around their last places; None where the whole frame must be searched."""
        if self._since_whole >= _WHOLE_EVERY - 1:
            return None
        places = self.rest.centre_px + self._shift
        detected, spot = measure_markers(frame, self.rest.appearance, places)
        pairing = self._pattern.accept(places, detected.centre_px, spot)
        self._pattern.note(pairing)
        if pairing is None or not pairing.paired[self._followed].all():
            return None
        self._since_whole += 1
        return detected, pairing

    def _search(self, frame: UInt8[np.ndarray, "_ _ 3"]) -> tuple[Markers, Pairing | None]:
        """Detect the markers of the whole frame, and identify them."""
        rest = self.rest.centre_px
        self._since_whole = 0
        detected = detect_markers(frame, appearance=self.rest.appearance)
        origins = [rest + self._shift, rest] if self._lost else [rest + self._shift]
        pairing = self._pattern.link(origins, detected.centre_px, lost=self._lost)
        self._pattern.note(pairing)
        return detected, pairing

    def _select_sound(self, detected: Markers, spot: Int[np.ndarray, " markers"]) -> tuple[np.ndarray, ...]:
        """Compare markers with their spots and neighbours."""
        paired = spot >= 0
        cut = np.zeros_like(paired)
        cut[paired] = ~detected.whole[spot[paired]]
        changed = paired & _changed(self.rest, detected, spot)
        shift = _at_spots(detected.centre_px, spot) - self.rest.centre_px
        sound = self._pattern.drop_contradicting(shift, paired & ~changed & ~cut)
        return shift, changed, cut, *self._pattern.drop_strays(shift, sound)


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
    names = ("position_px", "radius_px", "deviation_px", "status")
    return replace(tracked[0], **{name: np.stack([getattr(frame, name) for frame in tracked]) for name in names})


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
