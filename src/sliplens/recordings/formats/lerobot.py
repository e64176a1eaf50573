"""LeRobot v3.0 data sets of a tactile camera and a force sensor."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from math import floor, prod
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float

from sliplens.codec import read_parquet
from sliplens.errors import RecordingError
from sliplens.files import read_json
from sliplens.recordings.capture import Capture, Forces, Frame
from sliplens.recordings.formats.tables import trial_name
from sliplens.recordings.formats.video import open_video, read_size, upright
from sliplens.recordings.options import ReadOptions, choose_named

_COPY = "copy the data set again"
_CONVERT = "convert an older one with `python -m lerobot.scripts.convert_dataset_v21_to_v30`"
_LATEST_S = 1e7  # of a stamp in a video: four months
_TACTILE = re.compile(r"tactile|touch|gel|digit|tactip|fingertip|skin", re.IGNORECASE)
_FORCE = re.compile(r"^(?!action).*(force|wrench|(?<![a-z])f_?t(?![a-z]))", re.IGNORECASE)  # felt, not commanded
_TORQUE = re.compile(r"torque|moment|(?<![a-z])[tm]_?[xyz](?![a-z])", re.IGNORECASE)
_read_rows = partial(read_parquet, cure=_COPY, error=RecordingError)


@dataclass(frozen=True, kw_only=True)
class Feature:
    """Feature that `meta/info.json` lists."""

    dtype: str
    shape: tuple[int, ...]
    names: Any = None


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Contents of `meta/info.json`."""

    codebase_version: Annotated[str, msgspec.Meta(pattern=r"^v3\.")]
    fps: Annotated[float, msgspec.Meta(gt=0)]
    features: dict[str, Feature]


def video_frames(
    path: Path, stamps_s: Float[np.ndarray, " frames"], *, tolerance_s: float, frame_size: tuple[int, int]
) -> Iterator[Frame]:
    """Decode the frames nearest to some stamps of a video."""
    with open_video(path) as (container, video):
        if video.time_base is not None:  # to a key frame at or before the first stamp
            container.seek(max(floor((float(stamps_s[0]) - tolerance_s) / video.time_base), 0), stream=video)
        decoded = (frame for frame in container.decode(video) if frame.time is not None and not frame.is_corrupt)
        current, following = next(decoded, None), next(decoded, None)
        for stamp in stamps_s:
            while current and following and abs(following.time - stamp) < abs(current.time - stamp):
                current, following = following, next(decoded, None)
            if current is None or abs(current.time - stamp) > tolerance_s:
                raise RecordingError(f"{path} has no frame at {stamp:.3f} s; it is cut off, {_COPY}")
            pixels = upright(current, current.to_ndarray(format="rgb24"), where=path)
            if pixels.shape[:2] != frame_size:
                raise RecordingError(f"{path} changes its size of frames at {stamp:.3f} s; leave the episode out")
            yield pixels


def read_lerobot(folder: Path, options: ReadOptions) -> list[Capture]:
    """Read a data set, one trial an episode."""
    path = folder / "meta" / "info.json"
    info = read_json(path, missing="name the folder of a LeRobot data set", damaged=_COPY)
    try:
        layout = msgspec.convert(info, Layout)
    except msgspec.ValidationError as error:
        raise RecordingError(f"{path} is not that of LeRobot v3.0 ({error}); {_CONVERT}, or {_COPY}") from None
    camera, force = _choose_features(folder, layout.features, options)
    start, video = f"videos/{camera}/from_timestamp", f"videos/{camera}"
    whole = [f"{kind}/{place}" for kind in ("data", video) for place in ("chunk_index", "file_index")]
    columns = dict.fromkeys(("episode_index", "length", *whole), "whole numbers") | {start: "numbers"}
    listed, rows = folder / "meta" / "episodes", {}
    for path in sorted(listed.glob("*/*.parquet")):
        rows |= {row["episode_index"]: row for row in _read_rows(path, columns).to_pylist()}
    if not rows:
        raise RecordingError(f"{listed} lists no episode; record one, or copy it again")
    # episodes share files
    kinds = {"episode_index": "whole numbers", "timestamp": "numbers", **({force: "values"} if force else {})}
    read_table, read_header = lru_cache(maxsize=1)(partial(_read_rows, columns=kinds)), cache(read_size)
    captures = []
    for episode, row in sorted(rows.items()):
        path, file = (
            folder / kind / f"chunk-{row[kind + '/chunk_index']:03d}" / f"file-{row[kind + '/file_index']:03d}{suffix}"
            for kind, suffix in (("data", ".parquet"), (video, ".mp4"))
        )
        source, table = f"episode {episode} of {folder}", read_table(path).filter(pc.field("episode_index") == episode)
        if not 0 < len(table) == row["length"] or not 0 <= row[start] <= _LATEST_S:
            facts = f"{len(table)} frames of {source}, its metadata say {row['length']}, from {row[start]:g} s on"
            raise RecordingError(f"{path} has {facts} in the video; leave the episode out, or {_COPY}")
        time_s, (size, loss) = table.column("timestamp").to_numpy().astype(np.float64), read_header(file)
        forces, notes = None, (f"There are no forces: no feature of {folder} is named like one.", *loss)
        if force:
            column, width = table.column(force).combine_chunks(), prod(layout.features[force].shape)
            numbers = column.flatten() if hasattr(column, "flatten") else column
            if len(numbers) != len(table) * width or numbers.null_count or not pa.types.is_floating(numbers.type):
                raise RecordingError(f"{force} of {path} does not hold {width} numbers a frame; {_COPY}")
            force_n = numbers.to_numpy().astype(np.float64).reshape(-1, width)[:, :3].copy()
            forces, notes = Forces(time_s=time_s, force_n=force_n, source=f"{force} of {source}"), loss
        capture = Capture(
            trial=trial_name(f"{folder.resolve().name}-{episode:06d}"),
            source=f"{camera} of {source}",
            frame_time_s=time_s,
            frame_size=size,
            read_frames=partial(video_frames, file, row[start] + time_s, tolerance_s=0.5 / layout.fps, frame_size=size),
            forces=forces,
            notes=notes,
        )
        captures.append(capture)
    return captures


def _choose_features(folder: Path, features: dict[str, Feature], options: ReadOptions) -> tuple[str, str | None]:
    """Return the camera, and the feature of forces, None where no name is like that of one."""
    wrenches = [key for key, each in features.items() if each.dtype[:5] == "float" and each.shape in ((3,), (6,))]
    cameras = [key for key, each in features.items() if each.dtype == "video"]
    tactile, forces = [*filter(_TACTILE.search, cameras)], [*filter(_FORCE.search, wrenches)]
    camera, force = (
        choose_named(folder, fitting, name, likely=likely, what=what, option=f"--{what}-key")
        for what, name, fitting, likely in (
            ("camera", options.camera_key, cameras, tactile or cameras),
            ("force", options.force_key, wrenches, forces),
        )
    )
    if camera is None or trial_name(camera) != camera:
        wrong = f"the camera {camera[:40]!r} of {folder} cannot name a folder" if camera else f"{folder} has no camera"
        raise RecordingError(f"{wrong}; copy one you trust")
    # names of the numbers are a list, or lists by group
    first = re.findall(r"'(\w[^']*)'(?!: \[)", str(features[force].names))[:3] if force else []
    if any(map(_TORQUE.search, first)):
        raise RecordingError(f"{force} of {folder} begins with {', '.join(first)}; forces must come first")
    return camera, force
