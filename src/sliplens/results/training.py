"""What a simulation made, and how a network was trained."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from sliplens.codec import Columns
from sliplens.recordings import Dataset


@dataclass(frozen=True, kw_only=True)
class SplitCount:
    """Trials and frames of one part of the data."""

    trials: int
    frames: int


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """Trials and frames that were simulated, in all and by split."""

    trials: int
    frames: int
    by_split: dict[str, SplitCount]
    conditions: tuple[str, ...]


def describe_simulation(data: Dataset) -> Simulation:
    """Count the trials and frames of a data set, as its table has them."""
    splits = {
        split: [trial.frames for trial in data.trials if trial.split == split]
        for split in dict.fromkeys(trial.split for trial in data.trials)
    }
    return Simulation(
        trials=len(data.trials),
        frames=sum(trial.frames for trial in data.trials),
        by_split={split: SplitCount(trials=len(frames), frames=sum(frames)) for split, frames in splits.items()},
        conditions=tuple(sorted({trial.condition for trial in data.trials})),
    )


@dataclass(frozen=True, kw_only=True)
class LearningCurve(Columns):
    """Errors after each epoch, in squared margin units, and the minutes until then."""

    epoch: Float64[np.ndarray, " epochs"]
    """Passes over the training frames; the last may be cut short."""
    train_mse: Float64[np.ndarray, " epochs"]
    """On augmented images, while the weights change."""
    validation_mse: Float64[np.ndarray, " epochs"]
    minutes: Float64[np.ndarray, " epochs"]


@dataclass(frozen=True, kw_only=True)
class Training:
    """One training: what was trained on what, how long, and its learning curve."""

    input: str
    """Name of the encoding that the network sees."""
    condition: str | None = None
    """Condition of all its trials; None where it was not restricted to one."""
    backbone: str
    image_size: int
    """Height and width of the network's input, in pixels."""
    frame_size: tuple[int, int]
    """Height and width of the sensor's frames, in pixels."""
    train_frames: int
    validation_frames: int
    seed: int
    epochs: float
    """Passes over the training frames, the last maybe in part."""
    minutes: float
    stopped_by: str
    """`epochs` or `time limit`."""
    best_validation_mse: float
    """Lowest validation error of the curve, in squared margin units: that of the weights that were kept."""
    parameters: int
    processes: int
    """Processes that shared it, one a device."""
    curve: LearningCurve
