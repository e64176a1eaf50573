"""Errors, coverage and warnings of predictions against labels."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from sliplens.errors import RecordingError
from sliplens.results.evaluation import BinScore, LeadTimes, RegressionScores, RiskCoverage, ScoredFrames


def auroc(positive: Float[np.ndarray, " _"], negative: Float[np.ndarray, " _"]) -> float | None:
    """Area under the receiver operating characteristic: how often a positive scores above a negative; ties count half.

    None where a class is empty.
    """
    if not (len(positive) and len(negative)):
        return None
    from scipy.stats import mannwhitneyu  # noqa: PLC0415 (it takes long to import)

    return float(mannwhitneyu(positive, negative).statistic) / (len(positive) * len(negative))


_COVERED = tuple(round(1 - step / 20, 2) for step in range(20))


def risk_coverage(
    errors: Float[np.ndarray, " frames"], trust: Mapping[str, Float[np.ndarray, " frames"] | None]
) -> RiskCoverage:
    """Compute the mean absolute error of the remaining frames, as more and more of the least trusted are withheld.

    `trust` is that in each frame, by name; None for a measure that the network lacks. `perfect`, the negative error, is
    always added.

    References
    ----------
    El-Yaniv and Wiener, *On the Foundations of Noise-free Selective Classification*, JMLR 2010.
    """
    available = {name: values for name, values in trust.items() if values is not None} | {"perfect": -errors}
    counts = [max(1, round(share * len(errors))) for share in _COVERED]
    means = {
        # stable: frames that are trusted alike are withheld in their order
        name: np.cumsum(errors[np.argsort(-values, kind="stable")]) / np.arange(1, len(errors) + 1)
        for name, values in available.items()
    }
    return RiskCoverage(
        covered=_COVERED,
        error={name: tuple(mean[np.array(counts) - 1].tolist()) for name, mean in means.items()},
    )


THRESHOLD = 0.2
"""A margin below it is an alarm: people hold 20 to 40 % above the least force."""
_FALSE_ABOVE = 2.0
"""An alarm that begins while the true margin is above so many thresholds is false, not early."""


def lead_times(
    trial: Sequence[str],
    time_s: Float[np.ndarray, " frames"],
    labels: Float[np.ndarray, " frames"],
    predictions: Float[np.ndarray, " frames"],
    *,
    threshold: float = THRESHOLD,
) -> LeadTimes:
    """Measure warnings, predictions below a threshold in margin units, on the labelled frames of some trials.

    A slip is the first frame of a trial with margin 0; what comes after is left out.
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


_BINS = 10


def regression_scores(
    labels: Float[np.ndarray, " frames"], predictions: Float[np.ndarray, " frames"], *, trials: int = 1
) -> RegressionScores:
    """MSE, R2, MAE and the MSE in ten bins of the safety margin (Polak, Table 1 and Fig. 7).

    `RecordingError` if there is no frame, or a label lies outside [0, 1].
    """
    if len(labels) == 0:
        raise RecordingError("there is no labelled frame to evaluate; check the split and the condition")
    if not np.all((labels >= 0) & (labels <= 1)):
        raise RecordingError("labels must lie in [0, 1]; give the safety margin as a fraction, not in percent")
    squared = (predictions - labels) ** 2
    spread = np.sum((labels - labels.mean()) ** 2)
    # times ten, rounded: 0.3 * 10 must fall in bin 3 although 0.3 is not exact in binary
    bins = np.minimum(np.floor(np.round(labels * _BINS, 9)), _BINS - 1)
    errors = [squared[bins == index] for index in range(_BINS)]
    means = [float(inside.mean()) if len(inside) else None for inside in errors]
    return RegressionScores(
        frames=len(labels),
        trials=trials,
        mse=float(squared.mean()),
        r2=float(1 - squared.sum() / spread) if spread > 0 else None,
        mae=float(np.abs(predictions - labels).mean()),
        bins=tuple(
            BinScore(low=index / _BINS, high=(index + 1) / _BINS, frames=len(errors[index]), mse=means[index])
            for index in range(_BINS)
        ),
    )


def score_predictions(predictions: ScoredFrames) -> RegressionScores:
    """Errors of some predictions against their labels."""
    count = len(set(predictions.trial.tolist()))
    return regression_scores(predictions.safety_margin, predictions.prediction, trials=count)


def find_lead_times(predictions: ScoredFrames) -> LeadTimes:
    """Warnings of some predictions, see `lead_times`."""
    return lead_times(predictions.trial.tolist(), predictions.time_s, predictions.safety_margin, predictions.prediction)
