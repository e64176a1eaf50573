"""Records of how far explanations can be believed: the thesis's remedies, and curves of removal in margin units."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64

from sliplens.intervals import Difference
from sliplens.results.records import DeletionCurve, Run

Key = tuple[str, str, str]
"""Fill, unit and method."""


@dataclass(frozen=True, kw_only=True)
class VariantScore:
    """Score D of one method under a variant of the thesis's deletion."""

    mean: float
    sd: float
    last_step_mean: float | None
    frames: int


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A change of the thesis's score: what removed pixels become, which way it goes, where it stops."""

    told: str
    fill: str
    mode: Literal["deletion", "insertion"]
    stop: float | None
    better: Literal["lower", "higher"]
    methods: dict[str, VariantScore]


@dataclass(frozen=True, kw_only=True)
class Remedies:
    """The thesis's own remedies for its score, and insertion."""

    run: Run
    input: str
    source: str
    variants: dict[str, Variant]
    alarms: tuple[str, ...]
    curves: dict[tuple[str, str], dict[str, DeletionCurve]]
    """By variant and method, then by frame: a curve that stops at a saliency has as many steps as it needs."""


@dataclass(frozen=True, kw_only=True)
class SoundScore:
    """What removal says of one method under one fill and unit, in margin units."""

    fill: str
    unit: str
    method: str
    control: bool
    srg: Difference
    gain_over_random: Difference
    most_first: float
    least_first: float
    random: float
    at: dict[float, float]
    """Mean change where a share of the image is gone, most influential first."""

    @property
    def key(self) -> Key:
        """Fill, unit and method."""
        return self.fill, self.unit, self.method


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Symmetric relevance gain of the first method less that of the second."""

    fill: str
    unit: str
    first: str
    second: str
    gap: Difference


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """Kendall's tau of the methods' ranking between two fills; None where it is not defined."""

    unit: str
    first: str
    second: str
    tau: float | None


@dataclass(frozen=True, kw_only=True)
class RemovalCurve:
    """Changes of the answers of one method under one fill and unit, in margin units."""

    frame_ids: tuple[str, ...]
    trials: np.ndarray
    areas: Float64[np.ndarray, " areas"]
    most_first: Float64[np.ndarray, "frames areas"]
    least_first: Float64[np.ndarray, "frames areas"]
    random: Float64[np.ndarray, "frames areas"]

    @property
    def srg(self) -> Float64[np.ndarray, " frames"]:
        """Symmetric relevance gain of each frame: area between the most and the least influential first."""
        return np.trapezoid(self.most_first - self.least_first, self.areas, axis=-1)


@dataclass(frozen=True, kw_only=True)
class Faithful:
    """The sound scores of one network's explanations."""

    run: Run
    input: str
    source: str
    frames: int
    trials: int
    random_orders: int
    scores: tuple[SoundScore, ...]
    comparisons: tuple[Comparison, ...]
    agreement: tuple[Agreement, ...]
    alarms: tuple[str, ...]
    curves: dict[Key, RemovalCurve]
