"""Where a network fails, and why, as far as its errors, its markers and other frictions tell."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64, Shaped, UInt8

from sliplens.codec import Columns
from sliplens.intervals import FEWEST_UNITS, Difference
from sliplens.results.evaluation import Predictions


@dataclass(frozen=True, kw_only=True)
class ErrorTable(Predictions):
    """Label and answer of frames, and what may have made the answer wrong; NaN where not known."""

    sensor: Shaped[np.ndarray, " frames"]
    friction: Float64[np.ndarray, " frames"]
    """Coefficient of friction that holds."""
    normal_force_n: Float64[np.ndarray, " frames"]
    contact_x: Float64[np.ndarray, " frames"]
    contact_y: Float64[np.ndarray, " frames"]
    """Middle of the contact, right and down, as shares of the image's width and height."""
    slice: Int64[np.ndarray, " frames"]
    """Place in `Diagnosis.slices`; -1 where no held-out frame is."""

    @property
    def error(self) -> Float64[np.ndarray, " frames"]:
        """Answer less label: above 0 where the margin is read too high."""
        return self.prediction - self.safety_margin


@dataclass(frozen=True, kw_only=True)
class ErrorSlice:
    """Frames of one leaf of the tree, and their error on trials that the tree has not seen."""

    name: str
    """What they have in common, in words."""
    frames: int
    trials: int
    error: float
    bias: float
    """Mean size of the error, and mean error, in margin units."""
    excess: Difference
    """Size of the error less that on all other held-out frames."""

    @property
    def holds(self) -> bool:
        """Whether the error is larger there beyond the interval, on enough held-out trials."""
        return self.trials >= FEWEST_UNITS and self.excess.above_zero


@dataclass(frozen=True, kw_only=True)
class ExplainedErrors(ErrorTable):
    """Frames that were explained; what needs the truth of each marker is NaN without it."""

    agreement: Float64[np.ndarray, " frames"]
    """Signed rank correlation, marker by marker, of the Shapley values for the answer and for the best reading."""
    reliability: Float64[np.ndarray, " frames"]
    """Correlation that another estimate of the Shapley values from as many scenes would have with these."""
    network_slipping: Float64[np.ndarray, " frames"]
    reading_slipping: Float64[np.ndarray, " frames"]
    """Share on slipping markers, of the sizes of these values on markers in contact."""
    cluster: Int64[np.ndarray, " frames"]
    """Kind of explanation, that of the largest error first."""
    example: Int64[np.ndarray, " frames"]
    """Place in `Diagnosis.pictures` of the frames that are most like their kind, else -1."""


@dataclass(frozen=True, kw_only=True)
class FrictionTable(Columns):
    """The same press and pull with other frictions, a row a frame and friction, in margin units."""

    frame_id: Shaped[np.ndarray, " rows"]
    trial: Shaped[np.ndarray, " rows"]
    condition: Shaped[np.ndarray, " rows"]
    day: Int64[np.ndarray, " rows"]
    friction: Float64[np.ndarray, " rows"]
    safety_margin: Float64[np.ndarray, " rows"]
    """True margin with that friction."""
    prediction: Float64[np.ndarray, " rows"]
    reading_slope: Float64[np.ndarray, " rows"]
    """Rise of the best reading over that of the margin there (`simulation.intervention.reading_slope`)."""


@dataclass(frozen=True, kw_only=True)
class FrictionSlope:
    """How far answers follow the margin where friction alone changes, 1 being all the way: of both, and the gap."""

    condition: str
    network: Difference
    reading: Difference
    gap: Difference


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """Where a network fails and why: slices of its errors, its markers, other frictions, kinds of explanations."""

    input: str
    source: str
    sentences: tuple[str, ...]
    """What was found, with figures."""
    left_out: str
    """What could not be asked, and why; empty where all could."""
    slices: tuple[ErrorSlice, ...]
    """Leaves of the tree, the largest error first."""
    slopes: tuple[FrictionSlope, ...]
    method: str
    """What the maps show."""
    errors: ErrorTable
    explained: ExplainedErrors
    frictions: FrictionTable
    pictures: UInt8[np.ndarray, "examples size size 3"]
    maps: Float32[np.ndarray, "examples size size"]
    """Examples of each kind as the network saw them, and their maps in margin units."""
    shown_frame: str
    other_frictions: UInt8[np.ndarray, "shown size size 3"]
    """Frame that is shown with each of its frictions in `frictions`, as the network would see it; empty without any."""
