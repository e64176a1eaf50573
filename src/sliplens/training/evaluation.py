"""Evaluation of a network on labelled trials: errors, coverage, warnings."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from sliplens.codec import load_result
from sliplens.errors import RecordingError
from sliplens.friction import Friction, FrictionLike, as_friction
from sliplens.models import Network
from sliplens.models.wrapping import open_run
from sliplens.progress import OnProgress, add_note, open_stage, reporting
from sliplens.recordings import Dataset
from sliplens.recordings.dataset import load_dataset
from sliplens.results.evaluation import (
    BinScore,
    Evaluation,
    LeadTimes,
    RegressionScores,
    RiskCoverage,
    ScoredFrames,
)
from sliplens.runner import keep_record
from sliplens.training.data import FrameSet, load_frames

EACH = "each"
"""Value of `friction` for the known friction of every trial."""


def evaluate(
    run: Network | Path | str,
    data: Dataset | Path | str,
    out: Path | str | None = None,
    *,
    split: str = "test",
    friction: FrictionLike | None = None,
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
) -> Evaluation:
    """Measure how well a network predicts the safety margin of labelled trials.

    Parameters
    ----------
    run
        The network, its folder, or the name of one that comes with sliplens.
    data
        Data set with labels, or its folder.
    out
        Folder to write, with `result.json` and `predictions.parquet`; nothing is written if None.
    split
        Which trials of the data set.
    friction
        Coefficient of friction, as `predict` takes it; `each` takes that of every trial from its labels. It needs a
        network that predicts F_t / F_n.
    overwrite
        If True, replace a folder `out` of other settings.
    on_progress
        Callback for progress.

    See Also
    --------
    predict : Predict without labels.
    score : Measure the faithfulness of explanations.

    Examples
    --------
    >>> import sliplens as sl
    >>> data = sl.simulate(dry_trials=3, wet_trials=0, days=2, frames_per_trial=20)  # doctest: +SKIP
    >>> round(sl.evaluate("chromatouch-pair", data).conditions["dry"].r2, 2)  # doctest: +SKIP
    0.85
    """
    network = open_run(run)
    prior = None if friction is None else EACH if friction == EACH else as_friction(friction)
    if prior is not None:
        network.require_ratio()
    data = data if isinstance(data, Dataset) else load_dataset(data)
    trials = data.select(split=split)
    for trial in trials:
        network.require_frame_size((trial.height, trial.width))

    def compute() -> Evaluation:
        with open_stage(f"Reading {split} trials ({network.manifest.input})"):
            frames = load_frames(data, trials, encoding=network.encoding, image_size=network.manifest.image_size)
        with open_stage("Predicting frames"):
            evaluation = evaluate_frames(network, frames, split=split, friction=prior)
        # trials that trained or validated the network, or the one it started from, by hashes of their files
        return replace(
            evaluation, known_trials=sum(trial.sha256[:12] in network.manifest.trained_on for trial in trials)
        )

    with reporting(on_progress):
        doubts = network.doubts(friction=prior if isinstance(prior, Friction) else None)
        for first in map(data.read_labels, {trial.sensor: trial for trial in reversed(trials)}.values()):
            doubts += network.doubts(sensor=first.sensor, frame=first.reference)
        for words in dict.fromkeys(doubts):
            add_note(words)
        if out is None:
            return compute()
        recipe = {
            "weights_sha256": network.manifest.weights_sha256,
            "data_hash": data.hash,
            "input": network.manifest.input,
            "split": split,
            "friction": prior.digest if isinstance(prior, Friction) else prior,
        }
        folder, what = Path(out), "scores and predictions"
        keep_record(folder, lambda _: compute(), stage="evaluate", config=recipe, what=what, overwrite=overwrite)
    return load_result(folder, Evaluation, command="sliplens evaluate")


def evaluate_frames(
    network: Network, frames: FrameSet, *, split: str = "test", friction: FrictionLike | None = None
) -> Evaluation:
    """Predict the frames of `load_frames`, and score the predictions for each condition and trial.

    `friction`: a coefficient, as `evaluate` takes it.
    """
    batches = frames.batches(64, report=True)
    if friction == EACH:
        traction = network.require_ratio()
        if not np.isfinite(frames.friction).all():
            raise RecordingError("not every trial has a coefficient of friction; set it with --friction")
        estimate = network.estimate(batches).with_friction(frames.friction, traction)
    else:
        estimate = network.estimate(batches, friction=friction)
    levels = estimate.calibration.offsets if estimate.calibration else ()
    intervals = {level: ends for level in levels if (ends := estimate.interval(float(level)))}
    unknown, sigma = np.full(len(frames), np.nan), estimate.sigma
    low_90, high_90 = intervals.get("0.9", (unknown, unknown))
    predictions = ScoredFrames(
        trial=np.array(frames.trial),
        condition=np.array(frames.condition),
        day=np.array(frames.day),
        frame=np.array(frames.frame),
        time_s=frames.time_s,
        safety_margin=frames.safety_margin.numpy().astype(np.float64),
        prediction=estimate.margin,
        sigma=unknown if sigma is None else sigma,
        low_90=low_90,
        high_90=high_90,
        withheld=np.array([reason or "" for reason in estimate.withheld(np.ones(len(frames), dtype=bool))]),
    )
    labels = predictions.safety_margin
    conditions = {name: predictions.condition == name for name in sorted(set(frames.condition))}
    trials = {name: predictions.trial == name for name in dict.fromkeys(frames.trial)}

    def score(groups: dict[str, Bool[np.ndarray, " frames"]]) -> dict[str, RegressionScores]:
        return {name: regression_scores(predictions.where(rows)) for name, rows in groups.items()}

    ratio_r2, ratios = {}, frames.traction_ratio.double().numpy()
    if estimate.ratio is not None:
        predicted, finite = estimate.ratio.mean, np.isfinite(ratios)
        ratio_r2 = {name: _r2(ratios[rows & finite], predicted[rows & finite]) for name, rows in conditions.items()}
    covered = {level: (low <= labels) & (labels <= high) for level, (low, high) in intervals.items()}
    return Evaluation(
        input=network.manifest.input,
        split=split,
        known_trials=0,
        conditions=score(conditions),
        trials=score(trials),
        coverage={
            name: {level: float(inside[rows].mean()) for level, inside in covered.items()}
            for name, rows in conditions.items()
        },
        lead_times={name: lead_times(predictions.where(rows)) for name, rows in conditions.items()},
        predictions=predictions,
        risk=risk_coverage(
            np.abs(predictions.prediction - predictions.safety_margin),
            {"known": estimate.known, "spread": None if sigma is None else -sigma},
        ),
        friction="that of each trial, given exactly" if friction == EACH else str(estimate.friction or ""),
        ratio_r2=ratio_r2,
    )


def _r2(truth: Float[np.ndarray, " _"], predicted: Float[np.ndarray, " _"]) -> float | None:
    """Compute the share of the variance that is explained; None where nothing varies."""
    spread = np.sum((truth - truth.mean()) ** 2) if len(truth) else 0.0
    return float(1 - np.sum((predicted - truth) ** 2) / spread) if spread > 0 else None


def risk_coverage(
    errors: Float[np.ndarray, " frames"], trust: dict[str, Float[np.ndarray, " frames"] | None]
) -> RiskCoverage:
    """Compute the mean absolute error without the fifth of the frames that is trusted least.

    `trust` is that in each frame, by name; None for a measure that the network lacks. `perfect`, the negative error, is
    always added.

    References
    ----------
    El-Yaniv and Wiener, *On the Foundations of Noise-free Selective Classification*, JMLR 2010.
    """
    answered = max(1, round(0.8 * len(errors)))
    # stable: frames that are trusted alike are withheld in their order
    surest = {
        name: errors[np.argsort(-values, kind="stable")[:answered]]
        for name, values in (trust | {"perfect": -errors}).items()
        if values is not None
    }
    means = {name: float(rest.mean()) for name, rest in surest.items()}
    return RiskCoverage(whole=float(errors.mean()), error=means)


THRESHOLD = 0.2
"""A margin below it is an alarm: people hold 20 to 40 % above the least force."""


def lead_times(predictions: ScoredFrames) -> LeadTimes:
    """Measure warnings, predictions below `THRESHOLD`, on the labelled frames of some trials.

    A slip is the first frame of a trial with margin 0; what comes after is left out.
    """
    leads, slips, false, minutes = [], 0, 0, 0.0
    for trial in predictions.groups("trial").values():
        frames = trial.where(np.argsort(trial.time_s, kind="stable"))
        slip = np.flatnonzero(frames.safety_margin <= 0)[:1].tolist()
        before = frames.where(np.arange(*slip or [len(frames)]))
        if not len(before):
            continue
        alarms, high = before.prediction < THRESHOLD, before.safety_margin > 2 * THRESHOLD
        begins = alarms & ~np.insert(alarms[:-1], 0, False)  # while the margin is high, false, not early
        false += int((begins & high).sum())
        minutes += float(before.time_s[-1] - before.time_s[0]) / 60
        slips += len(slip)
        # an alarm that began in vain and never ended is true from where the margin is low on
        due = np.flatnonzero(alarms & ~high)[:1]
        leads += [1e3 * float(frames.time_s[at] - before.time_s[first]) for at in slip for first in due]
    return LeadTimes(
        trials=slips,
        warned=len(leads),
        median_ms=float(np.median(leads)) if leads else None,
        false_per_minute=false / minutes if minutes > 0 else 0.0,
    )


_BINS = 10


def regression_scores(predictions: ScoredFrames) -> RegressionScores:
    """MSE, R2, MAE and the MSE in ten bins of the safety margin (Polak, Table 1 and Fig. 7)."""
    labels, error = predictions.safety_margin, predictions.prediction - predictions.safety_margin
    # times ten, rounded: 0.3 * 10 must fall in bin 3 although 0.3 is not exact in binary
    bins = np.minimum(np.floor(np.round(labels * _BINS, 9)), _BINS - 1)
    errors = [error[bins == index] ** 2 for index in range(_BINS)]
    means = [float(inside.mean()) if len(inside) else None for inside in errors]
    return RegressionScores(
        frames=len(labels),
        trials=len(set(predictions.trial.tolist())),
        mse=float((error**2).mean()),
        r2=_r2(labels, predictions.prediction),
        mae=float(np.abs(error).mean()),
        bins=tuple(
            BinScore(low=index / _BINS, high=(index + 1) / _BINS, frames=len(errors[index]), mse=means[index])
            for index in range(_BINS)
        ),
    )
