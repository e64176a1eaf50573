"""What a running sensor gives: frames, and for each a reading with its health."""

from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import TypeAlias

import numpy as np
from jaxtyping import UInt8

from sliplens.images import shrink
from sliplens.recordings.capture import Forces, Frame
from sliplens.recordings.trial import ContactState

SmallPicture: TypeAlias = UInt8[np.ndarray, "rows columns 3"]
_SMALL_PX = 224


def small_factor(size: tuple[int, ...]) -> int:
    """How many times smaller `small_picture` makes a frame of a size (height, width), in pixels."""
    return max(1, min(size[:2]) // _SMALL_PX)


def small_picture(image: Frame) -> SmallPicture:
    """Picture of 224 to 448 pixels, in which limits in pixels mean the same for every camera; means of blocks."""
    return shrink(image, small_factor(image.shape))


@dataclass(frozen=True, kw_only=True)
class LiveFrame:
    """One frame of a running source."""

    image: Frame
    number: int
    """Count of the source itself, so that a gap tells of frames that were lost before they came here."""
    time_s: float
    """On the clock of the source."""
    captured_s: float
    """When it was captured, as `time.monotonic` counts."""
    decode_ms: float = 0.0
    """Time that decoding took, in milliseconds."""
    forces: Forces | None = None
    """Samples of a force sensor since the frame before, on the clock of the source; None where there is none."""
    safety_margin: float | None = None
    """True margin, where the source knows it: a simulated fingertip, or a labelled trial."""

    @property
    def size(self) -> tuple[int, int]:
        """Height and width, in pixels."""
        return self.image.shape[0], self.image.shape[1]

    @cached_property
    def small(self) -> SmallPicture:
        """What `small_picture` makes of it, made once for all who look at the picture as a whole."""
        return small_picture(self.image)


@dataclass(frozen=True, kw_only=True)
class Latency:
    """Where the time between a frame and its reading went, in milliseconds."""

    decode_ms: float = 0.0
    """From the bytes of the camera to pixels; a replayed frame is decoded before it is due."""
    checks_ms: float = 0.0
    """Following the markers, and the checks of the frame's health."""
    encode_ms: float = 0.0
    """From pixels to the network's input."""
    network_ms: float = 0.0
    """From the network's input to its answer, but for the checks that were made meanwhile."""
    total_ms: float = 0.0
    """From the capture to the reading, waiting included."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """One number of a frame's health, in pixels, grey levels, seconds or as a share, against its limit."""

    name: str
    value: float
    """What was measured, in its unit: pixels, grey levels, seconds, or a share."""
    limit: float
    """Bound of the healthy values, in the same unit."""
    ok: bool
    sentence: str
    """What is wrong, with the cure; what was measured where nothing is wrong."""


class SlipState(StrEnum):
    """What the motion of the markers tells."""

    SLIP = "slip"
    STICKING = "sticking"
    CANNOT_TELL = "cannot tell"


@dataclass(frozen=True, kw_only=True)
class MarkerReading:
    """What the markers of one frame tell without any network."""

    state: SlipState
    contact: bool | None = None
    """Whether something touches; None while that cannot be told."""
    shear_px: float | None = None
    """Mean motion of the contact's middle since it was pressed, in pixels; None without a contact."""
    stick_share: float | None = None
    """Share of the contact's markers that move with its middle, from 0 to 1; None without a contact."""
    slipping_s: float | None = None
    """Time since the slip began, as the markers tell it afterwards; None where there is none."""
    slipped_s: float | None = None
    """Time since a slip began, in the one frame in which it is confirmed: the load is still there, and was not let go.
    Confirmed slips teach friction."""


NO_NETWORK = "no network, so no margin is read; name one with --network"
"""What is told where no network reads."""


@dataclass(frozen=True, kw_only=True)
class Reading:
    """What a running sensor tells at one frame; margins are from 0 to 1, 1 sticks fully, 0 slips.

    `margin`, `low` and `high` are None without a network, and where `withheld` says why they are not to be believed.
    """

    number: int
    """Frame, as its source counts; -1 where none has come yet."""
    time_s: float
    """Time of the frame on the clock of its source."""
    captured_s: float
    """When the frame was captured, as `time.monotonic` counts."""
    margin: float | None = None
    low: float | None = None
    """Lower end of the interval that holds the true margin with 90 % confidence, in margin units; None of a network
    that was never calibrated."""
    high: float | None = None
    """Upper end of it, in margin units."""
    ratio: float | None = None
    """Traction ratio F_t / F_n, of a network that tells it."""
    friction: str | None = None
    """Coefficient of friction that the margin was read with, in words; None where none was told."""
    sequence: bool = False
    """Whether the margin was read in order: what the frames of the contact before this one told counts too."""
    risk: float | None = None
    """Chance that the margin is off by more than 0.2, from all of health and the network's own spread
    (`margin_risk`); None without a margin."""
    lag_s: float = 0.0
    """Delay of margin and interval by smoothing; 0 without."""
    contact_state: ContactState = ContactState.UNKNOWN
    slip: SlipState | None = None
    """What the markers tell; None where they are not followed."""
    markers: MarkerReading | None = None
    """What else the markers tell; None where they are not followed."""
    health: tuple[Check, ...] = ()
    """Checks of the frame; empty where health is not watched."""
    withheld: str | None = None
    """Why a network tells no margin, with the cure; None where it tells one, or there is no network."""
    latency: Latency = Latency()
    dropped: int = 0
    """Frames since the start that were captured, or counted by the source, and never read."""
    true_margin: float | None = None
    """Where the source knows it, to compare with."""

    def __str__(self) -> str:
        told = NO_NETWORK if self.withheld is None else f"no margin: {self.withheld}"
        if self.margin is not None:
            told = f"margin {self.margin:4.0%}"
            if self.low is not None and self.high is not None:
                told += f" ({self.low:.0%} to {self.high:.0%})"
        return f"{self.time_s:8.2f} s  {told}  {self.latency.total_ms:.0f} ms, {self.dropped} dropped"


__all__ = ["Check", "Latency", "LiveFrame", "MarkerReading", "Reading", "SlipState"]
