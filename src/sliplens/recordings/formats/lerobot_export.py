"""LeRobot v3 data sets of tactile frames, forces and labels."""

import json
from collections.abc import Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Int64, Shaped

from sliplens.errors import RecordingError
from sliplens.files import write_json
from sliplens.images import encode_png
from sliplens.progress import report_each, report_progress
from sliplens.recordings.capture import Capture, Frame
from sliplens.recordings.dataset import Dataset, TrialInfo
from sliplens.recordings.formats.stored import fill_labels, read_stored_trial
from sliplens.recordings.store import in_turn
from sliplens.recordings.trial import ContactState

CAMERA, TIME, FORCE = "observation.images.tactile", "observation.time_s", "observation.force"
NUMBERS = {
    name: f"observation.{name}"
    for name in ("friction_coefficient", "safety_margin", "safety_margin_sigma", "stick_ratio")
}
"""Features of one number, by the labels they hold."""
VALID, STATE, REASON = "observation.valid", "observation.contact_state", "observation.invalid_reason"
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_CHUNK_FILES = 1000
_BATCH = 16  # frames that are written together
_APART = "export them apart"
_STATES = [str(state) for state in ContactState]
_IMAGE = pa.struct({"bytes": pa.binary(), "path": pa.string()})
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}

Features: TypeAlias = dict[str, dict[str, Any]]  #: Features by name, as `meta/info.json` lists them.
Stats: TypeAlias = dict[str, list]  #: min, max, mean, std, count and quantiles, as JSON holds them.


def write_lerobot(data: Dataset, trials: Sequence[TrialInfo], folder: Path) -> None:
    """Write trials into an empty folder; see `export_lerobot`."""
    splits = list(dict.fromkeys(info.split for info in trials))
    trials = sorted(trials, key=lambda info: splits.index(info.split))
    splits = [info.split for info in trials]
    fps, features, reasons = _frame_rate(data, trials), _features(trials), {"": 0}
    schema, tasks, rows = _data_schema(features), dict[str, int](), []
    numbers: list[dict[str, np.ndarray]] = []
    levels: list[Int64[np.ndarray, "3 256"]] = []
    first = 0
    for episode, info in enumerate(report_each(trials, sizes=[info.frames for info in trials])):
        capture = read_stored_trial(data, info)
        task = f"touch {info.object or 'an object'} ({info.condition})"
        number = tasks.setdefault(task, len(tasks))
        numbers.append(
            _frame_columns(capture, fps=fps, reasons=reasons)
            | {
                "episode_index": np.full(len(capture), episode),
                "index": first + np.arange(len(capture)),
                "task_index": np.full(len(capture), number),
            }
        )
        chunk, file = divmod(episode, _CHUNK_FILES)
        path = folder / DATA_PATH.format(chunk_index=chunk, file_index=file)
        levels.append(_write_episode(path, schema, numbers[-1], capture))
        places = {"data/chunk_index": chunk, "data/file_index": file}
        ends = {"dataset_from_index": first, "dataset_to_index": first + len(capture)}
        rows.append({"episode_index": episode, "tasks": [task], "length": len(capture), **places, **ends})
        first += len(capture)
    total = {CAMERA: pixel_stats(np.sum(levels, axis=0), first)}
    total |= {name: number_stats(np.concatenate([each[name] for each in numbers])) for name in numbers[0]}
    for row, columns, counts in zip(rows, numbers, levels, strict=True):
        stats = {CAMERA: pixel_stats(counts, row["length"])}
        stats |= {name: number_stats(values) for name, values in columns.items()}
        for name, feature in stats.items():
            if feature["count"] == [0]:  # the statistics of all, which spoil no minimum and weigh nothing
                feature.update({**total[name], "count": [0]})
            row |= {f"stats/{name}/{statistic}": value for statistic, value in feature.items()}
        row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
    features[REASON]["info"] = {"values": list(reasons)}
    meta = folder / "meta"
    (meta / "episodes" / "chunk-000").mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist(rows), meta / "episodes" / "chunk-000" / "file-000.parquet")
    # a data frame of pandas, whose index is the text of the task
    table = pa.table(
        {"task_index": pa.array(range(len(tasks)), pa.int64()), "task": pa.array(list(tasks), pa.string())}
    )
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
        for name, kind, numpy in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    index = {"index_columns": ["task"], "column_indexes": [], "columns": columns, "pandas_version": "2.2.0"}
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(index)}), meta / "tasks.parquet")
    write_json(meta / "stats.json", total)
    ranges = {split: f"{splits.index(split)}:{splits.index(split) + splits.count(split)}" for split in splits}
    totals = {"total_episodes": len(rows), "total_frames": first, "total_tasks": len(tasks)}
    sizes = {"chunks_size": _CHUNK_FILES, "data_files_size_in_mb": 100, "video_files_size_in_mb": 200}
    paths = {"data_path": DATA_PATH, "video_path": None}
    info = {"codebase_version": "v3.0", "robot_type": None, **totals, **sizes, "fps": fps, "splits": ranges}
    write_json(meta / "info.json", {**info, **paths, "features": features})


def _frame_rate(data: Dataset, trials: Sequence[TrialInfo]) -> int | float:
    steps = {info.trial: np.diff(read_stored_trial(data, info, samples=False).frame_time_s) for info in trials}
    if not any(map(len, steps.values())):
        return 30  # every trial is one frame
    rate = 1 / float(np.median(np.concatenate(list(steps.values()))))
    for trial, trial_steps in steps.items():
        if len(trial_steps) and abs(np.median(trial_steps) * rate - 1) > 0.1:
            raise RecordingError(f"trial {trial} has another frame rate, and a LeRobot data set has one rate; {_APART}")
    return round(rate) if abs(round(rate) / rate - 1) < 0.01 else rate


def _features(trials: Sequence[TrialInfo]) -> Features:
    """Return the features of the frames; the texts of the reasons are added when all of them are known."""
    first = trials[0]
    for info in trials:
        if (info.height, info.width) != (first.height, first.width):
            raise RecordingError(f"trial {info.trial} has other frames, and a LeRobot data set has one size; {_APART}")
    rows = [
        (TIME, "float64", ["time_s"]),
        (FORCE, "float64", ["tangential_n", "across_n", "normal_n"]),
        *((key, "float64", [name]) for name, key in NUMBERS.items()),
        *((VALID, "bool", ["valid"]), (STATE, "int64", ["contact_state"]), (REASON, "int64", ["invalid_reason"])),
        ("timestamp", "float32", None),
        *((name, "int64", None) for name in ("frame_index", "episode_index", "index", "task_index")),
    ]
    camera = {"dtype": "image", "shape": [first.height, first.width, 3], "names": ["height", "width", "channels"]}
    features: Features = {CAMERA: camera}
    features |= {name: {"dtype": kind, "shape": [len(names or "1")], "names": names} for name, kind, names in rows}
    features[STATE]["info"] = {"values": _STATES}
    return features


def _frame_columns(capture: Capture, *, fps: int | float, reasons: dict[str, int]) -> dict[str, np.ndarray]:
    """Return the features of a trial's frames, without images; a new reason gets the next number in `reasons`."""
    assert capture.labels is not None
    labels, frame_index = fill_labels(capture.labels), np.arange(len(capture))
    force = labels.tangential_force_n, np.zeros(len(capture)), labels.normal_force_n
    return {
        TIME: capture.frame_time_s,
        FORCE: np.stack(force, axis=1),
        **{key: getattr(labels, name) for name, key in NUMBERS.items()},
        VALID: np.asarray(labels.valid),
        STATE: np.array([_STATES.index(state) for state in labels.contact_state]),
        REASON: np.array([reasons.setdefault(reason, len(reasons)) for reason in labels.reason or ()]),
        "timestamp": (frame_index / fps).astype(np.float32),
        "frame_index": frame_index,
    }


def _write_episode(
    path: Path, schema: pa.Schema, columns: Mapping[str, np.ndarray], capture: Capture
) -> Int64[np.ndarray, "3 256"]:
    """Write the frames of a trial as one data file; return how often each channel has each level."""

    def encode(frame: Frame) -> tuple[bytes, Int64[np.ndarray, "3 256"]]:
        levels = [np.bincount(frame[..., channel].ravel(), minlength=256) for channel in range(3)]
        return encode_png(frame), np.array(levels)

    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {}
    for name, values in columns.items():
        flat = pa.array(np.ascontiguousarray(values).ravel())
        arrays[name] = pa.FixedSizeListArray.from_arrays(flat, values.shape[1]) if values.ndim == 2 else flat
    counts, done = np.zeros((3, 256), dtype=np.int64), 0
    with pq.ParquetWriter(path, schema, compression="snappy", use_dictionary=False) as writer:
        images = in_turn(encode, capture.read_frames())
        while batch := list(islice(images, _BATCH)):
            pngs = [png for png, _ in batch]
            counts += sum(levels for _, levels in batch)
            names = pa.array([f"frame-{done + index:06d}.png" for index in range(len(pngs))])
            batch = {name: array.slice(done, len(pngs)) for name, array in arrays.items()}
            batch[CAMERA] = pa.StructArray.from_arrays([pa.array(pngs, pa.binary()), names], ["bytes", "path"])
            writer.write_table(pa.Table.from_arrays([batch[name] for name in schema.names], schema=schema))
            done += len(pngs)
            report_progress(done, len(capture))
    return counts


def pixel_stats(counts: Int64[np.ndarray, "3 256"], frames: int) -> Stats:
    """Compute the statistics of each channel in [0, 1]; a quantile is the lowest level that so many do not exceed."""
    level = np.arange(256) / 255
    share = counts / counts.sum(axis=1, keepdims=True)
    mean, below = share @ level, counts.cumsum(axis=1)
    stats = {
        "min": [level[channel > 0].min() for channel in counts],
        "max": [level[channel > 0].max() for channel in counts],
        "mean": mean,
        "std": np.sqrt((share * (level - mean[:, None]) ** 2).sum(axis=1)),
        **{name: level[(below < each * below[:, -1:]).sum(axis=1)] for name, each in _QUANTILES.items()},
    }
    return {**{name: np.reshape(values, (3, 1, 1)).tolist() for name, values in stats.items()}, "count": [frames]}


def number_stats(values: Shaped[np.ndarray, "frames *numbers"]) -> Stats:
    """Compute the statistics over frames in which all numbers are finite; zeros with a count of 0 if none is."""
    values = values.reshape(len(values), -1)
    finite = values[np.isfinite(values).all(axis=1)]
    counted = finite if len(finite) else np.zeros_like(values[:1])
    exact = counted.astype(np.float64)
    stats = {
        "min": counted.min(axis=0),
        "max": counted.max(axis=0),
        "mean": exact.mean(axis=0),
        "std": exact.std(axis=0),
        **dict(zip(_QUANTILES, np.quantile(exact, list(_QUANTILES.values()), axis=0), strict=True)),
    }
    return {**{name: value.tolist() for name, value in stats.items()}, "count": [len(finite)]}


def _data_schema(features: Features) -> pa.Schema:
    """Return the columns of a data file, with the metadata by which the `datasets` library shows images."""
    fields, described = [], {}
    for name, feature in features.items():
        kind, width = feature["dtype"], feature["shape"][0]
        value = {"dtype": kind, "_type": "Value"}
        if kind == "image":
            column, described[name] = _IMAGE, {"_type": "Image"}
        elif width > 1:
            column = pa.list_(pa.type_for_alias(kind), width)
            described[name] = {"feature": value, "length": width, "_type": "List"}
        else:
            column, described[name] = pa.type_for_alias(kind), value
        fields.append(pa.field(name, column))
    return pa.schema(fields, {"huggingface": json.dumps({"info": {"features": described}})})
