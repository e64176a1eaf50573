"""LeRobot v3 data sets of tactile frames, forces and labels."""

import json
import shutil
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Int64, Shaped

from sliplens.errors import InputError, RecordingError
from sliplens.files import require_folder, write_json
from sliplens.images import write_png
from sliplens.progress import OnProgress
from sliplens.recordings.capture import Capture, Frame
from sliplens.recordings.dataset import Dataset, TrialInfo
from sliplens.recordings.formats.lerobot import (
    CAMERA,
    FORCE,
    FORCE_AXES,
    KEPT,
    KEPT_FORCES,
    KEPT_REFERENCE,
    NUMBERS,
    REASON,
    STATE,
    TIME,
    VALID,
)
from sliplens.recordings.formats.stored import (
    STATES,
    ExportedTrial,
    encode_batches,
    exported_labels,
    read_stored_trial,
)
from sliplens.recordings.store import save_forces

_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}

Place = dict[str, int | float | list[str]]
Stats = dict[str, Any]
"""min, max, mean, std, count and quantiles, as JSON holds them."""


def count_levels(frame: Frame) -> Int64[np.ndarray, "3 256"]:
    """How often each channel of a frame has each of the 256 levels, from whose sums the statistics of pixels follow."""
    return np.array([np.bincount(frame[..., channel].ravel(), minlength=256) for channel in range(3)], dtype=np.int64)


def pixel_stats(counts: Int64[np.ndarray, "3 256"], frames: int) -> Stats:
    """Statistics of each channel, in [0, 1]; a quantile is the lowest level that so many pixels do not exceed."""
    level = np.arange(256) / 255
    share = counts / counts.sum(axis=1, keepdims=True)
    mean = share @ level
    found = {
        "min": [level[channel > 0].min() for channel in counts],
        "max": [level[channel > 0].max() for channel in counts],
        "mean": mean,
        "std": np.sqrt((share * (level - mean[:, None]) ** 2).sum(axis=1)),
    }
    below = counts.cumsum(axis=1)
    for name, quantile in _QUANTILES.items():
        found[name] = [level[np.searchsorted(channel, quantile * channel[-1])] for channel in below]
    return {**{name: np.reshape(values, (3, 1, 1)).tolist() for name, values in found.items()}, "count": [frames]}


def number_stats(values: Shaped[np.ndarray, "frames numbers"]) -> Stats:
    """Statistics of a feature over the frames of which all its numbers are known; zeros, counted 0, where none is."""
    known = values[np.isfinite(values).all(axis=1)]
    counted = known if len(known) else np.zeros_like(values[:1])
    exact = counted.astype(np.float64)
    found = {
        "min": counted.min(axis=0),
        "max": counted.max(axis=0),
        "mean": exact.mean(axis=0),
        "std": exact.std(axis=0),
        **dict(zip(_QUANTILES, np.quantile(exact, list(_QUANTILES.values()), axis=0), strict=True)),
    }
    return {**{name: value.tolist() for name, value in found.items()}, "count": [len(known)]}


Features = dict[str, dict[str, Any]]

CHUNK_FILES = 1000
FILE_MB = 100
"""Of a data file: the limits that LeRobot sets itself."""
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"

_IMAGE = pa.struct({"bytes": pa.binary(), "path": pa.string()})


class DataFiles:
    """Writes frames; an episode lies in one file, and what would make that too large goes into the next."""

    def __init__(self, folder: Path, features: Features, *, file_mb: float = FILE_MB) -> None:
        self.folder, self.limit = folder, file_mb * 2**20
        self.schema = _data_schema(features)
        self.number, self.frames = -1, 0
        self.writer: pq.ParquetWriter | None = None
        self.paths: list[Path] = []

    def begin(self, frames: int) -> tuple[int, int]:
        """Choose the file of an episode: chunk and number in it."""
        size = self.paths[-1].stat().st_size if self.writer is not None else 0
        if self.writer is None or size + size / max(self.frames, 1) * frames >= self.limit:
            self.close()
            self.number, self.frames = self.number + 1, 0
            chunk, file = divmod(self.number, CHUNK_FILES)
            path = self.folder / DATA_PATH.format(chunk_index=chunk, file_index=file)
            path.parent.mkdir(parents=True, exist_ok=True)
            self.paths.append(path)
            self.writer = pq.ParquetWriter(path, self.schema, compression="snappy", use_dictionary=False)
        return divmod(self.number, CHUNK_FILES)

    def write(self, columns: Mapping[str, np.ndarray], *, images: str, pngs: Sequence[bytes], first: int) -> None:
        """Write frames of an episode as a row group."""
        assert self.writer is not None
        paths = [f"frame-{first + index:06d}.png" for index in range(len(pngs))]
        arrays = {images: pa.StructArray.from_arrays([pa.array(pngs, pa.binary()), pa.array(paths)], ["bytes", "path"])}
        for name, values in columns.items():
            flat = pa.array(np.ascontiguousarray(values).ravel())
            width = values.shape[1] if values.ndim == 2 else 1
            arrays[name] = pa.FixedSizeListArray.from_arrays(flat, width) if values.ndim == 2 else flat
        table = pa.Table.from_arrays([arrays[name] for name in self.schema.names], schema=self.schema)
        self.writer.write_table(table)
        self.frames += len(pngs)

    def column(self, name: str) -> Shaped[np.ndarray, "frames numbers"]:
        """Read back a feature of all episodes; the files must be closed."""
        column = pq.read_table(self.paths, columns=[name]).column(name).combine_chunks()
        flat = column.flatten() if pa.types.is_fixed_size_list(column.type) else column
        return flat.to_numpy(zero_copy_only=False).reshape(len(column), -1)

    def close(self) -> None:
        """End the file that is being written."""
        if self.writer is not None:
            self.writer.close()
            self.writer = None


def write_tasks(folder: Path, tasks: Sequence[str]) -> None:
    """Write `meta/tasks.parquet`: a data frame of pandas, whose index are the words of the tasks."""
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": pa.array(tasks, pa.string())})
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
        for name, kind, numpy in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    index = {"index_columns": ["task"], "column_indexes": [], "columns": columns, "pandas_version": "2.2.0"}
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(index)}), folder / "meta" / "tasks.parquet")


def write_episodes(folder: Path, places: Sequence[Place], stats: Sequence[dict[str, Stats]]) -> None:
    """Write `meta/episodes`: where each episode lies, and its statistics."""
    rows = []
    for place, features in zip(places, stats, strict=True):
        named = {f"stats/{feature}/{name}": value for feature, one in features.items() for name, value in one.items()}
        rows.append({**place, **named, "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0})
    path = folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.Table.from_pylist(rows), path)


def _data_schema(features: Features) -> pa.Schema:
    """Columns of a data file, with what the `datasets` library reads of them, so that it, too, shows images."""
    fields, told = [], {}
    for name, feature in features.items():
        kind, width = feature["dtype"], feature["shape"][0]
        value = {"dtype": kind, "_type": "Value"}
        if kind == "image":
            column, told[name] = _IMAGE, {"_type": "Image"}
        elif width > 1:
            column = pa.list_(pa.type_for_alias(kind), width)
            told[name] = {"feature": value, "length": width, "_type": "List"}
        else:
            column, told[name] = pa.type_for_alias(kind), value
        fields.append(pa.field(name, column))
    return pa.schema(fields, {"huggingface": json.dumps({"info": {"features": told}})})


def frame_features(height: int, width: int) -> Features:
    """Features of the frames, as `meta/info.json` lists them; the words of the reasons are added when all are known."""
    found: Features = {
        CAMERA: {"dtype": "image", "shape": [height, width, 3], "names": ["height", "width", "channels"]},
        TIME: {"dtype": "float64", "shape": [1], "names": ["time_s"]},
        FORCE: {"dtype": "float64", "shape": [3], "names": list(FORCE_AXES)},
        **{key: {"dtype": "float64", "shape": [1], "names": [name]} for name, key in NUMBERS.items()},
        VALID: {"dtype": "bool", "shape": [1], "names": ["valid"]},
        STATE: {"dtype": "int64", "shape": [1], "names": ["contact_state"], "info": {"values": list(STATES)}},
        REASON: {"dtype": "int64", "shape": [1], "names": ["invalid_reason"]},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    }
    counts = ("frame_index", "episode_index", "index", "task_index")
    return found | {name: {"dtype": "int64", "shape": [1], "names": None} for name in counts}


def frame_columns(
    capture: Capture, *, fps: int | float, reasons: dict[str, int], first: int, episode: int, task: int
) -> dict[str, np.ndarray]:
    """Features of a labelled trial's frames, but for images; reasons not met before get a number."""
    assert capture.labels is not None
    labels, numbers, states = exported_labels(capture.labels), np.arange(len(capture), dtype=np.int64), list(STATES)
    force = labels["tangential_force_n"], np.zeros(len(capture)), labels["normal_force_n"]
    return {
        TIME: capture.frame_time_s,
        FORCE: np.stack(force, axis=1),
        **{key: labels[name] for name, key in NUMBERS.items()},
        VALID: labels["valid"],
        STATE: np.array([states.index(state) for state in labels["contact_state"]], dtype=np.int64),
        REASON: np.array([reasons.setdefault(reason, len(reasons)) for reason in labels["reason"]], dtype=np.int64),
        "timestamp": (numbers / fps).astype(np.float32),
        "frame_index": numbers,
        "episode_index": np.full_like(numbers, episode),
        "index": first + numbers,
        "task_index": np.full_like(numbers, task),
    }


def write_lerobot(
    data: Dataset, folder: Path, *, trials: Sequence[TrialInfo] | None = None, on_progress: OnProgress | None = None
) -> None:
    """Write trials as a LeRobot v3.0 data set, one episode a trial, without loss: `read_lerobot` gives them back.

    `observation.force` is (F_t, 0, F_n) in newtons: how strongly, not whither, the object is pulled. LeRobot knows one
    frame rate and counts time in frames of it: the true times stand in `observation.time_s`. Trials of a split follow
    each other, for a split is a range of episodes. What LeRobot has no place for lies in `meta/sliplens`.
    `data` and `meta` of an earlier attempt that came to no end are replaced.

    References
    ----------
    https://huggingface.co/docs/lerobot/lerobot-dataset-v3
    """
    chosen = data.trials if trials is None else trials
    splits = list(dict.fromkeys(info.split for info in chosen))
    chosen = sorted(chosen, key=lambda info: splits.index(info.split))
    height, width = _require_one_kind(chosen)
    _make_room(folder)
    fps = _frame_rate(data, chosen)
    features, reasons = frame_features(height, width), {"": 0}
    tasks: dict[str, int] = {}
    places: list[Place] = []
    stats: list[dict[str, Stats]] = []
    levels, first, total = np.zeros((3, 256), dtype=np.int64), 0, sum(info.frames for info in chosen)
    with closing(DataFiles(folder, features)) as files:
        for episode, info in enumerate(chosen):
            capture = read_stored_trial(data, info)
            count = len(capture)
            _keep(folder, episode, capture)
            task = f"touch {info.object or 'an object'} ({info.condition})"
            number = tasks.setdefault(task, len(tasks))
            columns = frame_columns(capture, fps=fps, reasons=reasons, first=first, episode=episode, task=number)
            chunk, file = files.begin(count)
            shown, done = np.zeros_like(levels), 0
            for batch, pngs in encode_batches(capture.read_frames()):
                shown += sum(map(count_levels, batch))
                some = {name: values[done : done + len(batch)] for name, values in columns.items()}
                files.write(some, images=CAMERA, pngs=list(pngs), first=done)
                done += len(batch)
                if on_progress is not None:
                    on_progress(first + done, total)
            numbers = {name: number_stats(values.reshape(count, -1)) for name, values in columns.items()}
            stats.append({CAMERA: pixel_stats(shown, count), **numbers})
            places.append(
                {
                    "episode_index": episode,
                    "tasks": [task],
                    "length": count,
                    "data/chunk_index": chunk,
                    "data/file_index": file,
                    "dataset_from_index": first,
                    "dataset_to_index": first + count,
                }
            )
            levels += shown
            first += count
    whole = {name: number_stats(files.column(name)) for name in features if name != CAMERA}
    whole = {CAMERA: pixel_stats(levels, first), **whole}
    _fill_unknown(stats, whole)
    write_tasks(folder, list(tasks))
    write_episodes(folder, places, stats)
    write_json(folder / "meta" / "stats.json", whole)
    features[REASON]["info"] = {"values": list(reasons)}
    # the last file: it makes the folder a data set
    write_json(
        folder / "meta" / "info.json",
        {
            "codebase_version": "v3.0",
            "robot_type": None,
            "total_episodes": len(places),
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


def _ranges(splits: Sequence[str]) -> dict[str, str]:
    return {split: f"{splits.index(split)}:{splits.index(split) + splits.count(split)}" for split in splits}


def _require_one_kind(trials: Sequence[TrialInfo]) -> tuple[int, int]:
    if not trials:
        raise RecordingError("there is no trial to export; name at least one")
    first = trials[0]
    for info in trials:
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
    (folder / KEPT).mkdir(parents=True)


def _frame_rate(data: Dataset, trials: Sequence[TrialInfo]) -> int | float:
    steps = {info.trial: np.diff(read_stored_trial(data, info).frame_time_s) for info in trials}
    if not any(map(len, steps.values())):
        return 30  # every trial is one frame
    rate = 1 / float(np.median(np.concatenate(list(steps.values()))))
    for trial, own in steps.items():
        if len(own) and abs(np.median(own) * rate - 1) > 0.1:
            raise RecordingError(
                f"trial {trial} has {1 / np.median(own):.4g} frames/s, most have {rate:.4g}, and a LeRobot data set "
                "has one rate; export them apart"
            )
    return round(rate) if abs(round(rate) / rate - 1) < 0.01 else rate


def _keep(folder: Path, episode: int, capture: Capture) -> None:
    """Write what LeRobot has no place for."""
    labels, forces = capture.labels, capture.forces
    assert labels is not None
    assert capture.reference is not None
    write_png(folder / KEPT / KEPT_REFERENCE.format(episode), capture.reference)
    if forces is not None:
        save_forces(forces, folder / KEPT / KEPT_FORCES.format(episode))
    with (folder / KEPT / "trials.jsonl").open("a", encoding="utf-8", newline="\n") as lines:
        lines.write(ExportedTrial.of(capture).dump() + "\n")


def _fill_unknown(episodes: Sequence[dict[str, Stats]], whole: dict[str, Stats]) -> None:
    """Give episodes in which a feature is never known the statistics of all, at a count of 0."""
    for one in episodes:
        for name, stats in one.items():
            if stats["count"] == [0]:
                stats.update({**whole[name], "count": [0]})
