"""What a simulation made."""

from dataclasses import dataclass

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
