"""A trial in the Rerun viewer: frames, differences, forces and labels on one clock, streamed from its file."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from sliplens.errors import InputError
from sliplens.images import absolute_difference
from sliplens.recordings import Dataset, Recording, TrialInfo
from sliplens.recordings.dataset import trial_path
from sliplens.recordings.headers import read_header, read_labelling
from sliplens.recordings.samples import forces_path, load_forces
from sliplens.recordings.store import load_recording, read_frames
from sliplens.report.pages import written_whole
from sliplens.report.trial_charts import brightening
from sliplens.report.viewer_frames import log_frames
from sliplens.report.viewer_layout import Shown, lay_out
from sliplens.report.viewer_numbers import force_ratio, log_numbers, log_samples, log_states
from sliplens.report.viewer_process import require_rerun, require_rrd_path, start_viewer
from sliplens.report.viewer_text import describe_trial
from sliplens.report.viewer_truth import StoredTruth, log_truth, read_truth

if TYPE_CHECKING:
    from rerun import RecordingStream

_APPLICATION = "sliplens"
_SAMPLED = 32  # frames that are looked at for the brightness of all
_HIGHEST = 2.5  # times mu_s: where hardly anything presses, F_t / F_n goes anywhere


def write_rrd(
    data: Dataset, info: TrialInfo, path: Path, *, on_frames: Callable[[int, int], None] | None = None
) -> None:
    """Write a trial as a file of the Rerun viewer; it appears when complete.

    Parameters
    ----------
    data, info
        The data set, and the trial of it.
    path
        File to write, .rrd.
    on_frames
        Called with the frames done and the frames in all, now and then.

    Raises
    ------
    InputError
        If Rerun is not installed, the suffix is another one, or the file cannot be written.
    RecordingError
        If the trial is missing or damaged.
    """
    require_rrd_path(path)
    stream = _new_stream()
    with written_whole(path) as part:
        part.touch()  # Rerun would tell of a file that cannot be written in its own way
        stream.save(part)
        _log_whole(stream, data, info, on_frames, otherwise=f"{path} could not be written; see what space is left")


def open_viewer(data: Dataset, info: TrialInfo, *, on_frames: Callable[[int, int], None] | None = None) -> None:
    """Open a trial in a Rerun viewer of its own, which stays when this process ends.

    Parameters
    ----------
    data, info
        The data set, and the trial of it.
    on_frames
        Called with the frames done and the frames in all, now and then.

    Raises
    ------
    InputError
        If Rerun is not installed, its viewer does not start, or is closed before it has the trial.
    RecordingError
        If the trial is missing or damaged.
    """
    stream = _new_stream()
    read_header(trial_path(data.folder, info.trial))  # no window for a trial that is not there
    stream.connect_grpc(start_viewer())
    _log_whole(stream, data, info, on_frames, otherwise="the Rerun viewer was closed too early; leave it open")


def log_trial(
    stream: "RecordingStream", data: Dataset, info: TrialInfo, *, on_frames: Callable[[int, int], None] | None = None
) -> None:
    """Log a trial and its layout to a Rerun stream, a few frames in memory at a time.

    Timelines are `time`, on the clock of the camera, and `frame`. What is not known is NaN: there a line breaks.

    Parameters
    ----------
    stream
        Where to log to.
    data, info
        The data set, and the trial of it.
    on_frames
        Called with the frames done and the frames in all, now and then.

    Raises
    ------
    InputError
        If Rerun is not installed.
    RecordingError
        If the trial is missing or damaged.
    """
    rerun = require_rerun()
    path, samples = trial_path(data.folder, info.trial), forces_path(data.folder, info.trial)
    trial, labelling, truth = load_recording(path, pixels=False), read_labelling(path), read_truth(path)
    friction = _static_friction(trial, labelling, truth)
    some = read_frames(path, range(0, len(trial), -(-len(trial) // _SAMPLED)))
    shown = Shown(
        size=trial.reference.shape[:2],
        factor=brightening([absolute_difference(some, trial.reference)]),
        highest_ratio=_highest_ratio(trial, friction),
        truth=truth is not None,
        sensor=bool(info.forces_sha256),
    )
    stream.send_recording_name(info.trial)
    stream.send_blueprint(lay_out(shown))
    about = describe_trial(trial, info, labelling, truth=truth and truth.displacement)
    stream.log("about", rerun.TextDocument(about, media_type=rerun.MediaType.MARKDOWN), static=True)
    log_numbers(stream, trial, friction)
    log_states(stream, trial)
    if shown.sensor:
        log_samples(stream, load_forces(samples), labelling)
    if truth is not None:
        log_truth(stream, path, trial, truth)
    log_frames(stream, path, trial, shown.factor, on_frames)


def _log_whole(
    stream: "RecordingStream",
    data: Dataset,
    info: TrialInfo,
    on_frames: Callable[[int, int], None] | None,
    *,
    otherwise: str,
) -> None:
    try:
        log_trial(stream, data, info, on_frames=on_frames)
        stream.flush()
    except RuntimeError as error:
        raise InputError(f"{otherwise} ({error})") from None
    finally:
        stream.disconnect()


def _static_friction(
    trial: Recording, labelling: Mapping[str, Any] | None, truth: StoredTruth | None
) -> Float[np.ndarray, " frames"] | None:
    """mu_s of each frame: that of the simulator, or what was estimated; None where neither is told."""
    if truth is not None:
        return truth.static_friction
    told = (labelling or {}).get("friction")
    return None if told is None or told["mu"] is None else np.full(len(trial), float(told["mu"]))


def _highest_ratio(trial: Recording, static_friction: Float[np.ndarray, " frames"] | None) -> float:
    """Where to end the chart of F_t / F_n: a little above what there is."""
    friction, ratio = trial.friction_coefficient if static_friction is None else static_friction, force_ratio(trial)
    mu, most = (float(np.max(values, where=np.isfinite(values), initial=0)) for values in (friction, ratio))
    return 1.12 * max(mu, min(most, _HIGHEST * mu)) or 1.0


def _new_stream() -> "RecordingStream":
    stream = require_rerun().RecordingStream(_APPLICATION)
    if not stream.is_enabled():
        raise InputError("the environment variable RERUN switches Rerun off; unset it")
    return stream
