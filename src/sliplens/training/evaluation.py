"""Evaluation of a network on labelled trials, beside estimators that use the markers alone."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from sliplens.codec import keep_part, load_result, save_result
from sliplens.errors import InputError, RecordingError
from sliplens.extras import import_cv2, pick
from sliplens.files import output_folder, scratch_folder
from sliplens.friction import Friction, FrictionLike, as_friction
from sliplens.markers import KINDS, MarkerStatus, track_markers
from sliplens.markers.estimators import ESTIMATORS, FieldTrial, field_trial, get_estimator
from sliplens.models import Network
from sliplens.models.checkpoint import Estimate, condition_each, open_run
from sliplens.models.sequence import require_frequent
from sliplens.progress import OnProgress, add_note, open_stage, report_each, report_file, reporting
from sliplens.recordings import Dataset, TrialInfo
from sliplens.recordings.dataset import load_dataset, trial_path
from sliplens.recordings.store import stream_frames
from sliplens.results.evaluation import (
    BaselinePredictions,
    Baselines,
    BaselineScores,
    Evaluation,
    RegressionScores,
    Reliability,
    ScoredFrames,
)
from sliplens.training.data import FrameSet, load_frames
from sliplens.training.metrics import auroc, find_lead_times, risk_coverage, score_predictions


@dataclass(frozen=True, kw_only=True)
class BaselinePlan:
    """Estimators, and the trials that they are fitted on."""

    estimators: tuple[str, ...]
    """Rows of `ESTIMATORS`."""
    training: tuple[TrialInfo, ...]
    offered_trials: int
    """Training trials of the data set."""
    markers: str
    """Row of `markers.KINDS`."""


@dataclass(frozen=True, kw_only=True)
class _Followed(FieldTrial):
    """Displacements of a trial, and the share of its markers that was followed."""

    in_view: int
    """Markers of all frames that were in view."""
    followed: int


def marker_kind(trials: Sequence[TrialInfo]) -> str:
    """Return the row of `KINDS` for the trials' sensors, such as chromatouch-3; `auto` if they differ or have none."""
    kinds = {next((kind for kind in KINDS if f"{trial.sensor}-".startswith(f"{kind}-")), "auto") for trial in trials}
    return kinds.pop() if len(kinds) == 1 else "auto"


def choose_training(trials: Sequence[TrialInfo], count: int) -> tuple[TrialInfo, ...]:
    """Take a number of trials spread evenly over the table, so that every day has its share."""
    if count < 1:
        raise InputError(f"{count} training trials are too few to fit on; give --baseline-trials 1 or more")
    at = np.linspace(0, len(trials) - 1, min(count, len(trials))).round().astype(int)
    return tuple(trials[index] for index in at)


def evaluate_baselines(
    plan: BaselinePlan,
    data: Dataset,
    predictions: ScoredFrames,
    *,
    folder: Path,
) -> tuple[Baselines, BaselinePredictions]:
    """Follow markers, fit estimators on training trials, and score them on the frames that a network was scored on.

    The folder keeps the displacements of each trial for an interrupted evaluation.
    """
    estimators = {name: get_estimator(name) for name in plan.estimators}
    tested = set(predictions.trial.tolist())
    trials = {info.trial: info for info in (*plan.training, *(info for info in data.trials if info.trial in tested))}
    fields: dict[str, _Followed] = {}
    failed: dict[str, str] = {}
    for info in report_each(trials.values()):
        try:
            fields[info.trial] = keep_part(folder / info.trial, _Followed, partial(_follow, data, info, plan.markers))
        except RecordingError:
            raise
        except InputError as error:
            failed[info.trial] = str(error)
    fitted = [info for info in plan.training if info.trial in fields]
    for part, usable in (("training", fitted), ("tested", tested - set(failed))):
        if not usable:
            name, why = next(iter(failed.items()))
            raise InputError(
                f"markers were followed in none of the {part} trials ({name}: {why}); name another kind with --markers"
            )
    margins = [_margins(data, info) for info in fitted]
    mean = float(np.nanmean(np.concatenate(margins)))
    answers = {}
    for name, estimator in estimators.items():
        estimator.fit([fields[info.trial] for info in fitted], margins)
        prediction = np.full(len(predictions), mean)
        for trial in tested & set(fields):
            rows = predictions.trial == trial
            prediction[rows] = estimator.estimate(fields[trial])[predictions.frame[rows]]
        answers[name] = replace(predictions, prediction=prediction)
    scores = Baselines(
        markers=plan.markers,
        hold="found in each trial as a whole, by find_hold",
        offered_trials=plan.offered_trials,
        training_trials=len(fitted),
        known_trials=0,
        shared_trials=sum(info.trial in tested for info in plan.training),
        training_frames=sum(int(np.isfinite(margin).sum()) for margin in margins),
        followed=sum(some.followed for some in fields.values()) / max(1, sum(some.in_view for some in fields.values())),
        failed=failed,
        estimators={name: _score(answer) for name, answer in answers.items()},
    )
    frames = len(predictions)
    return scores, BaselinePredictions(
        estimator=np.repeat(list(answers), frames),
        trial=np.tile(predictions.trial, len(answers)),
        frame=np.tile(predictions.frame, len(answers)),
        prediction=np.concatenate([answer.prediction for answer in answers.values()]),
    )


def _follow(data: Dataset, info: TrialInfo, kind: str) -> _Followed:
    reference = data.read_labels(info).reference
    tracks = track_markers(stream_frames(trial_path(data.folder, info.trial)), reference, kind)
    return _Followed(
        **vars(field_trial(tracks)),
        in_view=int((tracks.status != MarkerStatus.OUTSIDE).sum()),
        followed=int(tracks.followed.sum()),
    )


def _margins(data: Dataset, info: TrialInfo) -> Float[np.ndarray, " frames"]:
    recording = data.read_labels(info)
    return np.where(recording.labelled, recording.safety_margin, np.nan)


def _score(answers: ScoredFrames) -> BaselineScores:
    conditions = {name: rows for (name,), rows in sorted(answers.groups("condition").items())}
    return BaselineScores(
        conditions={name: score_predictions(rows) for name, rows in conditions.items()},
        lead_times={name: find_lead_times(rows) for name, rows in conditions.items()},
    )


EACH = "each"
"""Value of `friction` for the known friction of every trial."""


def evaluate(
    run: Network | Path | str,
    data: Dataset | Path | str,
    out: Path | str | None = None,
    *,
    split: str = "test",
    friction: FrictionLike | None = None,
    sequence: bool = False,
    baselines: Sequence[str] = (),
    baseline_trials: int = 40,
    markers: str | None = None,
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
    sequence
        If True, predict each trial in order, as `predict` does; frames without a label are left out.
    baselines, baseline_trials
        Estimators to put beside the network, rows of `markers.estimators.ESTIMATORS` or `all`, and how many training
        trials they are fitted on, spread evenly over those of the data set.
    markers
        Kind of markers, a row of `markers.KINDS`; by the sensor's name if None.
    overwrite
        If True, replace a folder `out` of other settings.
    on_progress
        Callback for progress.
    """
    network = open_run(run)
    prior = None if friction is None else EACH if friction == EACH else as_friction(friction)
    if prior is not None:
        network.require_ratio()
    if sequence:
        network.follow(friction=prior)
    data = data if isinstance(data, Dataset) else load_dataset(data)
    trials = data.select(split=split)
    for trial in trials:
        network.require_frame_size((trial.height, trial.width))
    plan = _plan_baselines(baselines, data, trials, count=baseline_trials, markers=markers) if baselines else None

    def compute(folder: Path) -> Evaluation:
        with open_stage(f"Reading {split} trials ({network.manifest.input})"):
            frames = load_frames(data, trials, encoding=network.encoding, image_size=network.manifest.image_size)
        with open_stage("Predicting frames"):
            evaluation = evaluate_frames(network, frames, split=split, friction=prior, sequence=sequence)
        evaluation = replace(evaluation, known_trials=len(find_training_trials(trials, network)))
        if plan is None:
            return evaluation
        fields = folder / "fields"
        with open_stage("Following markers"):
            scores, predictions = evaluate_baselines(plan, data, evaluation.predictions, folder=fields)
        shutil.rmtree(fields)
        scores = replace(scores, known_trials=len(find_training_trials(plan.training, network)))
        return replace(evaluation, baselines=scores, baseline_predictions=predictions)

    with reporting(on_progress):
        firsts = map(data.read_labels, {trial.sensor: trial for trial in reversed(trials)}.values())
        doubts = [
            words for first in firsts for words in (network.doubt(first.sensor), network.doubt_colour(first.reference))
        ]
        if isinstance(prior, Friction):
            doubts.append(network.doubt_friction(prior))
        for words in dict.fromkeys(filter(None, doubts)):
            add_note(words)
        if out is None:
            with scratch_folder() as folder:
                return compute(folder)
        recipe = {
            "weights_sha256": network.manifest.weights_sha256,
            "data_hash": data.hash,
            "input": network.manifest.input,
            "split": split,
            "friction": prior.digest if isinstance(prior, Friction) else prior,
            "sequence": network.manifest.sequence if sequence else None,
            "baselines": plan,
        }
        recipe = {name: value for name, value in recipe.items() if value is not None}
        with output_folder(Path(out), stage="evaluate", config=recipe, overwrite=overwrite) as output:
            if output.complete:
                evaluation = load_result(output.folder, Evaluation, command="sliplens evaluate")
            else:
                evaluation = compute(output.folder)
                save_result(evaluation, output.folder)
        report_file(Path(out), "scores and predictions", kept=output.complete)
        return evaluation


def find_training_trials(trials: Sequence[TrialInfo], network: Network) -> tuple[TrialInfo, ...]:
    """Find the trials that trained or validated a network, or the network it started from, by hashes of their files."""
    return tuple(trial for trial in trials if trial.sha256[:12] in network.manifest.trained_on)


def _plan_baselines(
    names: Sequence[str], data: Dataset, trials: Sequence[TrialInfo], *, count: int, markers: str | None
) -> BaselinePlan:
    """Check the request before anything is computed."""
    names = tuple(ESTIMATORS) if tuple(names) == ("all",) else tuple(names)
    for name in names:
        get_estimator(name)
    import_cv2()
    offered = tuple(trial for trial in data.trials if trial.split == "train")
    if not offered:
        raise InputError(f"{data.folder} has no training trials to fit baselines on; divide it with `sliplens split`")
    training = choose_training(offered, count)
    kind = marker_kind((*training, *trials)) if markers is None else pick(KINDS, markers, noun="kind of markers").name
    return BaselinePlan(estimators=names, training=training, offered_trials=len(offered), markers=kind)


def evaluate_frames(
    network: Network,
    frames: FrameSet,
    *,
    split: str = "test",
    friction: FrictionLike | None = None,
    sequence: bool = False,
    batch_size: int = 64,
) -> Evaluation:
    """Predict the frames of `load_frames`, and score the predictions for each condition and trial.

    `friction` (a coefficient) and `sequence` as `evaluate` takes them.
    """
    if not len(frames):
        raise RecordingError("there is no labelled frame to evaluate; check the split and the condition")
    names = np.array(frames.trial)
    for name in np.unique(names) if sequence else ():
        require_frequent(np.sort(frames.time_s[names == name]), what=f"the trial {name}")
    batches = frames.batches(batch_size, report=True)
    if friction == EACH:
        traction = network.require_ratio()
        if not np.isfinite(frames.friction).all():
            raise RecordingError("not every trial has a coefficient of friction; set it with --friction")
        quantiles = np.array(traction.friction)
        estimate = network.estimate_batches(batches)
        estimate = condition_each(estimate, frames.friction, trained_friction=quantiles, calibration=traction.told)
    else:
        estimate = network.estimate_batches(batches, friction=friction)
    if sequence:
        estimate = _follow_trials(network, estimate, frames.trial, frames.time_s)
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
    wet, dry = conditions.get("wet"), conditions.get("dry")

    def score(groups: dict[str, Bool[np.ndarray, " frames"]]) -> dict[str, RegressionScores]:
        return {name: score_predictions(predictions.where(rows)) for name, rows in groups.items()}

    def reliability(rows: Bool[np.ndarray, " frames"]) -> Reliability:
        covered = {level: (low <= labels) & (labels <= high) for level, (low, high) in intervals.items()}
        return Reliability(coverage={level: float(inside[rows].mean()) for level, inside in covered.items()})

    return Evaluation(
        input=network.manifest.input,
        split=split,
        known_trials=0,
        conditions=score(conditions),
        trials=score(trials),
        reliability={name: reliability(rows) for name, rows in conditions.items()},
        wet_auroc=None if sigma is None or wet is None or dry is None else auroc(sigma[wet], sigma[dry]),
        lead_times={name: find_lead_times(predictions.where(rows)) for name, rows in conditions.items()},
        predictions=predictions,
        risk=risk_coverage(
            np.abs(predictions.prediction - predictions.safety_margin),
            {"known": estimate.known, "spread": None if sigma is None else -sigma},
        ),
        sequence=sequence,
        friction="that of each trial, told exactly" if friction == EACH else str(estimate.friction or ""),
        ratio_r2={} if estimate.ratio is None else _ratio_r2(estimate.ratio.mean, frames),
    )


def _follow_trials(
    network: Network, estimate: Estimate, trial: Sequence[str], time_s: Float[np.ndarray, " frames"]
) -> Estimate:
    """Correct the frames of each trial in the order of their times (`Follower`); all of them touch."""
    assert estimate.probabilities is not None
    margin, probabilities = np.empty_like(estimate.margin), np.empty_like(estimate.probabilities)
    names, calibration, alone = np.array(trial), None, np.zeros(len(estimate.margin), dtype=bool)
    for name in dict.fromkeys(trial):
        rows = np.flatnonzero(names == name)
        rows = rows[np.argsort(time_s[rows], kind="stable")]
        part = network.follow().update(estimate.at(rows), time_s[rows], np.ones(len(rows), dtype=bool))
        assert part.probabilities is not None
        margin[rows], probabilities[rows], calibration = part.margin, part.probabilities, part.calibration
        alone[rows] = False if part.alone is None else part.alone[0]
    single = (alone, estimate.calibration) if alone.any() else None
    return replace(estimate, margin=margin, probabilities=probabilities, calibration=calibration, alone=single)


def _ratio_r2(ratio: Float[np.ndarray, " frames"], frames: FrameSet) -> dict[str, float | None]:
    truth, condition = frames.traction_ratio.double().numpy(), np.array(frames.condition)
    scores: dict[str, float | None] = {}
    for name in sorted(set(frames.condition)):
        rows = (condition == name) & np.isfinite(truth)
        variance = float(truth[rows].var()) if rows.any() else 0.0
        scores[name] = 1 - float(np.mean((ratio - truth)[rows] ** 2)) / variance if variance > 0 else None
    return scores
