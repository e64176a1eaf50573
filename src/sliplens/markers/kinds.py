"""What markers look like: one row a sensor."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Float32

from sliplens.errors import InputError

Contrast: TypeAlias = Literal["dark", "light", "colour"]


@dataclass(frozen=True, kw_only=True)
class MarkerKind:
    """How the markers of a sensor differ from what they are printed on.

    Raises
    ------
    InputError
        If the radii are not a positive low and a larger high, or a channel's weight is negative.
    """

    name: str
    contrasts: tuple[Contrast, ...]
    """How they may stand out; where there are several, the frame decides."""
    radius_px: tuple[float, float] = (2.0, 40.0)
    """Smallest and largest radius that is looked for, in pixels."""
    channels: tuple[float, float, float] | None = None
    """Weights of red, green and blue, by which centres are measured; found from the markers themselves if None."""

    def __post_init__(self) -> None:
        """Check what cannot be looked for."""
        low, high = self.radius_px
        if not 0 < low < high:
            raise InputError(f"markers of {self.name} have radii from {low:g} to {high:g} px; give a low and a high")
        if self.channels is not None and (min(self.channels) < 0 or sum(self.channels) <= 0):
            raise InputError(f"the channels of {self.name} weigh {self.channels}; give none less than 0, and one more")


@dataclass(frozen=True, kw_only=True)
class Appearance:
    """How the markers of one sensor look to its camera, as one frame showed it."""

    weights: Float32[np.ndarray, "3"]
    """Of red, green and blue; their sum is high on a marker, whatever its colour, and in grey levels."""
    radius_px: float
    """Median over the markers."""
    contrast: float
    """Median over the markers, in weighted grey levels."""


KINDS = {
    "chromatouch": MarkerKind(
        name="chromatouch",
        contrasts=("dark",),
        # red speckles most, and the lamps' glare is blue: green measures best
        channels=(0.2, 0.8, 0.0),
    ),
    "gelsight-mini": MarkerKind(name="gelsight-mini", contrasts=("dark",), channels=(1.0, 1.0, 1.0)),
    "tactip": MarkerKind(name="tactip", contrasts=("light",), channels=(1.0, 1.0, 1.0)),
    "auto": MarkerKind(name="auto", contrasts=("dark", "light", "colour")),
}
"""Presets by name: the magenta dots of the ChromaTouch, the black ones of a GelSight Mini, the white pins of a TacTip;
`auto` looks for whatever is round and stands out alike in many places."""


def get_kind(name: str) -> MarkerKind:
    """Preset of a name.

    Raises
    ------
    InputError
        If there is none.
    """
    if name not in KINDS:
        raise InputError(f"markers {name!r} are not known; choose {', '.join(KINDS)}")
    return KINDS[name]
