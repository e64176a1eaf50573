"""Where a LeRobot v3 data set keeps what: its features, its episodes, and the files these lie in."""

import json
import re
from dataclasses import dataclass
from math import isfinite, prod
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from sliplens.errors import RecordingError
from sliplens.recordings.parquet import DAMAGED_PARQUET, one_line

_VERSION = re.compile(r"v3\.\d+")
_FIELD = re.compile(r"\{(video_key|chunk_index|file_index)(?::0?([1-9])d)?\}")


@dataclass(frozen=True, kw_only=True)
class Episode:
    """Where an episode lies."""

    index: int
    length: int
    """Frames."""
    data_file: Path
    video_file: Path | None
    """None where frames lie in the data file."""
    video_start_s: float
    """Stamp, in the video, of the first frame."""


@dataclass(frozen=True, kw_only=True)
class Layout:
    """What `meta/info.json` says."""

    folder: Path
    fps: float
    features: dict[str, dict[str, Any]]
    data_path: str
    video_path: str | None

    def width(self, key: str) -> int:
        """Numbers that a feature has in each frame."""
        return prod(self.features[key]["shape"])


def read_layout(folder: Path) -> Layout:
    """Read `meta/info.json`.

    Raises
    ------
    RecordingError
        If it is missing, damaged, or of another version of the format.
    """
    path = folder / "meta" / "info.json"
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        raise RecordingError(f"{path} does not exist; name the folder of a LeRobot data set") from None
    except (OSError, ValueError, RecursionError) as error:
        raise RecordingError(f"{path} is not valid JSON ({error}); copy it again") from None
    version = info.get("codebase_version") if isinstance(info, dict) else None
    if version is None:
        raise RecordingError(f"{path} has no codebase_version; name the folder of a LeRobot data set")
    if not _VERSION.fullmatch(str(version)):
        raise RecordingError(
            f"{folder} is a LeRobot data set of version {version}, v3.0 is needed; convert it with "
            "`python -m lerobot.scripts.convert_dataset_v21_to_v30`"
        )
    features, fps = info.get("features"), info.get("fps")
    if not isinstance(fps, int | float) or not isfinite(fps) or fps <= 0:
        raise RecordingError(f"{path} has fps {fps}; write a positive number of frames a second there")
    if not isinstance(features, dict) or not all(_is_feature(feature) for feature in features.values()):
        raise RecordingError(f"{path} lacks features with dtype and shape; copy it again")
    return Layout(
        folder=folder,
        fps=float(fps),
        features=features,
        data_path=str(info.get("data_path")),
        video_path=None if info.get("video_path") is None else str(info["video_path"]),
    )


def read_episodes(layout: Layout, *, camera_key: str, only: int | None = None) -> list[Episode]:
    """Episodes of a data set and where their frames from a camera lie, in their order.

    Parameters
    ----------
    layout
        What the data set says of itself.
    camera_key
        Feature with the images.
    only
        Index of the only episode that is wanted; all if None.

    Raises
    ------
    RecordingError
        If `meta/episodes` is missing or damaged, holds no episode or one twice, or not that which is wanted, or paths
        lead out of the folder.
    """
    in_video = layout.features[camera_key]["dtype"] == "video"
    columns = ["episode_index", "length", "data/chunk_index", "data/file_index"]
    video = [f"videos/{camera_key}/{name}" for name in ("chunk_index", "file_index", "from_timestamp")]
    folder = layout.folder / "meta" / "episodes"
    rows = []
    for path in sorted(folder.glob("*/*.parquet")):
        table = read_columns(path, columns + video * in_video)
        for name in columns + video[:2] * in_video:
            if not pa.types.is_integer(table.schema.field(name).type):
                raise RecordingError(f"{path} has no whole numbers in {name}; copy the data set again")
        rows += table.to_pylist()
    if not rows:
        raise RecordingError(f"{folder} lists no episode; record one, or copy it again")
    episodes = []
    for row in sorted(rows, key=lambda row: row["episode_index"]):
        if episodes and episodes[-1].index == row["episode_index"]:
            raise RecordingError(f"{folder} lists episode {row['episode_index']} twice; copy the data set again")
        data = {"chunk_index": row["data/chunk_index"], "file_index": row["data/file_index"]}
        chunk, file, start = (row[name] for name in video) if in_video else (0, 0, 0.0)
        where = {"video_key": camera_key, "chunk_index": chunk, "file_index": file}
        episodes.append(
            Episode(
                index=row["episode_index"],
                length=row["length"],
                data_file=_expand(layout, layout.data_path, data),
                video_file=_expand(layout, layout.video_path or "", where) if in_video else None,
                video_start_s=float(start),
            )
        )
    found = [one for one in episodes if only is None or one.index == only]
    if not found:
        raise RecordingError(
            f"{layout.folder} has no episode {only}; it has {len(episodes)}, from {episodes[0].index} to "
            f"{episodes[-1].index}"
        )
    return found


def read_columns(path: Path, columns: list[str]) -> pa.Table:
    """Columns of a Parquet file, with no value missing.

    Raises
    ------
    RecordingError
        If the file is missing or damaged, lacks a column, or a value is missing.
    """
    try:
        names = pq.read_schema(path).names
        missing = [name for name in columns if name not in names]
        if missing:
            raise RecordingError(
                f"{path} lacks {', '.join(missing)}; it is no file of a LeRobot v3 data set, or damaged"
            )
        table = pq.read_table(path, columns=columns)
    except FileNotFoundError:
        raise RecordingError(f"{path} does not exist; copy the data set again") from None
    except DAMAGED_PARQUET as error:
        raise RecordingError(f"{path} is not a readable Parquet file ({one_line(error)}); copy it again") from None
    for name in columns:
        if table.column(name).null_count:
            raise RecordingError(f"{path} has rows without {name}; finish writing the data set, or copy it again")
    return table


def _is_feature(feature: Any) -> bool:
    if not isinstance(feature, dict) or not isinstance(feature.get("dtype"), str):
        return False
    shape = feature.get("shape")
    return isinstance(shape, list) and all(isinstance(size, int) for size in shape)


def _expand(layout: Layout, template: str, values: dict[str, Any]) -> Path:
    """Fill in a template of `info.json`; it comes from outside, so `str.format` would trust it with too much."""
    path = _FIELD.sub(lambda field: f"{values.get(field[1], '{}')}".rjust(int(field[2] or 0), "0"), template)
    parts = {*PurePosixPath(path).parts, *PureWindowsPath(path).parts}
    outside = PurePosixPath(path).is_absolute() or PureWindowsPath(path).anchor or ".." in parts
    if not path or outside or re.search(r"[{}\0]", path):
        raise RecordingError(
            f"{layout.folder / 'meta' / 'info.json'} names files by {template!r}, which leads out of the data set or "
            "cannot be filled in; copy the data set from one you trust"
        )
    return layout.folder / path
