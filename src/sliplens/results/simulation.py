"""What a simulation made."""

from dataclasses import dataclass


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
