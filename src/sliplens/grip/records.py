"""Records of simulated episodes and of holds with a gripper; reports load them without torch."""

from dataclasses import dataclass
from typing import Annotated, Literal, TypeAlias

import numpy as np
from jaxtyping import Bool, Float64, Shaped

from sliplens.codec import UNKNOWN, Columns, Result
from sliplens.results.evaluation import AMOUNT, ANSWER, EXCESS, FORCE, FRICTION, MARGIN


@dataclass(frozen=True, kw_only=True)
class EpisodeTable(Columns):
    """Episodes, a row each; forces in newtons, lengths in metres, times in seconds."""

    condition: Shaped[np.ndarray, " episodes"]
    known_friction: Annotated[Float64[np.ndarray, " episodes"], AMOUNT, UNKNOWN]
    """Mean of the friction that the controller's margins used; NaN without one."""
    mass_kg: Annotated[Float64[np.ndarray, " episodes"], AMOUNT]
    friction: Annotated[Float64[np.ndarray, " episodes"], FRICTION]
    """Lowest static friction of the episode, mean of both fingers."""
    dropped: Bool[np.ndarray, " episodes"]
    crushed: Bool[np.ndarray, " episodes"]
    slip_m: Annotated[Float64[np.ndarray, " episodes"], AMOUNT]
    """Slip of the finger that slid farther."""
    mean_force_n: Annotated[Float64[np.ndarray, " episodes"], AMOUNT, UNKNOWN]
    """Grip force, mean from the lift until the end or the drop."""
    least_force_n: Annotated[Float64[np.ndarray, " episodes"], AMOUNT, UNKNOWN]
    """Least force that holds, mean over the same time."""
    force_excess: Annotated[Float64[np.ndarray, " episodes"], EXCESS, UNKNOWN]
    """Mean force over the mean least force, less 1: a ratio."""
    under_20_s: Annotated[Float64[np.ndarray, " episodes"], AMOUNT]
    """Time with a true margin under 20 %."""


@dataclass(frozen=True, kw_only=True)
class GripTrace(Columns):
    """One episode, a row a tick; margins are means of the fingers that have one, NaN where none has."""

    time_s: Annotated[Float64[np.ndarray, " ticks"], AMOUNT]
    command_n: Annotated[Float64[np.ndarray, " ticks"], FORCE]
    force_n: Annotated[Float64[np.ndarray, " ticks"], FORCE]
    least_force_n: Annotated[Float64[np.ndarray, " ticks"], AMOUNT]
    """Least force that holds: the load over both frictions."""
    load_n: Annotated[Float64[np.ndarray, " ticks"], FORCE]
    """Tangential force of both fingers."""
    true_margin: Annotated[Float64[np.ndarray, " ticks"], MARGIN, UNKNOWN]
    """Smaller of both fingers."""
    margin: Annotated[Float64[np.ndarray, " ticks"], ANSWER, UNKNOWN]
    """Prediction."""
    low: Annotated[Float64[np.ndarray, " ticks"], MARGIN, UNKNOWN]
    high: Annotated[Float64[np.ndarray, " ticks"], MARGIN, UNKNOWN]
    slip_m: Annotated[Float64[np.ndarray, " ticks"], AMOUNT]
    slip_seen: Bool[np.ndarray, " ticks"]
    """True where the markers showed a slip."""


@dataclass(frozen=True, kw_only=True)
class GripSetup:
    """Object, controller and network of some episodes, and how they were run."""

    object: str
    condition: str
    controller: str
    settings: dict[str, float]
    """Changed constants of the controller; all constants of one that is not in `CONTROLLERS`."""
    network: str
    """First 12 hex digits of the hash of its weights."""
    friction: str | None
    """Friction that predictions used, in words; None without one."""
    rendered: bool
    """True where the fingertips were drawn; False where the network's measured errors were looked up."""
    seed: int


@dataclass(frozen=True, kw_only=True)
class Grip(Result):
    """Episodes of one controller."""

    setup: GripSetup
    seconds: float
    """Time that running the episodes took."""
    episodes: EpisodeTable
    trace: GripTrace
    """First episode."""

    @property
    def drop_rate(self) -> float:
        """Share of the episodes in which the object fell."""
        return float(self.episodes.dropped.mean())


@dataclass(frozen=True, kw_only=True)
class HoldSteps(Columns):
    """Commands to a gripper, a row each; NaN where nothing was measured or predicted."""

    time_s: Annotated[Float64[np.ndarray, " steps"], AMOUNT]
    command_n: Annotated[Float64[np.ndarray, " steps"], AMOUNT]
    """Commanded grip force."""
    force_n: Annotated[Float64[np.ndarray, " steps"], ANSWER, UNKNOWN]
    """Grip force that the gripper measured before."""
    margin: Annotated[Float64[np.ndarray, " steps"], MARGIN, UNKNOWN]
    """Predicted margin, mean of the fingertips that have one."""
    low: Annotated[Float64[np.ndarray, " steps"], MARGIN, UNKNOWN]
    slip: Bool[np.ndarray, " steps"]
    """True where the markers showed a slip."""
    failed: Bool[np.ndarray, " steps"]
    """True where the gripper failed to take the command, or to measure its force."""
    why: Shaped[np.ndarray, " steps"]


Ending: TypeAlias = Literal["time", "source", "failed", "interrupted"]


@dataclass(frozen=True, kw_only=True)
class Hold(Result):
    """Commands to a gripper while it held something, and how the hold ended."""

    sources: tuple[str, ...]
    """Live source of each fingertip."""
    gripper: str
    """Its address, or the name of its class."""
    controller: str
    settings: dict[str, float]
    """Changed constants of the controller."""
    ceiling_n: float
    ended: Ending
    """`time`: the time was over; `source`: a source ended; `failed`: a source or callback failed; `interrupted`: by a
    person."""
    why: str
    """End of the hold in a sentence, with the state of the gripper after it."""
    troubles: tuple[str, ...]
    """Faults of the gripper, each once."""
    steps: HoldSteps
