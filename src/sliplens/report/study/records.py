"""Records of a study: which trials were taken, and what its stages saved beside the results of any workspace."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64, UInt8

from sliplens.intervals import Difference
from sliplens.report.study.localised import Truth
from sliplens.report.study.scored import Faithful, Remedies
from sliplens.results.records import Run


@dataclass(frozen=True, kw_only=True)
class ChosenTrial:
    """A trial of the study: whether every answer lay within the tolerance, and each network's worst error."""

    trial: str
    qualified: bool
    worst_error: dict[str, float]


@dataclass(frozen=True, kw_only=True)
class ChosenFrame:
    """A frame of the study and what it is for; the level is the margin that was looked for."""

    id: str
    trial: str
    frame: int
    level: float
    safety_margin: float
    scored: bool
    shown: bool


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Which trials and frames were taken, and how many could have been."""

    run: Run
    trials_wanted: int
    tolerance: float
    considered: int
    qualified: int
    told: str
    source: str
    condition: str
    inputs: tuple[str, ...]
    trials: tuple[ChosenTrial, ...]
    frames: tuple[ChosenFrame, ...]


@dataclass(frozen=True, kw_only=True)
class StateFrame:
    """A frame with its markers, in camera pixels: at rest, and now (NaN where one was not followed)."""

    id: str
    level: float
    safety_margin: float
    contact_state: str
    raw: UInt8[np.ndarray, "height width 3"]
    difference: UInt8[np.ndarray, "height width 3"]
    rest_px: Float64[np.ndarray, "markers 2"]
    position_px: Float64[np.ndarray, "markers 2"]


@dataclass(frozen=True, kw_only=True)
class States:
    """One trial from full stick to full slip; `untracked` says of which trials the markers could not be followed."""

    run: Run
    trial: str
    markers_from: str
    untracked: tuple[str, ...]
    frames: tuple[StateFrame, ...]


@dataclass(frozen=True, kw_only=True)
class RandomisedMethod:
    """How a method's maps change as layers get new weights; None where the maps cannot be compared."""

    layers: tuple[int, ...]
    similarity: tuple[float | None, ...]
    complexity_rise: float | None
    smooth_complexity_rise: float | None


@dataclass(frozen=True, kw_only=True)
class Randomisation:
    """Whether explanations notice that the network's weights were drawn anew."""

    run: Run
    input: str
    source: str
    frames: int
    methods: dict[str, RandomisedMethod]
    alarms: tuple[str, ...]


LOOKS = ("resolution", "total_variation", "gini", "noise_stability", "frame_stability")


@dataclass(frozen=True, kw_only=True)
class Looks:
    """What the eye judges of maps, as means over frames, by method and measure (`LOOKS`); None where undefined."""

    run: Run
    input: str
    source: str
    frames: int
    methods: dict[str, dict[str, float | None]]
    rougher: dict[tuple[str, str], Difference]
    """Total variation of the first method's maps less that of the second's; empty where it was not compared."""


@dataclass(frozen=True, kw_only=True)
class MethodTime:
    """Seconds a frame: median with the forward pass and without it, and the range of the repeats."""

    seconds: float
    seconds_without_forward: float | None
    low: float | None
    high: float | None


@dataclass(frozen=True, kw_only=True)
class Timing:
    """What explanations cost on one machine."""

    run: Run
    input: str
    source: str
    device: str
    threads: int | None
    repeats: int
    forward_seconds: float | None
    methods: dict[str, MethodTime]


@dataclass(frozen=True, kw_only=True)
class Study:
    """All that a study adds to a workspace; tables are by input, and empty where a stage was not run."""

    choice: Choice | None = None
    states: States | None = None
    deletion: dict[str, Remedies] = field(default_factory=dict)
    faithfulness: dict[str, Faithful] = field(default_factory=dict)
    randomisation: dict[str, Randomisation] = field(default_factory=dict)
    looks: dict[str, Looks] = field(default_factory=dict)
    timing: dict[str, Timing] = field(default_factory=dict)
    truth: dict[str, Truth] = field(default_factory=dict)

    @property
    def inputs(self) -> set[str]:
        """Inputs that some stage tells of; both where none does."""
        tables = (self.deletion, self.faithfulness, self.randomisation, self.looks, self.timing, self.truth)
        found = {name for table in tables for name in table} | set(self.choice.inputs if self.choice else ())
        return found or {"difference", "raw"}

    @property
    def source(self) -> str:
        """Where the study's frames come from."""
        if self.choice is not None:
            return self.choice.source
        tables = (self.deletion, self.faithfulness, self.randomisation, self.looks, self.timing, self.truth)
        return next((one.source for table in tables for one in table.values()), "simulated")

    def __bool__(self) -> bool:
        """Whether anything of a study was run."""
        tables = (self.deletion, self.faithfulness, self.randomisation, self.looks, self.timing, self.truth)
        return any(tables) or self.choice is not None or self.states is not None
