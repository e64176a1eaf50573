"""Markers followed through a trial."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float, UInt8


class MarkerStatus(IntEnum):
    """Knowledge of a marker in a frame; only what was followed has a displacement."""

    UNSEEN = 0
    """Not there yet: a marker that appears later."""
    FOLLOWED = 1
    """Seen, and the same as in the reference frame."""
    MISSING = 2
    """Should be in view but was not found."""
    BROKEN = 3
    """Seen, but its size or shape has changed, or it strays from its neighbours: its centre is not to be relied on."""
    OUTSIDE = 4
    """Cut by the edge of the frame, or beyond it."""
    LOST = 5
    """The pattern jumped so far that no marker can be told from the next."""
    NEW = 6
    """Seen, but not in the reference frame: it has a place and no displacement."""


@dataclass(frozen=True, kw_only=True)
class TrackedFrame:
    """Markers of one frame, in the order of the reference frame, new ones after them."""

    position_px: Float[np.ndarray, "markers 2"]
    """x, y; NaN where a marker was not seen whole."""
    radius_px: Float[np.ndarray, " markers"]
    deviation_px: Float[np.ndarray, " markers"]
    """Distance of a marker's displacement from that of the skin around it; NaN where either is not known."""
    status: UInt8[np.ndarray, " markers"]
    """`MarkerStatus` of each."""


@dataclass(frozen=True, kw_only=True)
class Tracks:
    """Markers of a trial; pixel coordinates are (x, y), pixel centres at whole numbers."""

    rest_px: Float[np.ndarray, "markers 2"]
    """Places in the reference frame T_0; NaN for markers that it does not show."""
    rest_radius_px: Float[np.ndarray, " markers"]
    position_px: Float[np.ndarray, "frames markers 2"]
    """NaN where a marker was not seen whole."""
    radius_px: Float[np.ndarray, "frames markers"]
    deviation_px: Float[np.ndarray, "frames markers"]
    status: UInt8[np.ndarray, "frames markers"]

    def __len__(self) -> int:
        return len(self.status)

    @property
    def followed(self) -> Bool[np.ndarray, "frames markers"]:
        """Markers that have a displacement, frame by frame."""
        return self.status == MarkerStatus.FOLLOWED

    @property
    def displacement_px(self) -> Float[np.ndarray, "frames markers 2"]:
        """T_n less T_0, x and y; NaN where a marker was not followed."""
        return np.where(self.followed[..., None], self.position_px - self.rest_px, np.nan)

    @property
    def from_reference(self) -> Bool[np.ndarray, " markers"]:
        """Markers that the reference frame shows."""
        return np.all(np.isfinite(self.rest_px), axis=1)


def stack_tracks(
    frames: list[TrackedFrame],
    *,
    rest_px: Float[np.ndarray, "markers 2"],
    rest_radius_px: Float[np.ndarray, " markers"],
) -> Tracks:
    """Join the frames of a trial; markers that came later are unseen before."""
    count = max(len(frame.status) for frame in frames)

    def padded(values: np.ndarray) -> np.ndarray:
        missing = [(0, count - len(values)), *((0, 0) for _ in values.shape[1:])]
        return np.pad(values, missing, constant_values=np.nan if values.dtype.kind == "f" else MarkerStatus.UNSEEN)

    joined = {name: np.stack([padded(getattr(frame, name)) for frame in frames]) for name in vars(frames[0])}
    return Tracks(rest_px=padded(rest_px), rest_radius_px=padded(rest_radius_px), **joined)
