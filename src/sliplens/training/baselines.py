"""What markers alone tell: model-based estimators, fitted on training trials and scored as a network is."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sliplens.codec import keep_part
from sliplens.errors import InputError, RecordingError
from sliplens.markers import KINDS, MarkerStatus, track_markers
from sliplens.markers.estimators import FieldTrial, field_trial, get_estimator
from sliplens.progress import OnProgress, counted
from sliplens.recordings import Dataset, TrialInfo
from sliplens.recordings.dataset import trial_path
from sliplens.recordings.store import load_recording, stream_frames
from sliplens.results.evaluation import BaselinePredictions, Baselines, BaselineScores, Predictions
from sliplens.training.metrics import find_lead_times, score_predictions


@dataclass(frozen=True, kw_only=True)
class BaselinePlan:
    """Which estimators are fitted on which trials."""

    estimators: tuple[str, ...]
    """Rows of `ESTIMATORS`."""
    training: tuple[TrialInfo, ...]
    offered_trials: int
    """Training trials of the data set."""
    markers: str
    """Row of `markers.KINDS`."""


@dataclass(frozen=True, kw_only=True)
class _Followed(FieldTrial):
    """Displacements of a trial, and how well its markers were followed."""

    in_view: int
    """Markers of all frames that were in view."""
    followed: int


def marker_kind(trials: Sequence[TrialInfo]) -> str:
    """Row of `KINDS` that the trials' sensors are named for, such as chromatouch-3; `auto` where there is not one."""
    kinds = {next((kind for kind in KINDS if f"{trial.sensor}-".startswith(f"{kind}-")), "auto") for trial in trials}
    return kinds.pop() if len(kinds) == 1 else "auto"


def choose_training(trials: Sequence[TrialInfo], count: int) -> tuple[TrialInfo, ...]:
    """Take a number of trials spread evenly over the table, so that every day has its share."""
    if count < 1:
        raise InputError(f"{count} training trials are too few to fit on; give --baseline-trials 1 or more")
    at = np.linspace(0, len(trials) - 1, min(count, len(trials))).round().astype(int)
    return tuple(trials[index] for index in at)


def evaluate_baselines(
    plan: BaselinePlan, data: Dataset, predictions: Predictions, *, folder: Path, on_progress: OnProgress | None = None
) -> tuple[Baselines, BaselinePredictions]:
    """Follow markers, fit estimators on training trials, and score them on the very frames a network was scored on.

    The folder keeps the field of each trial: those that are there are not followed again.
    """
    estimators = {name: get_estimator(name) for name in plan.estimators}
    tested = set(predictions.trial.tolist())
    trials = {info.trial: info for info in (*plan.training, *(info for info in data.trials if info.trial in tested))}
    fields: dict[str, _Followed] = {}
    failed: dict[str, str] = {}
    for info in counted(trials.values(), on_progress):
        try:
            fields[info.trial] = keep_part(folder / info.trial, _Followed, partial(_follow, data, info, plan.markers))
        except RecordingError:
            raise
        except InputError as error:
            failed[info.trial] = str(error)
    fitted = [info for info in plan.training if info.trial in fields]
    for what, usable in (("training", fitted), ("tested", tested - set(failed))):
        if not usable:
            name, why = next(iter(failed.items()))
            raise InputError(
                f"markers were followed in none of the {what} trials ({name}: {why}); name another kind with --markers"
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
        hold="found in each trial as a whole, by find_hold; by each frame for itself where causal",
        offered_trials=plan.offered_trials,
        training_trials=len(fitted),
        known_trials=0,
        shared_trials=sum(info.trial in tested for info in plan.training),
        training_frames=sum(int(np.isfinite(margin).sum()) for margin in margins),
        followed=sum(one.followed for one in fields.values()) / max(1, sum(one.in_view for one in fields.values())),
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
    path = trial_path(data.folder, info.trial)
    reference = load_recording(path, truth=False, pixels=False).reference
    tracks = track_markers(stream_frames(path), reference, kind)
    known = tracks.from_reference
    return _Followed(
        **vars(field_trial(tracks)),
        in_view=int((tracks.status[:, known] != MarkerStatus.OUTSIDE).sum()),
        followed=int(tracks.followed[:, known].sum()),
    )


def _margins(data: Dataset, info: TrialInfo) -> Float[np.ndarray, " frames"]:
    recording = load_recording(trial_path(data.folder, info.trial), truth=False, pixels=False)
    return np.where(recording.labelled, recording.safety_margin, np.nan)


def _score(answers: Predictions) -> BaselineScores:
    conditions = {name: rows for (name,), rows in sorted(answers.groups("condition").items())}
    return BaselineScores(
        conditions={name: score_predictions(rows) for name, rows in conditions.items()},
        lead_times={name: find_lead_times(rows) for name, rows in conditions.items()},
    )
