"""LeRobot v3 data sets of tactile frames, forces and labels."""

import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path

import numpy as np

from sliplens.errors import InputError, RecordingError
from sliplens.images.files import encode_png, write_png
from sliplens.provenance import require_folder, write_json
from sliplens.recordings.capture import Capture
from sliplens.recordings.dataset import Dataset, TrialInfo
from sliplens.recordings.readers.clocks import trial_name
from sliplens.recordings.readers.lerobot_kept import (
    CAMERA,
    REASON,
    reference_path,
    samples_path,
    trials_path,
)
from sliplens.recordings.readers.stored import read_stored_trial
from sliplens.recordings.samples import save_forces
from sliplens.recordings.trial_messages import OPTIONAL, TrialText
from sliplens.recordings.writers.lerobot_columns import frame_columns, frame_features, frame_places
from sliplens.recordings.writers.lerobot_files import (
    CHUNK_FILES,
    DATA_PATH,
    FILE_MB,
    DataFiles,
    EpisodeEntry,
    write_episodes,
    write_tasks,
)
from sliplens.recordings.writers.lerobot_stats import PixelCount, Stats, number_stats

_BATCH = 16
"""Frames that are encoded side by side and written together."""
_RATE_WHERE_NONE = 30
"""Where every trial is one frame."""


def write_lerobot(
    data: Dataset,
    folder: Path,
    *,
    trials: Sequence[TrialInfo] | None = None,
    on_frames: Callable[[int, int], None] | None = None,
) -> None:
    """Write trials as a LeRobot v3.0 data set, one episode a trial, without loss: `read_lerobot` gives them back.

    Frames are PNG in Parquet, never a lossy video, which moves markers. `observation.force` is (F_t, 0, F_n) in
    newtons: how strongly, not whither, the object is pulled. Contact states and reasons are numbers, whose words
    `meta/info.json` lists. What is not known is NaN; statistics leave it out.

    LeRobot knows one frame rate and counts time in frames of it: `fps` is the median rate, a whole number where that is
    within 1 %, and `timestamp` is `frame_index / fps`. The true times stand in `observation.time_s`. Trials of a split
    follow each other, for a split is a range of episodes. What LeRobot has no place for lies in `meta/sliplens`:
    reference frames, samples of the force sensor, sensor, day, condition, object, and what the labels rest on. Of a
    simulated trial the ground truth beyond its labels stays behind.

    Parameters
    ----------
    data
        The data set.
    folder
        Folder to write to; `data` and `meta` of an earlier attempt that came to no end are replaced.
    trials
        Rows of its table; all by default.
    on_frames
        Called with the frames written and the frames in all.

    Raises
    ------
    InputError
        If the folder is missing, or holds a data set.
    RecordingError
        If there is no trial, one is damaged or not named like a file, or sizes of frames or frame rates differ.

    References
    ----------
    https://huggingface.co/docs/lerobot/lerobot-dataset-v3
    """
    chosen = _in_splits(data.trials if trials is None else trials)
    height, width = _require_one_kind(chosen)
    _make_room(folder)
    fps = _frame_rate(data, chosen)
    features, reasons = frame_features(height, width), {"": 0}
    tasks: dict[str, int] = {}
    episodes: list[EpisodeEntry] = []
    pixels, first, total = PixelCount(), 0, sum(info.frames for info in chosen)
    with DataFiles(folder, features) as files:
        for episode, info in enumerate(chosen):
            capture = read_stored_trial(data, info)
            count = len(capture.frame_time_s)
            _keep(folder, episode, capture)
            task = f"touch {info.object or 'an object'} ({info.condition})"
            columns = frame_columns(capture, fps=fps, reasons=reasons) | frame_places(
                count, first=first, episode=episode, task=tasks.setdefault(task, len(tasks))
            )
            chunk, file = files.begin(count)
            shown = PixelCount()
            for done in _write_frames(files, capture, columns, shown):
                if on_frames is not None:
                    on_frames(first + done, total)
            stats = {
                CAMERA: shown.stats(),
                **{name: number_stats(values.reshape(count, -1)) for name, values in columns.items()},
            }
            episodes.append(EpisodeEntry(first=first, length=count, task=task, chunk=chunk, file=file, stats=stats))
            pixels.join(shown)
            first += count
    stats = {name: pixels.stats() if name == CAMERA else number_stats(files.column(name)) for name in features}
    _fill_unknown(episodes, stats)
    write_tasks(folder, list(tasks))
    write_episodes(folder, episodes)
    write_json(folder / "meta" / "stats.json", stats)
    features[REASON]["info"] = {"values": list(reasons)}
    # the last file: it makes the folder a data set
    write_json(
        folder / "meta" / "info.json",
        {
            "codebase_version": "v3.0",
            "robot_type": None,
            "total_episodes": len(episodes),
            "total_frames": first,
            "total_tasks": len(tasks),
            "chunks_size": CHUNK_FILES,
            "data_files_size_in_mb": FILE_MB,
            "video_files_size_in_mb": 200,
            "fps": fps,
            "splits": _ranges([info.split for info in chosen]),
            "data_path": DATA_PATH,
            "video_path": None,
            "features": features,
        },
    )


def _in_splits(trials: Sequence[TrialInfo]) -> list[TrialInfo]:
    splits = list(dict.fromkeys(info.split for info in trials))
    return sorted(trials, key=lambda info: splits.index(info.split))


def _ranges(splits: Sequence[str]) -> dict[str, str]:
    return {split: f"{splits.index(split)}:{splits.index(split) + splits.count(split)}" for split in splits}


def _require_one_kind(trials: Sequence[TrialInfo]) -> tuple[int, int]:
    if not trials:
        raise RecordingError("there is no trial to export; name at least one")
    first = trials[0]
    for info in trials:
        if trial_name(info.trial) != info.trial:
            raise RecordingError(f"trial {info.trial!r} has no name for a file; rename it")
        if (info.height, info.width) != (first.height, first.width):
            raise RecordingError(
                f"trial {info.trial} has frames of {info.height} x {info.width} pixels, trial {first.trial} of "
                f"{first.height} x {first.width}, and a LeRobot data set has one size; export them apart"
            )
    return first.height, first.width


def _make_room(folder: Path) -> None:
    require_folder(folder, what="the folder to write to")
    if (folder / "meta" / "info.json").exists():
        raise InputError(f"{folder} holds a LeRobot data set; name a new folder")
    for name in ("data", "meta"):
        if (folder / name).is_dir():
            shutil.rmtree(folder / name)
    trials_path(folder).parent.mkdir(parents=True)


def _frame_rate(data: Dataset, trials: Sequence[TrialInfo]) -> int | float:
    steps = {info.trial: np.diff(read_stored_trial(data, info).frame_time_s) for info in trials}
    if not any(map(len, steps.values())):
        return _RATE_WHERE_NONE
    rate = 1 / float(np.median(np.concatenate(list(steps.values()))))
    for trial, own in steps.items():
        if len(own) and abs(np.median(own) * rate - 1) > 0.1:
            raise RecordingError(
                f"trial {trial} has {1 / np.median(own):.4g} frames/s, most have {rate:.4g}, and a LeRobot data set "
                "has one rate; export them apart"
            )
    return round(rate) if abs(round(rate) / rate - 1) < 0.01 else rate


def _write_frames(
    files: DataFiles, capture: Capture, columns: dict[str, np.ndarray], shown: PixelCount
) -> Iterator[int]:
    """Write the frames of a trial in batches, those of a batch encoded side by side; how many there are, each time."""
    done, frames = 0, capture.read_frames()
    with ThreadPoolExecutor() as pool:
        while batch := list(islice(frames, _BATCH)):
            pngs = pool.map(encode_png, batch)
            for frame in batch:
                shown.add(frame)
            some = {name: values[done : done + len(batch)] for name, values in columns.items()}
            files.write(some, images=CAMERA, pngs=list(pngs), first=done)
            done += len(batch)
            yield done


def _keep(folder: Path, episode: int, capture: Capture) -> None:
    """Write what LeRobot has no place for."""
    labels, forces = capture.labels, capture.forces
    assert labels is not None
    assert capture.reference is not None
    write_png(reference_path(folder, episode), capture.reference)
    if forces is not None:
        save_forces(forces, samples_path(folder, episode))
    text = TrialText(
        trial=capture.name,
        told=capture.told,
        frames=len(labels),
        force_samples=len(forces.time_s) if forces else 0,
        force_source=forces.source if forces else "",
        optional=tuple(name for name in OPTIONAL if getattr(labels, name) is not None),
        labelling=labels.labelling,
    )
    with trials_path(folder).open("a", encoding="utf-8", newline="\n") as lines:
        lines.write(text.dump() + "\n")


def _fill_unknown(episodes: Sequence[EpisodeEntry], whole: dict[str, Stats]) -> None:
    """Give episodes in which a feature is never known the statistics of all, at a count of 0."""
    for one in episodes:
        for name, stats in one.stats.items():
            if stats["count"] == [0]:
                stats.update({**whole[name], "count": [0]})
