"""Saved explanations: frames, what was answered on them, and a map of each by every method."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from sliplens.results.records import Run


@dataclass(frozen=True, kw_only=True)
class ExplainedFrame:
    """A frame that was explained: label (None if unknown), answer, and the answer on its reference, in margin units."""

    id: str
    condition: str
    safety_margin: float | None
    prediction: float
    reference_prediction: float | None


@dataclass(frozen=True, kw_only=True)
class MethodNotes:
    """Cost of a method in seconds a frame, and what it complained about."""

    seconds_per_frame: float | None
    warnings: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Explained:
    """Frames, their pictures as the network saw them, and the saliency of each method."""

    run: Run
    input: str
    source: str
    image_size: int
    frames: tuple[ExplainedFrame, ...]
    methods: dict[str, MethodNotes]
    pictures: UInt8[np.ndarray, "frames height width 3"]
    saliency: dict[str, Float[np.ndarray, "frames height width"]]
