"""Frames of a running sensor, and their readings."""

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


def small_picture(image: Frame) -> SmallPicture:
    """Reduce a frame to 224 to 448 pixels by block means, so that limits in pixels suit every camera."""
    return shrink(image, max(1, min(image.shape[:2]) // _SMALL_PX))


@dataclass(frozen=True, kw_only=True)
class LiveFrame:
    """One frame of a running source."""

    image: Frame
    number: int
    """Count of the source itself, so that a gap shows lost frames."""
    time_s: float
    """Time on the clock of the source."""
    captured_s: float
    """Time of the capture, as `time.monotonic` counts."""
    decode_ms: float = 0.0
    """Time that decoding took, in milliseconds."""
    forces: Forces | None = None
    """Samples of a force sensor since the frame before, on the clock of the source; None where there is none."""
    safety_margin: float | None = None
    """True margin, of a simulated fingertip or a labelled trial."""

    @property
    def size(self) -> tuple[int, int]:
        """Height and width, in pixels."""
        return self.image.shape[0], self.image.shape[1]

    @cached_property
    def small(self) -> SmallPicture:
        """Reduced picture (`small_picture`), made once."""
        return small_picture(self.image)


@dataclass(frozen=True, kw_only=True)
class Latency:
    """Parts of the time between a frame and its reading, in milliseconds."""

    decode_ms: float = 0.0
    """From the bytes of the camera to pixels; a replayed frame is decoded before it is due."""
    checks_ms: float = 0.0
    """Tracking of the markers, and the checks of the frame's health."""
    encode_ms: float = 0.0
    """From pixels to the network's input."""
    network_ms: float = 0.0
    """From the network's input to its output, without the checks that ran meanwhile."""
    total_ms: float = 0.0
    """From the capture to the reading, waiting included."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """One number of a frame's health, in pixels, grey levels, seconds or as a share, against its limit."""

    name: str
    value: float
    """Measured value in its unit: pixels, grey levels, seconds, or a share."""
    limit: float
    """Bound of the healthy values, in the same unit."""
    ok: bool
    sentence: str
    """Statement of the measured value, and the cure where the check fails."""
    age_s: float = 0.0
    """Time since the frame that was measured, in seconds: some checks take turns."""


class SlipState(StrEnum):
    """Slip as the markers show it."""

    SLIP = "slip"
    STICKING = "no full slip"
    """The contact as a whole does not slide; its rim may (incipient slip)."""
    WILL_SLIP = "will slip"
    """It does not slide, but its margin is below `TARGET`, with the whole interval."""
    CANNOT_TELL = "cannot tell"


@dataclass(frozen=True, kw_only=True)
class MarkerReading:
    """Contact and slip as the markers of one frame show them."""

    state: SlipState
    contact: bool | None = None
    """True where something touches; None while that is unknown."""
    shear_px: float | None = None
    """Mean motion of the contact's middle since it was pressed, in pixels; None without a contact."""
    stick_share: float | None = None
    """Share of the contact's markers that move with its middle, from 0 to 1; None without a contact."""
    slipping_s: float | None = None
    """Time since the slip began; None where there is none."""
    slipped_s: float | None = None
    """Time since a slip began, in the one frame that confirms it: the load was not let go. Confirmed slips teach
    friction."""
    fall: float | None = None
    """Share of its largest value that the mean shear has lost, from 0 to 1, of a grasp that begins pressed."""


NO_NETWORK = "no network, so no margin is predicted; name one with --network"
"""Advice where there is no network."""


@dataclass(frozen=True, kw_only=True)
class Reading:
    """Margin, contact and health at one frame; margins are from 0 to 1, 1 sticks fully, 0 slips.

    `margin`, `low` and `high` are None without a network, and where `withheld` says why.
    """

    number: int
    """Number of the frame, as its source counts; -1 before the first."""
    time_s: float
    """Time of the frame on the clock of its source."""
    captured_s: float
    """Time of the capture, as `time.monotonic` counts."""
    margin: float | None = None
    low: float | None = None
    """Lower end of the 90 % interval, in margin units; None of a network that was never calibrated."""
    high: float | None = None
    """Upper end of it, in margin units."""
    ratio: float | None = None
    """Traction ratio F_t / F_n, of a network that predicts it."""
    friction: str | None = None
    """Coefficient of friction that the margin assumes, in words; None where none was set."""
    risk: float | None = None
    """Chance that the margin is off by more than 0.2 (`margin_risk`); None without a margin."""
    contact_state: ContactState = ContactState.UNKNOWN
    slip: SlipState | None = None
    """Slip as the markers show it; None where they are not tracked."""
    markers: MarkerReading | None = None
    """Reading of the markers; None where they are not tracked."""
    health: tuple[Check, ...] = ()
    """Checks of the frame; empty without a health monitor."""
    withheld: str | None = None
    """Why there is no margin, with the cure; None where there is one, or no network."""
    latency: Latency = Latency()
    dropped: int = 0
    """Number of frames since the start that were lost or never read."""
    true_margin: float | None = None
    """True margin, where the source has it."""

    def __str__(self) -> str:
        words = describe_reading(self)
        return f"{self.time_s:8.2f} s  {words}; {self.latency.total_ms:.0f} ms, {self.dropped} dropped"


TARGET = 0.2, 0.4
"""Margins at which people hold objects."""
OFF = 0.2
"""Error from which on a margin is off."""
_RISK, _DOUBT = 0.1, 0.5
"""Limits of `Reading.risk`, the chance of an error above `OFF`. Beyond the first, the share of margins outside a 90 %
interval, the margin counts as uncertain by `OFF`; beyond the second it is more likely wrong than right."""


class Zone(StrEnum):
    """Where the interval of a margin lies against `TARGET`."""

    NONE = "none"
    BELOW = "below"
    UNCERTAIN = "uncertain"
    WITHIN = "within"
    NOT_BELOW = "not below"
    ABOVE = "above"


_ADVICE = {
    Zone.BELOW: "close to slipping: hold tighter",
    Zone.UNCERTAIN: "cannot tell: may be close to slipping",
    Zone.WITHIN: "in the target zone",
    Zone.NOT_BELOW: "not close to slipping",
    Zone.ABOVE: "holds tighter than it needs to",
}


@dataclass(frozen=True, kw_only=True)
class ReadingWords:
    """A reading in words, the same on every screen and in every message."""

    zone: Zone
    advice: str
    """Meaning for a grip, or why there is no margin."""
    margin: str
    """Margin in percent; empty where there is none."""
    interval: str
    """Both ends of the interval in percent, and the risk where the interval understates it; empty without."""
    contact: ContactState
    """State of the contact where interval and markers agree; else unknown."""

    def __str__(self) -> str:
        interval = f" ({self.interval})" if self.interval else ""
        return f"margin {self.margin}{interval}; {self.advice}" if self.margin else self.advice


def describe_reading(reading: Reading) -> ReadingWords:
    """Describe a reading by its interval, risk and markers, not by the margin alone.

    Examples
    --------
    >>> from sliplens.live.reading import Reading, describe_reading
    >>> reading = Reading(number=0, time_s=0.0, captured_s=0.0, margin=0.55, low=0.15, high=0.9)
    >>> print(describe_reading(reading))
    margin 55 % (15 to 90 %); cannot tell: may be close to slipping
    """
    low, high, risk = 0.0, 1.0, reading.risk or 0.0
    margin = interval = ""
    doubtful, slips = risk > _DOUBT, reading.slip is SlipState.SLIP
    if reading.margin is not None:
        margin = f"{100 * reading.margin:.0f} %"
        if reading.low is not None and reading.high is not None:
            low, high = round(reading.low, 2), round(reading.high, 2)
            interval = f"{100 * low:.0f} to {100 * high:.0f} %"
            if risk > _RISK:  # more than the interval states
                stated = _zone(low, high)
                low = round(min(reading.low, max(reading.margin - OFF, 0.0)), 2)
                high = round(max(reading.high, min(reading.margin + OFF, 1.0)), 2)
                if _zone(low, high) is not stated:
                    interval += f", but {100 * OFF:.0f} points off with a chance of {100 * risk:.0f} %"
    zone = _zone(low, high)
    rules = (
        (reading.withheld is not None, Zone.NONE, f"no margin: {reading.withheld}"),
        (slips and zone in {Zone.BELOW, Zone.UNCERTAIN}, Zone.BELOW, "slips, as the markers show: hold tighter"),
        (slips, Zone.UNCERTAIN, "cannot tell: the markers show a slip, the margin does not"),
        (reading.margin is None, Zone.NONE, NO_NETWORK),
        (reading.low is None, Zone.UNCERTAIN, "cannot tell: the network was never calibrated, and gives no interval"),
        (doubtful, Zone.UNCERTAIN, "cannot tell: the margin is more likely wrong than right"),
        (True, zone, _ADVICE[zone]),
    )
    zone, advice = next((then, words) for applies, then, words in rules if applies)
    touches = reading.margin is not None or (reading.markers is not None and reading.markers.contact)
    agree = reading.withheld is None and touches and not (zone is Zone.UNCERTAIN if slips else doubtful)
    states = (
        (reading.contact_state == ContactState.NO_CONTACT, ContactState.NO_CONTACT),
        (not agree, ContactState.UNKNOWN),
        (slips, ContactState.FULL_SLIP),
        (low > 0 and high < 1, ContactState.INCIPIENT_SLIP),
        (True, ContactState.CONTACT),
    )
    contact = next(state for applies, state in states if applies)
    return ReadingWords(zone=zone, advice=advice, margin=margin, interval=interval, contact=contact)


def _zone(low: float, high: float) -> Zone:
    """Zone of an interval."""
    least, most = TARGET
    if low < least:
        return Zone.BELOW if high < least else Zone.UNCERTAIN
    if high > most:
        return Zone.ABOVE if low >= most else Zone.NOT_BELOW
    return Zone.WITHIN
