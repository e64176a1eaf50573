"""What markers alone tell: model-based estimators, fitted on training trials and scored as a network is."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
from jaxtyping import Float

from sliplens.errors import InputError, RecordingError
from sliplens.markers import KINDS, MarkerStatus, track_markers
from sliplens.markers.estimators import FieldTrial, field_trial, get_estimator
from sliplens.recordings import Dataset, TrialInfo
from sliplens.recordings.dataset import trial_path
from sliplens.recordings.store import load_recording, stream_frames
from sliplens.training.evaluate import LeadTimes, RegressionScores, lead_times, regression_scores

_KEYS = ("trial", "condition", "frame", "time_s", "safety_margin")


@dataclass(frozen=True, kw_only=True)
class BaselineScores:
    """How well one estimator reads the margin, by condition."""

    conditions: dict[str, RegressionScores]
    lead_times: dict[str, LeadTimes]


@dataclass(frozen=True, kw_only=True)
class Baselines:
    """Scores of estimators, and what they were fitted on."""

    markers: str
    """Kind of markers that was followed."""
    training_trials: int
    training_frames: int
    """With a label."""
    followed: float
    """Share of markers followed while in view, over all frames of the trials fitted on and scored."""
    failed: dict[str, str]
    """Trials in which no field could be followed, and why: not fitted on, and answered with the training mean."""
    estimators: dict[str, BaselineScores]
    predictions: pa.Table = field(repr=False)
    """Frames as in the network's predictions, a column an estimator."""
    hold: str = "found in each trial as a whole, by find_hold"
    """Where the frame comes from from which motion is counted."""


@dataclass(frozen=True, kw_only=True)
class _Followed:
    trial: FieldTrial
    in_view: int
    """Markers of all frames that were in view."""
    followed: int


def marker_kind(trials: Sequence[TrialInfo]) -> str:
    """Row of `KINDS` that the trials' sensors are named for, such as chromatouch-3; `auto` where there is not one."""
    kinds = {next((kind for kind in KINDS if f"{trial.sensor}-".startswith(f"{kind}-")), "auto") for trial in trials}
    return kinds.pop() if len(kinds) == 1 else "auto"


def choose_training(trials: Sequence[TrialInfo], count: int) -> tuple[TrialInfo, ...]:
    """Take a number of trials spread evenly over the table, so that every day has its share.

    Raises
    ------
    InputError
        If the number is less than 1.
    """
    if count < 1:
        raise InputError(f"{count} training trials are too few to fit on; give --baseline-trials 1 or more")
    at = np.linspace(0, len(trials) - 1, min(count, len(trials))).round().astype(int)
    return tuple(trials[index] for index in at)


def evaluate_baselines(
    names: Sequence[str],
    data: Dataset,
    *,
    training: Sequence[TrialInfo],
    predictions: pa.Table,
    kind: str,
    folder: Path,
    on_trial: Callable[[int, int], None] | None = None,
) -> Baselines:
    """Follow markers, fit estimators on training trials, and score them on the very frames a network was scored on.

    Parameters
    ----------
    names
        Rows of `ESTIMATORS`.
    data
        Data set that holds both kinds of trials.
    training
        Trials to fit on.
    predictions
        The network's: trial, condition, frame, time and label of each frame.
    kind
        Row of `markers.KINDS`.
    folder
        For the field of each trial: those that are there are not followed again.
    on_trial
        Called with the number of trials followed and the number of all.

    Raises
    ------
    InputError
        If a name is not known, OpenCV is missing, or markers could be followed in none of the trials.
    """
    estimators = {name: get_estimator(name) for name in names}
    columns = {name: predictions.column(name).to_numpy(zero_copy_only=False) for name in _KEYS}
    tested = set(columns["trial"].tolist())
    trials = {info.trial: info for info in (*training, *(one for one in data.trials if one.trial in tested))}
    fields: dict[str, _Followed] = {}
    failed: dict[str, str] = {}
    for done, info in enumerate(trials.values(), start=1):
        try:
            fields[info.trial] = _follow(data, info, kind, folder)
        except RecordingError:
            raise
        except InputError as error:
            failed[info.trial] = str(error)
        if on_trial is not None:
            on_trial(done, len(trials))
    fitted = [info for info in training if info.trial in fields]
    for what, found in (("training", fitted), ("tested", tested - set(failed))):
        if not found:
            name, why = next(iter(failed.items()))
            raise InputError(
                f"markers were followed in none of the {what} trials ({name}: {why}); name another kind with --markers"
            )
    margins = [_margins(data, info) for info in fitted]
    answers = {}
    for name, estimator in estimators.items():
        estimator.fit([fields[info.trial].trial for info in fitted], margins)
        answers[name] = _answer(estimator.estimate, fields, columns, mean=float(np.nanmean(np.concatenate(margins))))
    return Baselines(
        markers=kind,
        training_trials=len(fitted),
        training_frames=sum(int(np.isfinite(one).sum()) for one in margins),
        followed=sum(one.followed for one in fields.values()) / max(1, sum(one.in_view for one in fields.values())),
        failed=failed,
        estimators={name: _score(columns, answer) for name, answer in answers.items()},
        predictions=pa.table({name: predictions.column(name) for name in _KEYS} | answers),
    )


def _follow(data: Dataset, info: TrialInfo, kind: str, folder: Path) -> _Followed:
    kept = folder / f"{info.trial}.npz"
    if kept.is_file():
        with np.load(kept) as saved:
            hold, in_view, followed = saved["numbers"].tolist()
            trial = FieldTrial(rest_px=saved["rest_px"], displacement_px=saved["displacement_px"], hold=hold)
        return _Followed(trial=trial, in_view=in_view, followed=followed)
    path = trial_path(data.folder, info.trial)
    reference = load_recording(path, truth=False, pixels=False).reference
    tracks = track_markers(stream_frames(path), reference, kind)
    trial = field_trial(tracks)
    in_view = int((tracks.status[:, tracks.from_reference] != MarkerStatus.OUTSIDE).sum())
    followed = int(tracks.followed[:, tracks.from_reference].sum())
    folder.mkdir(parents=True, exist_ok=True)
    part = kept.with_name(f".{info.trial}.part.npz")
    np.savez(
        part,
        rest_px=trial.rest_px,
        displacement_px=trial.displacement_px,
        numbers=np.array([trial.hold, in_view, followed]),
    )
    part.replace(kept)
    return _Followed(trial=trial, in_view=in_view, followed=followed)


def _margins(data: Dataset, info: TrialInfo) -> Float[np.ndarray, " frames"]:
    recording = load_recording(trial_path(data.folder, info.trial), truth=False, pixels=False)
    return np.where(recording.labelled, recording.safety_margin, np.nan)


def _answer(
    estimate: Callable[[FieldTrial], Float[np.ndarray, " _"]],
    fields: Mapping[str, _Followed],
    columns: Mapping[str, np.ndarray],
    *,
    mean: float,
) -> Float[np.ndarray, " frames"]:
    answer = np.full(len(columns["trial"]), mean)
    for name in set(columns["trial"].tolist()) & set(fields):
        rows = columns["trial"] == name
        answer[rows] = estimate(fields[name].trial)[columns["frame"][rows]]
    return answer


def _score(columns: Mapping[str, np.ndarray], answer: Float[np.ndarray, " frames"]) -> BaselineScores:
    conditions, leads = {}, {}
    for name in sorted(set(columns["condition"].tolist())):
        rows = columns["condition"] == name
        trial = columns["trial"][rows].tolist()
        labels = columns["safety_margin"][rows]
        conditions[name] = regression_scores(labels, answer[rows], trials=len(set(trial)))
        leads[name] = lead_times(trial, columns["time_s"][rows], labels, answer[rows])
    return BaselineScores(conditions=conditions, lead_times=leads)
