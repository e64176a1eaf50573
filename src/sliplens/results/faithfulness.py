"""Scores of explanations: by deletion as the thesis does, and by removal against controls."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int

from sliplens.intervals import Difference
from sliplens.results.records import Run

Key = tuple[str, str, str]
"""Fill, unit and method."""


@dataclass(frozen=True, kw_only=True)
class MethodScore:
    """Deletion score D_AUC over frames: mean and standard deviation, and mean D once the last pixel is gone."""

    mean: float
    sd: float
    last_step_mean: float | None
    frames: int


@dataclass(frozen=True, kw_only=True)
class DeletionCurve:
    """Deletion score D of each frame while pixels are removed, and the answers it comes from, in margin units."""

    frame_ids: tuple[str, ...]
    pixels_removed: Int[np.ndarray, " steps"]
    scores: Float64[np.ndarray, "frames steps"]
    predictions: Float64[np.ndarray, "frames steps"]


@dataclass(frozen=True, kw_only=True)
class DeletionScores:
    """How far the explanations of one network can be believed."""

    run: Run
    input: str
    source: str
    fill: str
    methods: dict[str, MethodScore]
    alarms: tuple[str, ...]
    curves: dict[str, DeletionCurve]


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A change of the thesis's score: what removed pixels become, which way it goes, where it stops."""

    told: str
    fill: str
    mode: Literal["deletion", "insertion"]
    stop: float | None
    better: Literal["lower", "higher"]
    methods: dict[str, MethodScore]


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
class RemovalScore:
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
class RemovalScores:
    """The sound scores of one network's explanations."""

    run: Run
    input: str
    source: str
    frames: int
    trials: int
    random_orders: int
    scores: tuple[RemovalScore, ...]
    comparisons: tuple[Comparison, ...]
    agreement: tuple[Agreement, ...]
    alarms: tuple[str, ...]
    curves: dict[Key, RemovalCurve]
