"""Files of a LeRobot v3 data set: frames in Parquet files of limited size, and the tables that tell where all lies."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Shaped

from sliplens.recordings.writers.lerobot_stats import Stats

Features = dict[str, dict[str, Any]]

CHUNK_FILES = 1000
FILE_MB = 100
"""Of a data file: the limits that LeRobot sets itself."""
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"

_IMAGE = pa.struct({"bytes": pa.binary(), "path": pa.string()})
_TYPES = {"image": _IMAGE, "float64": pa.float64(), "float32": pa.float32(), "int64": pa.int64(), "bool": pa.bool_()}


@dataclass(frozen=True, kw_only=True)
class EpisodeEntry:
    """A row of `meta/episodes`."""

    first: int
    """Number of the first frame in the whole data set."""
    length: int
    task: str
    chunk: int
    """Folder of the data file, and number of the file in it."""
    file: int
    stats: dict[str, Stats]


class DataFiles:
    """Writes frames; an episode is in one file, and what would make it too large goes into the next, as with LeRobot.

    Parameters
    ----------
    folder
        Of the data set.
    features
        As `meta/info.json` lists them.
    file_mb
        Size at which a file is full.
    """

    def __init__(self, folder: Path, features: Features, *, file_mb: float = FILE_MB) -> None:
        self.folder, self.limit = folder, file_mb * 2**20
        self.schema = _data_schema(features)
        self.number, self.frames = -1, 0
        self.writer: pq.ParquetWriter | None = None
        self.paths: list[Path] = []

    def __enter__(self) -> "DataFiles":
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def begin(self, frames: int) -> tuple[int, int]:
        """Choose the file of an episode: chunk and number in it."""
        size = self.paths[-1].stat().st_size if self.writer is not None else 0
        if self.writer is None or size + size / max(self.frames, 1) * frames >= self.limit:
            self._close()
            self.number, self.frames = self.number + 1, 0
            chunk, file = divmod(self.number, CHUNK_FILES)
            path = self.folder / DATA_PATH.format(chunk_index=chunk, file_index=file)
            path.parent.mkdir(parents=True, exist_ok=True)
            self.paths.append(path)
            self.writer = pq.ParquetWriter(path, self.schema, compression="snappy", use_dictionary=False)
        return divmod(self.number, CHUNK_FILES)

    def write(self, columns: Mapping[str, Any], *, images: str, pngs: Sequence[bytes], first: int) -> None:
        """Write frames of an episode as a row group.

        Parameters
        ----------
        columns
            All features but the images; an array of vectors has a row a frame.
        images, pngs
            Feature of the images, and these.
        first
            Number of the first of them in the episode.
        """
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
        found = []
        for path in self.paths:
            column = pq.read_table(path, columns=[name]).column(name).combine_chunks()
            flat = column.flatten() if pa.types.is_fixed_size_list(column.type) else column
            found.append(flat.to_numpy(zero_copy_only=False).reshape(len(column), -1))
        return np.concatenate(found)

    def _close(self) -> None:
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


def write_episodes(folder: Path, episodes: Sequence[EpisodeEntry]) -> None:
    """Write `meta/episodes`: where each episode lies, and its statistics."""
    columns: dict[str, Any] = {
        "episode_index": range(len(episodes)),
        "tasks": [[one.task] for one in episodes],
        "length": [one.length for one in episodes],
        "data/chunk_index": [one.chunk for one in episodes],
        "data/file_index": [one.file for one in episodes],
        "dataset_from_index": [one.first for one in episodes],
        "dataset_to_index": [one.first + one.length for one in episodes],
    }
    for feature, stats in episodes[0].stats.items():
        for name in stats:
            columns[f"stats/{feature}/{name}"] = [one.stats[feature][name] for one in episodes]
    columns |= {f"meta/episodes/{name}": [0] * len(episodes) for name in ("chunk_index", "file_index")}
    path = folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(columns), path)


def _data_schema(features: Features) -> pa.Schema:
    """Columns of a data file, with what the `datasets` library reads of them, so that it, too, shows images."""
    fields, told = [], {}
    for name, feature in features.items():
        kind, width = feature["dtype"], feature["shape"][0]
        value = {"dtype": kind, "_type": "Value"}
        if kind == "image":
            fields.append(pa.field(name, _IMAGE))
            told[name] = {"_type": "Image"}
        elif width > 1:
            fields.append(pa.field(name, pa.list_(_TYPES[kind], width)))
            told[name] = {"feature": value, "length": width, "_type": "List"}
        else:
            fields.append(pa.field(name, _TYPES[kind]))
            told[name] = value
    return pa.schema(fields, {"huggingface": json.dumps({"info": {"features": told}})})
