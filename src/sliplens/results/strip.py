"""One trial from stick to slip, as a reader sees it at a glance."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from sliplens.codec import Columns


@dataclass(frozen=True, kw_only=True)
class StripReadings(Columns):
    """True and read safety margin of every frame of a trial; NaN where the sensor touches nothing."""

    time_s: Float64[np.ndarray, " frames"]
    contact_state: np.ndarray
    safety_margin: Float64[np.ndarray, " frames"]
    """Margin of the label."""
    prediction: Float64[np.ndarray, " frames"]
    """Margin that the network reads."""
    low: Float64[np.ndarray, " frames"]
    """Lower end of its 90 % interval; NaN for a network that was never calibrated."""
    high: Float64[np.ndarray, " frames"]
    """Upper end of its 90 % interval."""


@dataclass(frozen=True, kw_only=True)
class Strip:
    """One trial from stick to slip: true margin, read margin, and the map of a few frames."""

    trial: str
    condition: str
    source: str
    input: str
    method: str
    readings: StripReadings
    shown: tuple[int, ...]
    """Numbers of the frames that have pictures and maps."""
    pictures: UInt8[np.ndarray, "shown height width 3"]
    relevance: Float32[np.ndarray, "shown rows columns"]
    """Signed contribution of each pixel to f(x) - f(untouched sensor), in margin units."""
