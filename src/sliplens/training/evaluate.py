"""How well a network reads the safety margin: errors by condition and by bins of the margin."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Float

from sliplens.errors import RecordingError
from sliplens.models import TrainedModel
from sliplens.models.checkpoint import Estimate, join_estimates
from sliplens.training.data import FrameSet


def coverage(
    low: Float[np.ndarray, " frames"], high: Float[np.ndarray, " frames"], labels: Float[np.ndarray, " frames"]
) -> float:
    """Share of the labels that lie in their intervals, ends included."""
    return float(np.mean((labels >= low) & (labels <= high)))


def coverages(
    estimate: Estimate, labels: Float[np.ndarray, " frames"], rows: Bool[np.ndarray, " frames"]
) -> dict[str, float]:
    """Coverage of the intervals of every calibrated level, on some of the frames; empty without a calibration."""
    if estimate.calibration is None:
        return {}
    found = {}
    for level in estimate.calibration.offsets:
        interval = estimate.interval(float(level))
        assert interval is not None
        found[level] = coverage(interval[0][rows], interval[1][rows], labels[rows])
    return found


def auroc(positive: Float[np.ndarray, " _"], negative: Float[np.ndarray, " _"]) -> float | None:
    """Area under the receiver operating characteristic: how often a positive scores above a negative; ties count half.

    Parameters
    ----------
    positive, negative
        Scores of the two classes.

    Returns
    -------
    float or None
        0.5 where the scores tell nothing apart; None where a class is empty.

    References
    ----------
    Hanley & McNeil, *Radiology* 143 (1982) 29: the area is the Mann-Whitney statistic over the number of pairs.
    """
    if not (len(positive) and len(negative)):
        return None
    ordered = np.sort(negative)
    below = np.searchsorted(ordered, positive, side="left")
    not_above = np.searchsorted(ordered, positive, side="right")
    return float((below + not_above).mean() / 2 / len(negative))


THRESHOLD = 0.2
"""A margin below it is an alarm: people hold 20 to 40 % above the least force."""
_FALSE_ABOVE = 2.0
"""An alarm that begins while the true margin is above so many thresholds is false, not early."""


@dataclass(frozen=True, kw_only=True)
class LeadTimes:
    """Warnings before the first gross slip of each trial."""

    trials: int
    """Trials that slip."""
    warned: int
    """Of these, trials with a true alarm before the slip."""
    median_ms: float | None
    """From the first true alarm to the slip, over the warned trials; None if there is none."""
    ideal_ms: float | None
    """The same for the true margin itself, over the trials that slip."""
    false_per_minute: float
    """Alarms that begin while the true margin is above twice the threshold, by the minute of labelled touch."""
    threshold: float = THRESHOLD


def lead_times(
    trial: Sequence[str],
    time_s: Float[np.ndarray, " frames"],
    labels: Float[np.ndarray, " frames"],
    predictions: Float[np.ndarray, " frames"],
    *,
    threshold: float = THRESHOLD,
) -> LeadTimes:
    """Measure warnings on the labelled frames of some trials.

    A slip is the first frame of a trial with margin 0; what comes after is left out.

    Parameters
    ----------
    trial
        Name of each frame's trial; the frames of a trial follow each other in time.
    time_s, labels, predictions
        Time, true and predicted margin of each frame.
    threshold
        A prediction below it is an alarm.
    """
    names = np.array(trial)
    leads, ideals, slips, false, minutes = [], [], 0, 0, 0.0
    for name in dict.fromkeys(trial):
        rows = np.flatnonzero(names == name)
        order = rows[np.argsort(time_s[rows], kind="stable")]
        slipped = labels[order] <= 0
        slips_at = int(np.argmax(slipped)) if slipped.any() else None
        before = order if slips_at is None else order[:slips_at]
        if not len(before):
            continue
        alarms = predictions[before] < threshold
        begins = np.flatnonzero(alarms & ~np.insert(alarms[:-1], 0, False))
        is_false = labels[before][begins] > _FALSE_ABOVE * threshold
        false += int(is_false.sum())
        minutes += float(time_s[before[-1]] - time_s[before[0]]) / 60
        if slips_at is None:
            continue
        slips += 1
        slip_s = float(time_s[order[slips_at]])
        # an alarm that began in vain and never ended is true from where the margin is low on
        due = alarms & (labels[before] <= _FALSE_ABOVE * threshold)
        if due.any():
            leads.append(1e3 * (slip_s - float(time_s[before[np.argmax(due)]])))
        low = labels[before] < threshold
        ideals.append(1e3 * (slip_s - float(time_s[before[np.argmax(low)]])) if low.any() else 0.0)
    return LeadTimes(
        trials=slips,
        warned=len(leads),
        median_ms=float(np.median(leads)) if leads else None,
        ideal_ms=float(np.median(ideals)) if ideals else None,
        false_per_minute=false / minutes if minutes > 0 else 0.0,
        threshold=threshold,
    )


BIN_COUNT = 10


@dataclass(frozen=True, kw_only=True)
class BinScore:
    """Mean squared error of the frames whose label lies in [low, high); the last bin holds 1 as well."""

    low: float
    high: float
    frames: int
    mse: float | None


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
    """Of the intervals that should hold 90 %, in margin units."""


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Scores by condition, day and trial, how sure the network was, and the predictions behind it all."""

    conditions: dict[str, RegressionScores]
    days: dict[str, RegressionScores]
    """By condition and day."""
    trials: dict[str, RegressionScores]
    reliability: dict[str, Reliability]
    """By condition."""
    wet_auroc: float | None
    """How often the uncertainty of a wet frame is above that of a dry one; None without both, or without a spread."""
    lead_times: dict[str, LeadTimes]
    """By condition."""
    predictions: pa.Table


def regression_scores(
    labels: Float[np.ndarray, " frames"], predictions: Float[np.ndarray, " frames"], *, trials: int = 1
) -> RegressionScores:
    """MSE, R2, MAE and the MSE in ten bins of the safety margin.

    Raises
    ------
    RecordingError
        If there is no frame, or a label lies outside [0, 1].

    References
    ----------
    Polak, Table 1 and Fig. 7.
    """
    if len(labels) == 0:
        raise RecordingError("there is no labelled frame to evaluate; check the split and the condition")
    if not np.all((labels >= 0) & (labels <= 1)):
        raise RecordingError("labels must lie in [0, 1]; give the safety margin as a fraction, not in percent")
    squared = (predictions - labels) ** 2
    spread = np.sum((labels - labels.mean()) ** 2)
    return RegressionScores(
        frames=len(labels),
        trials=trials,
        mse=float(squared.mean()),
        r2=float(1 - squared.sum() / spread) if spread > 0 else None,
        mae=float(np.abs(predictions - labels).mean()),
        bins=tuple(_bin_scores(labels, squared)),
    )


def _bin_scores(labels: Float[np.ndarray, " frames"], squared: Float[np.ndarray, " frames"]) -> list[BinScore]:
    # times ten, rounded: 0.3 * 10 must fall in bin 3 although 0.3 is not exact in binary
    bins = np.minimum(np.floor(np.round(labels * BIN_COUNT, 9)), BIN_COUNT - 1)
    scores = []
    for index in range(BIN_COUNT):
        inside: Bool[np.ndarray, " frames"] = bins == index
        count = int(inside.sum())
        scores.append(
            BinScore(
                low=index / BIN_COUNT,
                high=(index + 1) / BIN_COUNT,
                frames=count,
                mse=float(squared[inside].mean()) if count else None,
            )
        )
    return scores


def evaluate(
    trained: TrainedModel,
    frames: FrameSet,
    *,
    batch_size: int = 64,
    on_batch: Callable[[int, int], None] | None = None,
) -> Evaluation:
    """Predict every frame and score each condition by itself.

    Parameters
    ----------
    trained
        The network; `frames` must be in its encoding and size.
    on_batch
        Called with the number of frames done and the number of all.
    """
    count = len(frames)
    if not count:
        raise RecordingError("there is no labelled frame to evaluate; check the split and the condition")
    parts = []
    for start in range(0, count, batch_size):
        rows = range(start, min(start + batch_size, count))
        parts.append(trained.estimate(frames.__getitems__(rows)[0], batch_size=batch_size))
        if on_batch is not None:
            on_batch(rows.stop, count)
    estimate = join_estimates(parts)
    predictions = estimate.margin
    labels = frames.safety_margin.numpy().astype(np.float64)
    condition, trial = np.array(frames.condition), np.array(frames.trial)
    table = pa.table(
        {
            "trial": list(frames.trial),
            "condition": list(frames.condition),
            "day": list(frames.day),
            "frame": list(frames.frame),
            "time_s": frames.time_s,
            "safety_margin": labels,
            "prediction": predictions,
            **_told_uncertainty(estimate),
        }
    )

    def score(rows: Bool[np.ndarray, " frames"]) -> RegressionScores:
        return regression_scores(labels[rows], predictions[rows], trials=len(set(trial[rows])))

    day = np.array(frames.day)
    by_condition = {name: condition == name for name in sorted(set(frames.condition))}
    by_day = {
        f"{name}, day {number}": rows & (day == number)
        for name, rows in by_condition.items()
        for number in sorted(set(day[rows].tolist()))
    }
    sigma = estimate.sigma
    wet = by_condition.get("wet")
    dry = by_condition.get("dry")
    return Evaluation(
        conditions={name: score(rows) for name, rows in by_condition.items()},
        days={name: score(rows) for name, rows in by_day.items()},
        trials={name: score(trial == name) for name in dict.fromkeys(frames.trial)},
        reliability={name: _reliability(estimate, labels, rows) for name, rows in by_condition.items()},
        wet_auroc=None if sigma is None or wet is None or dry is None else auroc(sigma[wet], sigma[dry]),
        lead_times={
            name: lead_times(trial[rows].tolist(), frames.time_s[rows], labels[rows], predictions[rows])
            for name, rows in by_condition.items()
        },
        predictions=table,
    )


def _told_uncertainty(estimate: Estimate) -> dict[str, Float[np.ndarray, " frames"]]:
    """Columns of the standard deviation and of the 90 % interval, as far as the network tells them."""
    columns = {} if estimate.sigma is None else {"sigma": estimate.sigma}
    interval = estimate.interval(0.9)
    return columns if interval is None else {**columns, "low_90": interval[0], "high_90": interval[1]}


def _reliability(
    estimate: Estimate, labels: Float[np.ndarray, " frames"], rows: Bool[np.ndarray, " frames"]
) -> Reliability:
    interval = estimate.interval(0.9)
    return Reliability(
        coverage=coverages(estimate, labels, rows),
        mean_width_90=None if interval is None else float((interval[1] - interval[0])[rows].mean()),
    )
