"""What a network was trained on, how well it reads the safety margin, and where and why it fails."""

from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
from jaxtyping import Float32, Float64, Int64, Shaped, UInt8

from sliplens.codec import Columns
from sliplens.intervals import FEWEST_UNITS, Difference
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


@dataclass(frozen=True, kw_only=True)
class BinScore:
    """Mean squared error, in margin units, of the frames with a label in [low, high); the last bin holds 1 as well."""

    low: float
    high: float
    frames: int
    mse: float | None
    """None without such frames."""


@dataclass(frozen=True, kw_only=True)
class RegressionScores:
    """Errors of predictions against labels, in margin units (squared for `mse`).

    `r2` is None where the labels do not vary, since there is no variance to explain.
    """

    frames: int
    trials: int
    mse: float
    r2: float | None
    mae: float
    bins: tuple[BinScore, ...]


@dataclass(frozen=True, kw_only=True)
class Reliability:
    """How far the network's own uncertainty can be believed, in one condition."""

    coverage: dict[str, float]
    """Share of the labels inside the interval of each level; empty without a calibration."""
    mean_width_90: float | None
    """Mean width of the intervals that should hold 90 %, in margin units."""


@dataclass(frozen=True, kw_only=True)
class LeadTimes:
    """Warnings before the first gross slip of each trial."""

    trials: int
    """Trials that slip."""
    warned: int
    """Trials that slip after a true alarm."""
    median_ms: float | None
    """From the first true alarm to the slip, over the warned trials; None if there is none."""
    ideal_ms: float | None
    """The same for the true margin itself, over the trials that slip."""
    false_per_minute: float
    """Alarms that begin while the true margin is above twice the threshold, by the minute of labelled touch."""
    threshold: float
    """What a prediction is below at an alarm, in margin units."""


@dataclass(frozen=True, kw_only=True)
class Predictions(Columns):
    """Label and answer of each labelled frame, in margin units; what the network does not tell is NaN."""

    trial: Shaped[np.ndarray, " frames"]
    condition: Shaped[np.ndarray, " frames"]
    day: Int64[np.ndarray, " frames"]
    frame: Int64[np.ndarray, " frames"]
    time_s: Float64[np.ndarray, " frames"]
    safety_margin: Float64[np.ndarray, " frames"]
    prediction: Float64[np.ndarray, " frames"]
    """Not clipped to [0, 1]."""
    sigma: Float64[np.ndarray, " frames"]
    """Standard deviation of the answer; NaN for a network that answers with one number."""
    low_90: Float64[np.ndarray, " frames"]
    high_90: Float64[np.ndarray, " frames"]
    """Ends of the interval that should hold 90 % of the labels; NaN for a network that was not calibrated."""


@dataclass(frozen=True, kw_only=True)
class RiskCoverage:
    """Error of what is answered against the share that is: what a network gains by saying "I do not know"."""

    covered: tuple[float, ...]
    """Shares of the frames that are answered, from 1 down."""
    error: dict[str, tuple[float, ...]]
    """Mean absolute error at each share, in margin units, by what is withheld first: `known`, what is least like the
    training (`Estimate.known`); `spread`, the widest answers; `perfect`, the largest errors, which nobody knows."""

    def error_at(self, reason: str, share: float) -> float:
        """Mean absolute error while a share of the frames is answered, in margin units."""
        return self.error[reason][self.covered.index(share)]

    def __str__(self) -> str:
        """What withholding a fifth of the frames gains, in one sentence."""
        words = {"known": "the least known", "spread": "the widest", "perfect": "the worst, which nobody knows"}
        parts = ", ".join(f"{100 * self.error_at(name, 0.8):.1f} ({words[name]})" for name in self.error)
        return (
            f"mean error {100 * self.error_at('perfect', 1.0):.1f} points; with a fifth of the frames withheld {parts}"
        )


@dataclass(frozen=True, kw_only=True)
class BaselineScores:
    """How well one estimator reads the margin, by condition."""

    conditions: dict[str, RegressionScores]
    lead_times: dict[str, LeadTimes]


@dataclass(frozen=True, kw_only=True)
class Baselines:
    """Scores of model-based estimators, and what they were fitted on."""

    markers: str
    """Kind of markers that was followed."""
    hold: str
    """Where the frame comes from from which motion is counted."""
    offered_trials: int
    """Training trials of the data set."""
    training_trials: int
    """Trials they were fitted on."""
    known_trials: int
    """Of these, trials that also trained or validated the network."""
    shared_trials: int
    """Of these, trials that they are also scored on; their scores flatter them then."""
    training_frames: int
    """Labelled frames they were fitted on."""
    followed: float
    """Share of markers followed while in view, over all frames of the trials fitted on and scored."""
    failed: dict[str, str]
    """Trials in which no field could be followed, and why: not fitted on, and answered with the training mean."""
    estimators: dict[str, BaselineScores]


@dataclass(frozen=True, kw_only=True)
class BaselinePredictions(Columns):
    """Answer of each estimator on the frames that the network was scored on, in margin units."""

    estimator: Shaped[np.ndarray, " rows"]
    trial: Shaped[np.ndarray, " rows"]
    frame: Int64[np.ndarray, " rows"]
    prediction: Float64[np.ndarray, " rows"]


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Scores of one network by condition, day and trial, how sure it was, and the predictions behind it all."""

    input: str
    """Name of the encoding that the network sees."""
    split: str
    known_trials: int
    """Trials that trained or validated this network; its scores flatter it where there are any."""
    conditions: dict[str, RegressionScores]
    days: dict[str, RegressionScores]
    """Scores by condition and day."""
    trials: dict[str, RegressionScores]
    reliability: dict[str, Reliability]
    """Coverage of the intervals by condition."""
    wet_auroc: float | None
    """How often the uncertainty of a wet frame is above that of a dry one; None without both, or without a spread."""
    lead_times: dict[str, LeadTimes]
    """Warnings by condition."""
    predictions: Predictions
    friction: str = ""
    """What the network was told of the coefficient of friction; empty where nothing was."""
    ratio_r2: dict[str, float | None] = field(default_factory=dict)
    """R2 of the traction ratio F_t / F_n by condition; empty for a network that answers with the margin alone, None
    where the ratio does not vary or no force is known."""
    risk: RiskCoverage | None = None
    """Error as more and more frames are withheld; None in a result without it."""
    baselines: Baselines | None = None
    """Scores of estimators that read the markers of the same frames; None where none were asked for."""
    baseline_predictions: BaselinePredictions | None = None

    def frame(self) -> pa.Table:
        """Arrow table of the predictions, a row a frame."""
        return self.predictions.table()


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
