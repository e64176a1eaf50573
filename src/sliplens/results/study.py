"""Stages of a study: what was chosen, what the camera saw, and how the explanations were tested."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Float64, Int, UInt8

from sliplens.intervals import Difference
from sliplens.results.faithfulness import Remedies, RemovalScores
from sliplens.results.records import Run

REGIONS = ("markers", "slip_annulus", "edges")
"""Areas in which a map may lie."""
MAP_MEASURES = ("resolution", "total_variation", "gini", "noise_stability", "frame_stability")
"""Measures of how a map looks."""


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


@dataclass(frozen=True, kw_only=True)
class MapQuality:
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
class Localisation:
    """Where a method's relevance lies (share of its mass, share of its strongest pixels, by `REGIONS`), and how well it
    ranks the markers as the network's answer and the true margin do.
    """

    mass: dict[str, float | None]
    rank: dict[str, float | None]
    spearman_network: float | None
    spearman_margin: float | None
    network: Difference | None
    """Interval of `spearman_network`."""
    margin: Difference | None
    """Interval of `spearman_margin`."""
    edges: Difference | None
    """Mass on the edges of markers less the share of the image that they cover."""


@dataclass(frozen=True, kw_only=True)
class MetaTest:
    """Whether a score ranks a perfect map above a damaged one above chance, under one fill."""

    fill: str
    holds: bool
    oracle: float
    degraded: float
    random: float


@dataclass(frozen=True, kw_only=True)
class MarkerEffects:
    """What putting one marker back does to the network's answer and to the true margin, a row a marker and frame."""

    frame_id: np.ndarray
    trial: np.ndarray
    marker: Int[np.ndarray, " rows"]
    x_px: Float64[np.ndarray, " rows"]
    y_px: Float64[np.ndarray, " rows"]
    network: Float64[np.ndarray, " rows"]
    margin: Float64[np.ndarray, " rows"]
    state: Int[np.ndarray, " rows"]


@dataclass(frozen=True, kw_only=True)
class Truth:
    """What a network should have looked at, which only a simulation tells."""

    run: Run
    input: str
    source: str
    frames: int
    areas: dict[str, float | None]
    methods: dict[str, Localisation]
    network_against_margin: Difference | None
    meta: tuple[MetaTest, ...]
    told: str
    effects: MarkerEffects
    frame_ids: tuple[str, ...]
    network_maps: Float[np.ndarray, "frames height width"]
    margin_maps: Float[np.ndarray, "frames height width"]


@dataclass(frozen=True, kw_only=True)
class Study:
    """All that a study adds to a workspace; tables are by input, and empty where a stage was not run."""

    choice: Choice | None = None
    states: States | None = None
    remedies: dict[str, Remedies] = field(default_factory=dict)
    faithfulness: dict[str, RemovalScores] = field(default_factory=dict)
    randomisation: dict[str, Randomisation] = field(default_factory=dict)
    map_quality: dict[str, MapQuality] = field(default_factory=dict)
    timing: dict[str, Timing] = field(default_factory=dict)
    truth: dict[str, Truth] = field(default_factory=dict)

    @property
    def inputs(self) -> set[str]:
        """Inputs that some stage tells of; both where none does."""
        tables = (self.remedies, self.faithfulness, self.randomisation, self.map_quality, self.timing, self.truth)
        found = {name for table in tables for name in table} | set(self.choice.inputs if self.choice else ())
        return found or {"difference", "raw"}

    @property
    def source(self) -> str:
        """Where the study's frames come from."""
        if self.choice is not None:
            return self.choice.source
        tables = (self.remedies, self.faithfulness, self.randomisation, self.map_quality, self.timing, self.truth)
        return next((one.source for table in tables for one in table.values()), "simulated")

    def __bool__(self) -> bool:
        """Whether anything of a study was run."""
        tables = (self.remedies, self.faithfulness, self.randomisation, self.map_quality, self.timing, self.truth)
        return any(tables) or self.choice is not None or self.states is not None
