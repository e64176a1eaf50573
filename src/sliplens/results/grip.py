"""Grips: what became of each episode, one of them tick by tick, and what a real gripper was told."""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Float32, Float64, Int64, Shaped, UInt8

from sliplens.codec import UNKNOWN, Columns
from sliplens.results.evaluation import AMOUNT, ANSWER, EXCESS, FORCE, FRICTION, MARGIN


@dataclass(frozen=True, kw_only=True)
class EpisodeTable(Columns):
    """Episodes, a row each; forces in newtons, lengths in metres, times in seconds."""

    condition: Shaped[np.ndarray, " episodes"]
    grasp: Int64[np.ndarray, " episodes"]
    """Which grasp of its object it is, counted from 1."""
    known_friction: Annotated[Float64[np.ndarray, " episodes"], AMOUNT, UNKNOWN]
    """Coefficient of friction that was told, or learnt in the grasps before, its mean; NaN where nothing was."""
    mass_kg: Annotated[Float64[np.ndarray, " episodes"], AMOUNT]
    friction: Annotated[Float64[np.ndarray, " episodes"], FRICTION]
    """Least static friction of the episode, mean of both fingers."""
    dropped: Bool[np.ndarray, " episodes"]
    crushed: Bool[np.ndarray, " episodes"]
    slip_m: Annotated[Float64[np.ndarray, " episodes"], AMOUNT]
    """Way slid by the finger that slid farther."""
    mean_force_n: Annotated[Float64[np.ndarray, " episodes"], AMOUNT, UNKNOWN]
    """Grip force, mean from the lift until the end or the drop."""
    peak_force_n: Annotated[Float64[np.ndarray, " episodes"], FORCE]
    least_force_n: Annotated[Float64[np.ndarray, " episodes"], AMOUNT, UNKNOWN]
    """Least force that would have held, mean over the same time."""
    peak_least_force_n: Annotated[Float64[np.ndarray, " episodes"], AMOUNT]
    """The highest that was needed at any moment."""
    force_excess: Annotated[Float64[np.ndarray, " episodes"], EXCESS, UNKNOWN]
    """Mean force over the mean least force, less 1: a ratio."""
    peak_excess: Annotated[Float64[np.ndarray, " episodes"], EXCESS, UNKNOWN]
    """The same of the peaks."""
    under_20_s: Annotated[Float64[np.ndarray, " episodes"], AMOUNT]
    """Time with a true margin under 20 %."""


@dataclass(frozen=True, kw_only=True)
class GripTrace(Columns):
    """One episode, a row a tick; margins are means of both fingers that read, NaN where none does."""

    time_s: Annotated[Float64[np.ndarray, " ticks"], AMOUNT]
    command_n: Annotated[Float64[np.ndarray, " ticks"], FORCE]
    force_n: Annotated[Float64[np.ndarray, " ticks"], FORCE]
    least_force_n: Annotated[Float64[np.ndarray, " ticks"], AMOUNT]
    """Least force that holds: the load over both frictions."""
    load_n: Annotated[Float64[np.ndarray, " ticks"], FORCE]
    """Tangential force of both fingers."""
    true_margin: Annotated[Float64[np.ndarray, " ticks"], MARGIN, UNKNOWN]
    """Of the finger with less."""
    margin: Annotated[Float64[np.ndarray, " ticks"], ANSWER, UNKNOWN]
    """Read."""
    low: Annotated[Float64[np.ndarray, " ticks"], MARGIN, UNKNOWN]
    high: Annotated[Float64[np.ndarray, " ticks"], MARGIN, UNKNOWN]
    slip_m: Annotated[Float64[np.ndarray, " ticks"], AMOUNT]
    slip_seen: Bool[np.ndarray, " ticks"]
    """Whether the markers told of a slip."""


@dataclass(frozen=True, kw_only=True)
class GripSetup:
    """What is held, by what, and with which readings."""

    object: str
    condition: str
    controller: str
    settings: dict[str, float]
    """Constants of the controller that were changed; all of one that is none of the table."""
    network: str
    """First 12 hex digits of the hash of its weights."""
    friction: str | None
    """What was told of the friction, in words; None where nothing was."""
    grasps: int
    """How many times each object was gripped."""
    same_object: bool
    """Whether what a slip taught counted in the grasps that followed."""
    sequence: bool
    """Whether frames were read in order."""
    latency_s: float
    """From an image to the command that answers it."""
    rendered: bool
    """Whether the fingertips were filmed and read, rather than looked up in the network's measured errors."""
    seed: int


@dataclass(frozen=True, kw_only=True)
class Grip:
    """Episodes of one controller."""

    setup: GripSetup
    seconds: float
    """Time the episodes took to run."""
    episodes: EpisodeTable
    trace: GripTrace
    """The first episode."""
    moments_s: tuple[float, ...]
    """Times of the pictures; none where nothing was rendered."""
    pictures: UInt8[np.ndarray, "moments height width 3"]
    maps: Annotated[Float32[np.ndarray, "moments side side"], ANSWER]
    """Relevance of the first finger's frames, in margin units, signed."""

    @property
    def drop_rate(self) -> float:
        """Share of the episodes in which the object fell."""
        return float(self.episodes.dropped.mean())


@dataclass(frozen=True, kw_only=True)
class HoldSteps(Columns):
    """Commands to a gripper, a row each; NaN where nothing was measured or read."""

    time_s: Annotated[Float64[np.ndarray, " steps"], AMOUNT]
    command_n: Annotated[Float64[np.ndarray, " steps"], AMOUNT]
    """Grip force that was told."""
    force_n: Annotated[Float64[np.ndarray, " steps"], ANSWER, UNKNOWN]
    """Grip force that the gripper measured before."""
    margin: Annotated[Float64[np.ndarray, " steps"], MARGIN, UNKNOWN]
    """Read, the mean of the fingertips that read."""
    low: Annotated[Float64[np.ndarray, " steps"], MARGIN, UNKNOWN]
    slip: Bool[np.ndarray, " steps"]
    """Whether the markers told of a slip."""
    failed: Bool[np.ndarray, " steps"]
    """Whether the gripper failed to take the command, or to tell its force."""
    why: Shaped[np.ndarray, " steps"]


@dataclass(frozen=True, kw_only=True)
class Hold:
    """What a gripper was told while something was held, and how that ended."""

    sources: tuple[str, ...]
    """What was read: a fingertip each."""
    gripper: str
    """Its address, or the name of its class."""
    controller: str
    settings: dict[str, float]
    """Constants of the controller that were changed."""
    ceiling_n: float
    watchdog_s: float
    ended: Literal["time", "source", "failed", "interrupted"]
    """The time was over, a source ended, that or who was told of each step failed, or a person interrupted it."""
    why: str
    """The same in a sentence, with what the gripper goes on doing."""
    troubles: tuple[str, ...]
    """What the gripper failed at, each once."""
    steps: HoldSteps

    def frame(self) -> pa.Table:
        """Table with a row a command."""
        return self.steps.table()
