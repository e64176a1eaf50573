"""How well a network reads the safety margin."""

from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
from jaxtyping import Float64, Int64, Shaped

from sliplens.codec import Columns


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
