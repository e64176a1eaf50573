"""Records of trainings and evaluations; none needs torch."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from jaxtyping import Float64, Int64, Shaped
from msgspec import Meta

from sliplens.codec import UNKNOWN, Columns, Result
from sliplens.friction import MOST_FRICTION
from sliplens.recordings.trial import CLOCK_S, LABEL_BOUNDS


def _label(name: str) -> Meta:
    low, high, _ = LABEL_BOUNDS[name]
    return Meta(ge=low, le=high, description=UNIT.description if name == "safety_margin" else None)


UNIT = Meta(description="margin units")
"""Of what has neither bounds nor a unit in its name."""

MARGIN, FORCE, RATIO = map(_label, ("safety_margin", "normal_force_n", "friction_coefficient"))
TIME = Meta(ge=CLOCK_S[0], le=CLOCK_S[1])
"""Bounds of measured values, in their units; those of this table are asked of every result that is loaded."""
FRICTION = Meta(gt=0, le=MOST_FRICTION)
ANSWER = Meta(ge=-1000, le=1000, description="margin units")
"""Bounds of predictions that are not clipped, and of their parts and changes: a thousand times a margin's range."""
AMOUNT = Meta(ge=0)
"""Of counts, sizes and squares."""
_ROUNDED = 1 + 1e-6
AT_MOST_ONE = Meta(le=_ROUNDED)
SHARE = Meta(ge=0, le=_ROUNDED)
CORRELATION = Meta(ge=-_ROUNDED, le=_ROUNDED)
EXCESS = Meta(ge=-1)
"""Of a ratio less one."""
PIXEL = Meta(ge=-1e5, le=1e5)
"""No picture is as wide."""


@dataclass(frozen=True, kw_only=True)
class OfNetwork(Result):
    """Result of one network on some frames."""

    input: str
    """Name of the encoding that the network sees."""
    source: str
    """Where the frames come from: "simulated" or "real"."""


@dataclass(frozen=True, kw_only=True)
class OfOutput(OfNetwork):
    """Result whose numbers are in the unit of the network's output."""

    unit: str = "margin"
    """Unit of the predictions; `margin` for safety margins in [0, 1], empty if unknown."""

    @property
    def unit_words(self) -> str:
        """Unit of differences of predictions, in words."""
        return "margin units" if self.unit == "margin" else self.unit or "units of the output"


@dataclass(frozen=True, kw_only=True)
class LearningCurve(Columns):
    """Errors after each epoch, in squared margin units, and the minutes until then."""

    epoch: Annotated[Float64[np.ndarray, " epochs"], AMOUNT]
    """Passes over the training frames; the last may be cut short."""
    train_mse: Annotated[Float64[np.ndarray, " epochs"], AMOUNT]
    """On augmented images, while the weights change."""
    validation_mse: Annotated[Float64[np.ndarray, " epochs"], AMOUNT]
    minutes: Annotated[Float64[np.ndarray, " epochs"], AMOUNT]


@dataclass(frozen=True, kw_only=True)
class Training(Result):
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
    train_frames: Annotated[int, AMOUNT]
    validation_frames: Annotated[int, AMOUNT]
    seed: int
    epochs: Annotated[float, AMOUNT]
    """Passes over the training frames, the last maybe in part."""
    minutes: Annotated[float, AMOUNT]
    stopped_by: str
    """`epochs` or `time limit`."""
    best_validation_mse: Annotated[float, AMOUNT]
    """Lowest validation error of the curve, in squared margin units: that of the weights that were kept."""
    parameters: int
    curve: LearningCurve


@dataclass(frozen=True, kw_only=True)
class BinScore:
    """Mean squared error, in margin units, of the frames with a label in [low, high); the last bin holds 1 as well."""

    low: Annotated[float, MARGIN]
    high: Annotated[float, MARGIN]
    frames: Annotated[int, AMOUNT]
    mse: Annotated[float, AMOUNT] | None
    """None without such frames."""


@dataclass(frozen=True, kw_only=True)
class RegressionScores:
    """Errors of predictions against labels, in margin units (squared for `mse`).

    `r2` is None where the labels do not vary, since there is no variance to explain.
    """

    frames: Annotated[int, AMOUNT]
    trials: Annotated[int, AMOUNT]
    mse: Annotated[float, AMOUNT]
    r2: Annotated[float, AT_MOST_ONE] | None
    mae: Annotated[float, AMOUNT]
    bins: tuple[BinScore, ...]


@dataclass(frozen=True, kw_only=True)
class LeadTimes:
    """Warnings before the first gross slip of each trial."""

    trials: int
    """Trials that slip."""
    warned: int
    """Trials that slip after a true alarm."""
    median_ms: float | None
    """From the first true alarm to the slip, over the warned trials; None if there is none."""
    false_per_minute: Annotated[float, AMOUNT]
    """Alarms that begin while the true margin is above twice the threshold, by the minute of labelled touch."""


@dataclass(frozen=True, kw_only=True)
class ScoredFrames(Columns):
    """Label and prediction of each labelled frame, in margin units; what the network does not predict is NaN."""

    trial: Shaped[np.ndarray, " frames"]
    condition: Shaped[np.ndarray, " frames"]
    day: Int64[np.ndarray, " frames"]
    frame: Annotated[Int64[np.ndarray, " frames"], AMOUNT]
    time_s: Annotated[Float64[np.ndarray, " frames"], TIME]
    safety_margin: Annotated[Float64[np.ndarray, " frames"], MARGIN]
    prediction: Annotated[Float64[np.ndarray, " frames"], ANSWER]
    """Not clipped to [0, 1]."""
    sigma: Annotated[Float64[np.ndarray, " frames"], AMOUNT, UNKNOWN]
    """Standard deviation of the prediction; NaN for a network with one number as its output."""
    low_90: Annotated[Float64[np.ndarray, " frames"], MARGIN, UNKNOWN]
    high_90: Annotated[Float64[np.ndarray, " frames"], MARGIN, UNKNOWN]
    """Ends of the interval that should hold 90 % of the labels; NaN for a network that was not calibrated."""
    withheld: Shaped[np.ndarray, " frames"]
    """Reason for which the network withholds the margin, with the cure; empty where it does not. Scores count these
    frames too; figures of a trial leave them out."""


@dataclass(frozen=True, kw_only=True)
class RiskCoverage:
    """Mean absolute errors, in margin units: what a network gains by saying "I do not know"."""

    whole: Annotated[float, AMOUNT]
    """Of all frames."""
    error: dict[str, Annotated[float, AMOUNT]]
    """Without a fifth of the frames, by what is withheld first: `known`, what is least like the training
    (`Estimate.known`); `spread`, the widest distributions; `perfect`, the largest errors (unknown in use)."""

    def __str__(self) -> str:
        """Describe the gain of withholding a fifth of the frames, in one sentence."""
        words = {
            "known": "if those least like its training are",
            "spread": "if those with the widest interval are",
            "perfect": "if the largest errors were known",
        }
        parts = ", ".join(f"{100 * error:.1f} {words[name]}" for name, error in self.error.items())
        whole = f"{100 * self.whole:.1f} points"
        return f"the mean error is {whole}; without the fifth of the frames that the network withholds it is {parts}"


@dataclass(frozen=True, kw_only=True)
class Evaluation(Result):
    """Scores of one network by condition, day and trial, how sure it was, and the predictions behind it all."""

    input: str
    """Name of the encoding that the network sees."""
    split: str
    known_trials: int
    """Trials that trained or validated this network; its scores flatter it where there are any."""
    conditions: dict[str, RegressionScores]
    trials: dict[str, RegressionScores]
    coverage: dict[str, dict[str, Annotated[float, SHARE]]]
    """Share of the labels inside the interval of each level, by condition; empty without a calibration."""
    lead_times: dict[str, LeadTimes]
    """Warnings by condition."""
    predictions: ScoredFrames
    friction: str = ""
    """Coefficient of friction that the margins are conditioned on; empty if none."""
    ratio_r2: dict[str, float | None] = field(default_factory=dict)
    """R2 of the traction ratio F_t / F_n by condition; empty for a network that predicts the margin alone, None
    where the ratio does not vary or no force is known."""
    risk: RiskCoverage | None = None
    """Error with a fifth of the frames withheld; None in a result without it."""

    @property
    def summary(self) -> str:
        """Errors by condition in a sentence."""
        scores = ", ".join(
            f"{name} {'none' if each.r2 is None else f'{each.r2:.3f}'} (MAE {each.mae:.3f} margin units)"
            for name, each in self.conditions.items()
        )
        return f"R2 {scores}; {len(self.predictions):,} frames of {len(self.trials)} {self.split} trials"
