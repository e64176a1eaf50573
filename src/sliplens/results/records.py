"""Records of the saved results that a report of any workspace is made from."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64, Int, UInt8


@dataclass(frozen=True, kw_only=True)
class Run:
    """Where a result comes from: what `run.json` of its folder says."""

    folder: Path
    stage: str
    config: dict[str, Any]
    config_hash: str
    versions: dict[str, str]
    machine: dict[str, Any]
    finished: str


@dataclass(frozen=True, kw_only=True)
class SplitCount:
    """Trials and frames of one part of the data."""

    trials: int
    frames: int


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """What was simulated; None where the folder does not say."""

    run: Run
    trials: int | None
    frames: int | None
    by_split: dict[str, SplitCount]
    conditions: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Training:
    """One trained network and its learning curve, errors in squared margin units."""

    run: Run
    input: str
    backbone: str
    image_size: int
    frame_size: tuple[int, ...]
    train_frames: int | None
    validation_frames: int | None
    epochs: float | None
    minutes: float | None
    seed: int | None
    best_validation_mse: float | None
    parameters: int | None
    stopped_by: str
    epoch: Float64[np.ndarray, " epochs"]
    train_mse: Float64[np.ndarray, " epochs"]
    validation_mse: Float64[np.ndarray, " epochs"]


@dataclass(frozen=True, kw_only=True)
class BinScore:
    """Mean squared error of the frames with a label in [low, high); None without such frames."""

    low: float
    high: float
    frames: int
    mse: float | None


@dataclass(frozen=True, kw_only=True)
class ConditionScores:
    """Errors under one condition, in margin units; `r2` is None where the labels do not vary."""

    frames: int
    trials: int
    mse: float
    r2: float | None
    mae: float
    bins: tuple[BinScore, ...]


@dataclass(frozen=True, kw_only=True)
class Predictions:
    """Label and answer of each test frame, in margin units, times in seconds."""

    trial: np.ndarray
    condition: np.ndarray
    frame: Int[np.ndarray, " frames"]
    time_s: Float64[np.ndarray, " frames"]
    safety_margin: Float64[np.ndarray, " frames"]
    prediction: Float64[np.ndarray, " frames"]

    def where(self, rows: Bool[np.ndarray, " frames"]) -> "Predictions":
        """Return the frames for which `rows` is true."""
        return Predictions(
            trial=self.trial[rows],
            condition=self.condition[rows],
            frame=self.frame[rows],
            time_s=self.time_s[rows],
            safety_margin=self.safety_margin[rows],
            prediction=self.prediction[rows],
        )


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """How well one network reads the safety margin, by condition."""

    run: Run
    input: str
    conditions: dict[str, ConditionScores]
    predictions: Predictions


@dataclass(frozen=True, kw_only=True)
class ExplainedFrame:
    """A frame that was explained: label (None if unknown), answer, and the answer on its reference, in margin units."""

    id: str
    condition: str
    safety_margin: float | None
    prediction: float
    reference_prediction: float | None


@dataclass(frozen=True, kw_only=True)
class Method:
    """What a method cost, and what it complained about."""

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
    methods: dict[str, Method]
    pictures: UInt8[np.ndarray, "frames height width 3"]
    saliency: dict[str, Float[np.ndarray, "frames height width"]]


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
class Scored:
    """How far the explanations of one network can be believed."""

    run: Run
    input: str
    source: str
    fill: str
    methods: dict[str, MethodScore]
    alarms: tuple[str, ...]
    curves: dict[str, DeletionCurve]
