"""LeRobot data sets that `write_lerobot` exported, read back with all that was known of their trials.

What LeRobot has no place for lies in `meta/sliplens`: a line of JSON an episode (`TrialText`), and beside it the
reference frames and the samples of the force sensor.
"""

from pathlib import Path

import numpy as np
import pyarrow as pa

from sliplens.errors import RecordingError
from sliplens.recordings.capture import Capture, Forces
from sliplens.recordings.given import GivenLabels
from sliplens.recordings.readers.lerobot_frames import decode_image, image_frames
from sliplens.recordings.readers.lerobot_layout import Episode, Layout, read_episodes
from sliplens.recordings.readers.lerobot_rows import EpisodeRows
from sliplens.recordings.recording import ContactState, require_unit_interval
from sliplens.recordings.samples import load_forces
from sliplens.recordings.trial_messages import TrialText

CAMERA, TIME, FORCE = "observation.images.tactile", "observation.time_s", "observation.force"
FORCE_AXES = ("tangential_n", "across_n", "normal_n")
NUMBERS = {
    name: f"observation.{name}"
    for name in ("friction_coefficient", "safety_margin", "safety_margin_sigma", "stick_ratio")
}
"""Features of one number, by the labels they hold."""
VALID, STATE, REASON = "observation.valid", "observation.contact_state", "observation.invalid_reason"
_COLUMNS = [TIME, FORCE, *NUMBERS.values(), VALID, STATE, REASON]
_STATES = {str(state): state for state in ContactState}


def trials_path(folder: Path) -> Path:
    """File with a line of JSON an episode."""
    return folder / "meta" / "sliplens" / "trials.jsonl"


def reference_path(folder: Path, episode: int) -> Path:
    """Reference frame of an episode."""
    return folder / "meta" / "sliplens" / f"reference-{episode:06d}.png"


def samples_path(folder: Path, episode: int) -> Path:
    """Samples of the force sensor of an episode."""
    return folder / "meta" / "sliplens" / f"forces-{episode:06d}.parquet"


def read_kept(layout: Layout) -> tuple[TrialText, ...] | None:
    """Read what is kept of the trials, one an episode; None where nothing is.

    Raises
    ------
    RecordingError
        If it is damaged, or names a trial twice.
    """
    path = trials_path(layout.folder)
    try:
        lines = path.read_text(encoding="utf-8").rstrip("\n").split("\n")
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path} cannot be read ({error}); copy the data set again") from None
    trials = tuple(TrialText.parse(line, where=f"line {number + 1} of {path}") for number, line in enumerate(lines))
    if len({trial.trial for trial in trials}) < len(trials):
        raise RecordingError(f"{path} names a trial twice; copy the data set again")
    missing = [key for key in (CAMERA, *_COLUMNS) if key not in layout.features]
    if missing:
        raise RecordingError(
            f"meta/info.json of {layout.folder} lacks {', '.join(missing)}; copy the data set again, or remove {path} "
            "to read it without labels"
        )
    return trials


def kept_captures(layout: Layout, trials: tuple[TrialText, ...], *, episode: int | None) -> list[Capture]:
    """Trials of a data set as they were exported.

    Parameters
    ----------
    layout
        What the data set says of itself.
    trials
        What is kept of them.
    episode
        Index of the only episode that is wanted; all if None.

    Raises
    ------
    RecordingError
        If the episodes are others than those exported, or one is damaged.
    """
    episodes = read_episodes(layout, camera_key=CAMERA)
    exported = [(index, trial.frames) for index, trial in enumerate(trials)]
    if [(one.index, one.length) for one in episodes] != exported:
        path = trials_path(layout.folder)
        raise RecordingError(
            f"the episodes of {layout.folder} are no longer those that {path} tells of; export the trials again, or "
            "remove that file to read the data set without labels"
        )
    rows = EpisodeRows(layout, _COLUMNS)
    wanted = read_episodes(layout, camera_key=CAMERA, only=episode)
    return [_capture(layout, rows, one, trials[one.index]) for one in wanted]


def _capture(layout: Layout, rows: EpisodeRows, episode: Episode, trial: TrialText) -> Capture:
    table = rows.of(episode)
    size, read_frames = image_frames(episode, CAMERA)
    source = f"{trial.trial}, episode {episode.index} of {layout.folder}"
    time = rows.numbers(table, TIME, episode)
    if not np.isfinite(time).all():
        raise RecordingError(f"{TIME} of {source} is not a number everywhere; copy the data set again")
    path = reference_path(layout.folder, episode.index)
    try:
        png = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path} cannot be read ({error.strerror}); copy the data set again") from None
    return Capture(
        name=trial.trial,
        source=source,
        frame_time_s=time,
        frame_size=size,
        read_frames=read_frames,
        forces=_forces(samples_path(layout.folder, episode.index), trial) if trial.force_samples else None,
        labels=_labels(rows, table, episode, trial, source),
        reference=decode_image(png, where=f"{path}"),
        told=trial.told,
    )


def _labels(rows: EpisodeRows, table: pa.Table, episode: Episode, trial: TrialText, source: str) -> GivenLabels:
    force = rows.vectors(table, FORCE, episode)
    if force.shape[1] != len(FORCE_AXES):
        raise RecordingError(f"{FORCE} of {source} has {force.shape[1]} numbers, not 3; copy the data set again")
    numbers = {name: rows.numbers(table, key, episode) for name, key in NUMBERS.items()}
    for name in ("safety_margin", "stick_ratio"):
        require_unit_interval(numbers[name], name=name, trial=source)
    states = rows.words(table, STATE, episode)
    unknown = set(states) - set(_STATES)
    if unknown:
        raise RecordingError(
            f"{source} has the contact state {min(unknown)[:40]!r}, none of {', '.join(_STATES)}; "
            "copy the data set again"
        )
    optional = {
        "safety_margin_sigma": numbers.pop("safety_margin_sigma"),
        "valid": rows.truths(table, VALID, episode),
        "reason": rows.words(table, REASON, episode),
    }
    return GivenLabels(
        **numbers,
        tangential_force_n=force[:, 0].copy(),
        normal_force_n=force[:, 2].copy(),
        contact_state=tuple(_STATES[state] for state in states),
        **{name: values for name, values in optional.items() if name in trial.optional},
        labelling=trial.labelling,
    )


def _forces(path: Path, trial: TrialText) -> Forces:
    forces = load_forces(path)
    if len(forces.time_s) != trial.force_samples:
        raise RecordingError(
            f"{path} has {len(forces.time_s)} samples of {trial.trial}, {trial.force_samples} were exported; "
            "copy the data set again"
        )
    return forces
