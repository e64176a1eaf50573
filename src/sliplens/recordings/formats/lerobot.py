"""LeRobot v3 data sets of a tactile camera and a force sensor."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from math import floor, prod
from operator import itemgetter
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float

from sliplens.codec import open_parquet, parquet_errors, read_parquet
from sliplens.errors import InputError, RecordingError
from sliplens.files import read_json
from sliplens.images import read_image
from sliplens.recordings.capture import Capture, Forces, Frame
from sliplens.recordings.formats.tables import trial_name
from sliplens.recordings.formats.video import first_frame_size, loss_note, open_video, upright
from sliplens.recordings.options import ReadOptions

_COPY = "copy the data set again"
_LATEST_S = 1e7  # of a stamp in a video: four months
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"  # of every data set of v3.0
_TACTILE = re.compile(r"tactile|touch|gel|digit|tactip|fingertip|skin", re.IGNORECASE)
_FORCE = re.compile(r"force|wrench|(?<![a-z])f_?t(?![a-z])", re.IGNORECASE)
_TORQUE = re.compile(r"torque|moment|(?<![a-z])[tm]_?[xyz](?![a-z])", re.IGNORECASE)


@dataclass(frozen=True, kw_only=True)
class Feature:
    """Feature that `meta/info.json` lists; names and info are checked where they are used."""

    dtype: str
    shape: tuple[int, ...]
    names: Any = None
    info: Any = None

    @property
    def is_camera(self) -> bool:
        """True for colour images or videos."""
        info = self.info if isinstance(self.info, dict) else {}
        depth = info.get("is_depth_map") or info.get("video.is_depth_map")
        return self.dtype in {"video", "image"} and not depth


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Contents of `meta/info.json`."""

    folder: Path
    fps: Annotated[float, msgspec.Meta(gt=0)]
    features: dict[str, Feature]


def read_layout(folder: Path) -> Layout:
    """Read `meta/info.json`."""
    path = folder / "meta" / "info.json"
    try:
        info = read_json(path, missing="name the folder of a LeRobot data set", damaged=_COPY)
    except InputError as error:
        raise RecordingError(str(error)) from None
    version = str(info.get("codebase_version")) if isinstance(info, dict) else ""
    if not version.startswith("v3."):
        cure = "convert it with `python -m lerobot.scripts.convert_dataset_v21_to_v30`"
        raise RecordingError(f"{path} has codebase_version {version[:40]!r}, v3.0 is needed; {cure}")
    try:
        return msgspec.convert({**info, "folder": folder}, Layout)
    except msgspec.ValidationError as error:
        raise RecordingError(f"{path} is not that of a LeRobot data set ({error}); {_COPY}") from None


def _read_episodes(layout: Layout, *, video: str) -> list[dict[str, int | float]]:
    """Read the rows of the episodes, in their order; `video` begins the columns of their place in videos, if any."""
    names = ["episode_index", "length", "data/chunk_index", "data/file_index"]
    names += [f"{video}{name}" for name in ("chunk_index", "file_index", "from_timestamp")] if video else []
    columns = {name: "numbers" if name.endswith("timestamp") else "whole numbers" for name in names}
    folder, rows = layout.folder / "meta" / "episodes", []
    for path in sorted(folder.glob("*/*.parquet")):
        rows += read_parquet(path, columns, cure=_COPY, error=RecordingError).to_pylist()
    if not rows:
        raise RecordingError(f"{folder} lists no episode; record one, or copy it again")
    rows.sort(key=itemgetter("episode_index"))
    for before, row in zip([{}, *rows], rows, strict=False):
        if before.get("episode_index") == row["episode_index"]:
            raise RecordingError(f"{folder} lists episode {row['episode_index']} twice; {_COPY}")
        if not 0 <= (start_s := row.get(f"{video}from_timestamp", 0)) <= _LATEST_S:
            raise RecordingError(f"{folder} begins episode {row['episode_index']} at {start_s:g} s of a video; {_COPY}")
    return rows


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


def image_frames(path: Path, key: str, *, episode: int, frame_size: tuple[int, int] | None = None) -> Iterator[Frame]:
    """Decode the frames of an episode in a Parquet file."""
    index = 0
    columns = {"episode_index": "whole numbers", key: "values"}
    damage = parquet_errors(path, cure=_COPY, error=RecordingError)
    with open_parquet(path, columns, cure=_COPY, error=RecordingError), damage:
        import pyarrow.dataset as ds  # noqa: PLC0415 (takes a second, and other formats are read without)

        of_episode, ahead = pc.field("episode_index") == episode, {"batch_readahead": 1, "fragment_readahead": 1}
        for batch in ds.dataset(path).to_batches(columns=[key], filter=of_episode, batch_size=16, **ahead):
            for cell in batch.column(key).to_pylist():
                where = f"frame {index} of {key}, episode {episode} of {path},"
                data = cell.get("bytes") if isinstance(cell, dict) else None
                if not isinstance(data, bytes) or not data:
                    raise RecordingError(f"{where} is not in the file; embed the images, or {_COPY}")
                pixels = read_image(data, where=where)
                if frame_size is not None and pixels.shape[:2] != frame_size:
                    raise RecordingError(f"{where} is of another size than the first; leave the episode out")
                yield pixels
                index += 1
    if not index:
        raise RecordingError(f"{path} has no frame of episode {episode}; {_COPY}")


def read_lerobot(folder: Path, options: ReadOptions) -> list[Capture]:
    """Read a data set, one trial an episode."""
    layout = read_layout(folder)
    cameras = [key for key, feature in layout.features.items() if feature.is_camera]
    tactile = [key for key in cameras if _TACTILE.search(key)]
    camera = _choose(layout, cameras, tactile or cameras, name=options.camera_key, kind="camera")
    force = _choose_force(layout, options.force_key)
    notes = [] if force else ["There are no forces: no feature of 3 or 6 numbers is named like one."]
    kinds = {"episode_index": "whole numbers", "timestamp": "numbers", **({force: "values"} if force else {})}
    # episodes share files
    read_table = lru_cache(maxsize=1)(partial(read_parquet, columns=kinds, cure=_COPY, error=RecordingError))

    @cache
    def read_header(path: Path) -> tuple[tuple[int, int], tuple[str, ...]]:
        with open_video(path) as (_, stream):
            return first_frame_size(path), loss_note(stream, name=path.name)

    if trial_name(camera) != camera:
        raise RecordingError(f"the camera {camera[:40]!r} of {layout.folder} cannot name a folder; copy one you trust")
    video = f"videos/{camera}/" if layout.features[camera].dtype == "video" else ""
    captures = []
    for row in _read_episodes(layout, video=video):
        episode, loss, forces = int(row["episode_index"]), (), None
        places = {name: int(row[f"data/{name}"]) for name in ("chunk_index", "file_index")}
        path = layout.folder / "data" / f"{_FILE.format(**places)}.parquet"
        source = f"episode {episode} of {layout.folder}"
        table = read_table(path).filter(pc.field("episode_index") == episode)
        if table.num_rows != row["length"] or not table.num_rows:
            count = f"{path} has {table.num_rows} frames of episode {episode}, its metadata say {row['length']}"
            raise RecordingError(f"{count}; leave the episode out, or {_COPY}")
        time_s = table.column("timestamp").to_numpy().astype(np.float64)
        if force is not None:
            column, width = table.column(force).combine_chunks(), prod(layout.features[force].shape)
            numbers = column.flatten() if hasattr(column, "flatten") else column
            if len(numbers) != len(table) * width or numbers.null_count or not pa.types.is_floating(numbers.type):
                holds = f"{force} of {path} does not hold {width} numbers a frame, as meta/info.json says"
                raise RecordingError(f"{holds}; {_COPY}")
            force_n = numbers.to_numpy().astype(np.float64).reshape(-1, width)[:, :3].copy()
            forces = Forces(time_s=time_s, force_n=force_n, source=f"{force} of {source}")
        if video:
            places = {name: int(row[f"{video}{name}"]) for name in ("chunk_index", "file_index")}
            file = layout.folder / video / f"{_FILE.format(**places)}.mp4"
            size, loss = read_header(file)
            stamps_s, tolerance_s = row[f"{video}from_timestamp"] + time_s, 0.5 / layout.fps
            read_frames = partial(video_frames, file, stamps_s, tolerance_s=tolerance_s, frame_size=size)
        else:
            read_frames = partial(image_frames, path, camera, episode=episode)
            size = next(read_frames()).shape[:2]
            read_frames = partial(read_frames, frame_size=size)
        captures.append(
            Capture(
                trial=trial_name(f"{layout.folder.resolve().name}-{episode:06d}"),
                source=f"{camera} of {source}",
                frame_time_s=time_s,
                frame_size=size,
                read_frames=read_frames,
                forces=forces,
                notes=(*notes, *loss),
            )
        )
    return captures


def _choose(layout: Layout, fitting: Sequence[str], likely: Sequence[str], *, name: str | None, kind: str) -> str:
    """Return the feature that an option names, or the only one that is likely."""
    chosen = likely if name is None else [key for key in fitting if key == name]
    if len(chosen) == 1:
        return chosen[0]
    wanted = f"{len(chosen) or 'no'} {kind}s" if name is None else f"no {kind} {name}"
    some = ", ".join(fitting) or "none"
    raise RecordingError(f"{layout.folder} has {wanted} among {some}; name one with --{kind}-key")


def _choose_force(layout: Layout, name: str | None) -> str | None:
    fitting = [
        key for key, each in layout.features.items() if each.dtype.startswith("float") and each.shape in ((3,), (6,))
    ]
    # what was commanded is not what was felt
    likely = [key for key in fitting if _FORCE.search(key) and not key.startswith("action")]
    if not likely and name is None:
        return None
    force = _choose(layout, fitting, likely, name=name, kind="force")
    # names of the numbers are a list, or lists by group
    names = layout.features[force].names
    groups = names.values() if isinstance(names, dict) else [names]
    first = [str(name) for group in groups if isinstance(group, list) for name in group][:3]
    if any(_TORQUE.search(name) for name in first):
        raise RecordingError(f"{force} of {layout.folder} begins with {', '.join(first)}; forces must come first")
    return force
