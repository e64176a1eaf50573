"""Records of the saved results that a report of any workspace is made from."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int


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
