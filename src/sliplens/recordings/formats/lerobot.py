"""LeRobot v3 data sets of a tactile camera and a force sensor."""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from math import floor, prod
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Annotated, Any

import av
import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from av.container import InputContainer
from av.video.stream import VideoStream
from jaxtyping import Float

from sliplens.codec import open_parquet, parquet_errors, read_parquet
from sliplens.errors import InputError, RecordingError
from sliplens.files import read_json
from sliplens.images import telling_damage
from sliplens.recordings.capture import Capture, Forces, Frame
from sliplens.recordings.formats.images import open_encoded, rgb_pixels
from sliplens.recordings.formats.stored import restore_trials
from sliplens.recordings.formats.tables import trial_name
from sliplens.recordings.formats.video import display_turn, open_video, read_display_turn, require_size
from sliplens.recordings.options import ReadOptions

CAMERA = "observation.images.tactile"  #: Feature of the images that `export_lerobot` writes.
COMPANION = Path("meta", "sliplens")  #: Folder in an exported data set with all of its trials but the images.
_COPY = "copy the data set again"
_NO_VIDEO = "copy the data set again, with its videos"
_LATEST_S = 1e7  # of a stamp in a video: four months
_VERSION = re.compile(r"v3\.\d+")
_FIELD = re.compile(r"\{(video_key|chunk_index|file_index)(?::0?([1-9])d)?\}")


@dataclass(frozen=True, kw_only=True)
class Episode:
    """Place of an episode in the files."""

    index: int
    length: int  #: Frames.
    data_file: Path
    video_file: Path | None  #: None where the frames are in the data file.
    video_start_s: float  #: Stamp of the first frame in the video.


@dataclass(frozen=True, kw_only=True)
class Feature:
    """Feature that `meta/info.json` lists; names and info are checked where they are used."""

    dtype: str
    shape: tuple[int, ...]
    names: Any = None
    info: Any = None
    video_info: Any = None


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Contents of `meta/info.json`."""

    folder: Path
    fps: Annotated[float, msgspec.Meta(gt=0)]
    features: dict[str, Feature]
    data_path: str
    video_path: str | None = None


def read_layout(folder: Path) -> Layout:
    """Read `meta/info.json`."""
    path = folder / "meta" / "info.json"
    try:
        info = read_json(path, missing="name the folder of a LeRobot data set", damaged="copy it again")
    except InputError as error:
        raise RecordingError(str(error)) from None
    version = info.get("codebase_version") if isinstance(info, dict) else None
    if version is None:
        raise RecordingError(f"{path} has no codebase_version; name the folder of a LeRobot data set")
    if not _VERSION.fullmatch(str(version)):
        cure = "convert it with `python -m lerobot.scripts.convert_dataset_v21_to_v30`"
        raise RecordingError(f"{folder} is a LeRobot data set of version {version}, v3.0 is needed; {cure}")
    try:
        return msgspec.convert({**info, "folder": folder}, Layout)
    except msgspec.ValidationError as error:
        raise RecordingError(f"{path} is not that of a LeRobot data set ({error}); copy it again") from None


def read_episodes(layout: Layout, *, camera_key: str) -> list[Episode]:
    """Find the episodes of a data set and the files with their frames from a camera, in their order."""
    in_video = layout.features[camera_key].dtype == "video"
    columns: dict[str, str] = dict.fromkeys(
        ("episode_index", "length", "data/chunk_index", "data/file_index"), "whole numbers"
    )
    if in_video:
        columns |= {f"videos/{camera_key}/{name}": "whole numbers" for name in ("chunk_index", "file_index")}
        columns[f"videos/{camera_key}/from_timestamp"] = "numbers"
    folder = layout.folder / "meta" / "episodes"
    rows = []
    for path in sorted(folder.glob("*/*.parquet")):
        table = read_parquet(path, columns, cure=_COPY, error=RecordingError)
        rows += zip(*(table.column(name).to_pylist() for name in columns), strict=True)
    if not rows:
        raise RecordingError(f"{folder} lists no episode; record one, or copy it again")
    episodes = []
    for index, length, chunk, file, *video in sorted(rows):
        if episodes and episodes[-1].index == index:
            raise RecordingError(f"{folder} lists episode {index} twice; copy the data set again")
        if in_video and not 0 <= video[2] <= _LATEST_S:
            raise RecordingError(f"{folder} begins episode {index} at {video[2]:g} s of a video; {_COPY}")
        data = {"chunk_index": chunk, "file_index": file}
        places = {"video_key": camera_key, **dict(zip(data, video, strict=False))}
        episodes.append(
            Episode(
                index=index,
                length=length,
                data_file=_expand(layout, layout.data_path, data),
                video_file=_expand(layout, layout.video_path or "", places) if in_video else None,
                video_start_s=float(video[2]) if in_video else 0.0,
            )
        )
    return episodes


def _expand(layout: Layout, template: str, values: Mapping[str, int | str]) -> Path:
    """Fill in a template of `info.json`; not by `str.format`, which lets a hostile file reach attributes."""
    path = _FIELD.sub(lambda field: f"{values.get(field[1], '{}')}".rjust(int(field[2] or 0), "0"), template)
    parts = {*PurePosixPath(path).parts, *PureWindowsPath(path).parts}
    outside = PurePosixPath(path).is_absolute() or PureWindowsPath(path).anchor or ".." in parts
    if not path or outside or re.search(r"[{}\0]", path):
        info = f"{layout.folder / 'meta' / 'info.json'} names files by {template!r}"
        raise RecordingError(f"{info}, which leads out of the data set or cannot be filled in; copy one you trust")
    return layout.folder / path


def read_tables(episodes: list[Episode], columns: Mapping[str, str]) -> Iterator[tuple[Episode, pa.Table]]:
    """Read the rows of episodes one after another, with columns of some kinds; each data file is read once."""
    kinds = {"episode_index": "whole numbers", **columns}
    read = lru_cache(maxsize=1)(partial(read_parquet, columns=kinds, cure=_COPY, error=RecordingError))
    for episode in episodes:
        path = episode.data_file
        rows = read(path).filter(pc.field("episode_index") == episode.index)
        if rows.num_rows != episode.length or not rows.num_rows:
            rows_of = f"{path} has {rows.num_rows} frames of episode {episode.index}"
            raise RecordingError(f"{rows_of}, its metadata say {episode.length}; leave the episode out, or {_COPY}")
        yield episode, rows


def read_vectors(rows: pa.Table, key: str, *, width: int, path: Path) -> Float[np.ndarray, "frames numbers"]:
    """Return a feature of several floating-point numbers a frame."""
    column = rows.column(key).combine_chunks()
    numbers = column.flatten() if hasattr(column, "flatten") else column
    if len(numbers) != len(rows) * width or numbers.null_count or not pa.types.is_floating(numbers.type):
        raise RecordingError(f"{key} of {path} does not hold {width} numbers a frame, as meta/info.json says; {_COPY}")
    return numbers.to_numpy().astype(np.float64).reshape(-1, width)


def read_video_header(path: Path) -> tuple[tuple[int, int], tuple[str, ...]]:
    """Return height and width of the frames of a video, and a note if it is lossy."""
    with open_video(path, missing=_NO_VIDEO) as (_, video):
        codec = video.codec_context.codec
        note = f"Frames are coded with loss ({codec.canonical_name}), which moves markers a little."
        size = require_size(path, video)
    return read_display_turn(path, missing=_NO_VIDEO).size(*size), (note,) * codec.lossy


def video_frames(
    path: Path, stamps_s: Float[np.ndarray, " frames"], *, tolerance_s: float, frame_size: tuple[int, int]
) -> Iterator[Frame]:
    """Decode the frames nearest to some stamps of a video."""
    with open_video(path, missing=_NO_VIDEO) as (container, video):
        decoded = _decode_from(container, video, float(stamps_s[0]) - tolerance_s)
        current, following = next(decoded, None), next(decoded, None)
        for stamp in stamps_s:
            while current and following and abs(following[0] - stamp) < abs(current[0] - stamp):
                current, following = following, next(decoded, None)
            if current is None or abs(current[0] - stamp) > tolerance_s:
                raise RecordingError(f"{path} has no frame at {stamp:.3f} s; it is cut off, {_COPY}")
            frame = current[1]
            turn = display_turn(frame, where=path)
            height, width = turn.size(frame.height, frame.width)
            if (height, width) != frame_size:
                raise RecordingError(f"{path} changes its size of frames at {stamp:.3f} s; leave the episode out")
            yield turn.apply(frame.to_ndarray(format="rgb24"))


def image_frames(episode: Episode, key: str) -> tuple[tuple[int, int], Callable[[], Iterator[Frame]]]:
    """Return the size of the frames of an episode in a Parquet file, and how to read them."""
    read = partial(_stored_images, episode.data_file, key, episode.index)
    first = next(read(frame_size=None), None)
    if first is None:
        raise RecordingError(f"{episode.data_file} has no frame of episode {episode.index}; copy the data set again")
    height, width, _ = first.shape
    return (height, width), partial(read, frame_size=(height, width))


def _stored_images(path: Path, key: str, episode: int, *, frame_size: tuple[int, int] | None) -> Iterator[Frame]:
    index = 0
    columns = {"episode_index": "whole numbers", key: "values"}
    damage = parquet_errors(path, cure=_COPY, error=RecordingError)
    with open_parquet(path, columns, cure=_COPY, error=RecordingError) as file, damage:
        # without this, each episode would cost all that share its file
        import pyarrow.dataset as ds  # noqa: PLC0415 (takes a second, and other formats are read without)

        (fragment,) = ds.dataset(path).get_fragments()
        groups = [group.id for group in fragment.subset(pc.field("episode_index") == episode).row_groups]
        for batch in file.iter_batches(batch_size=16, row_groups=groups, columns=list(columns)):
            inside = batch.column("episode_index").to_numpy() == episode
            for cell in batch.filter(pa.array(inside)).column(key).to_pylist():
                where = f"frame {index} of {key}, episode {episode} of {path},"
                data = cell.get("bytes") if isinstance(cell, dict) else None
                if not isinstance(data, bytes) or not data:
                    raise RecordingError(f"{where} is not in the file; embed the images, or copy the data set again")
                pixels = decode_image(data, where=where)
                if frame_size is not None and pixels.shape[:2] != frame_size:
                    raise RecordingError(f"{where} is of another size than the first; leave the episode out")
                yield pixels
                index += 1


def decode_image(data: bytes, *, where: str) -> Frame:
    """Decode a PNG or JPEG."""
    damage = telling_damage(f"{where} cannot be read as PNG or JPEG", _COPY, kind=RecordingError)
    with damage, open_encoded(data, where=where) as image:
        return rgb_pixels(image)


def _decode_from(
    container: InputContainer, stream: VideoStream, start_s: float
) -> Iterator[tuple[float, av.VideoFrame]]:
    """Decode frames with their stamps, from a key frame at or before `start_s`."""
    stream.thread_type = "AUTO"
    if stream.time_base is not None:
        container.seek(max(floor(start_s / stream.time_base), 0), stream=stream)
    for frame in container.decode(stream):
        if frame.time is not None and not frame.is_corrupt:
            yield frame.time, frame


_TACTILE = re.compile(r"tactile|touch|gel|digit|tactip|fingertip|skin", re.IGNORECASE)
_FORCE = re.compile(r"force|wrench|(?<![a-z])f_?t(?![a-z])", re.IGNORECASE)
_TORQUE = re.compile(r"torque|moment|(?<![a-z])[tm]_?[xyz](?![a-z])", re.IGNORECASE)


def read_lerobot(folder: Path, options: ReadOptions) -> list[Capture]:
    """Read a data set, one trial an episode; one that `export_lerobot` wrote is restored, unless a feature is named."""
    layout = read_layout(folder)
    if options.camera_key is None and options.force_key is None and (folder / COMPANION).is_dir():
        return _restore_episodes(layout)
    camera, notes = _choose_camera(layout, options.camera_key)
    force = _choose_force(layout, options.force_key)
    if force is None:
        notes.append("There are no forces: no feature of 3 or 6 numbers is named like one.")
    video_header = cache(read_video_header)  # episodes share files
    captures = []
    columns = {"timestamp": "numbers", **({force: "values"} if force else {})}
    for episode, rows in read_tables(read_episodes(layout, camera_key=camera), columns):
        time, loss = rows.column("timestamp").to_numpy().astype(np.float64), ()
        source, forces = f"episode {episode.index} of {layout.folder}", None
        if force is not None:
            width = prod(layout.features[force].shape)
            force_n = read_vectors(rows, force, width=width, path=episode.data_file)[:, :3].copy()
            forces = Forces(time_s=time, force_n=force_n, source=f"{force} of {source}")
        if episode.video_file is None:
            size, read_frames = image_frames(episode, camera)
        else:
            size, loss = video_header(episode.video_file)
            stamps_s, tolerance_s = episode.video_start_s + time, 0.5 / layout.fps
            read_frames = partial(video_frames, episode.video_file, stamps_s, tolerance_s=tolerance_s, frame_size=size)
        captures.append(
            Capture(
                trial=trial_name(f"{layout.folder.resolve().name}-{episode.index:06d}"),
                source=f"{camera} of {source}",
                frame_time_s=time,
                frame_size=size,
                read_frames=read_frames,
                forces=forces,
                notes=(*notes, *loss),
            )
        )
    return captures


def _restore_episodes(layout: Layout) -> list[Capture]:
    """Read the trials of an exported data set as they were."""
    if CAMERA not in layout.features:
        raise RecordingError(f"meta/info.json of {layout.folder} lacks {CAMERA}; {_COPY}, or remove {COMPANION} in it")
    images = []
    for episode, _ in read_tables(read_episodes(layout, camera_key=CAMERA), {}):
        size, read_frames = image_frames(episode, CAMERA)
        images.append((f"episode {episode.index} of {layout.folder}", episode.length, size, read_frames))
    return restore_trials(layout.folder / COMPANION, images)


def _choose_camera(layout: Layout, name: str | None) -> tuple[str, list[str]]:
    cameras = [
        key
        for key, feature in layout.features.items()
        if feature.dtype in {"video", "image"} and not _is_depth(feature)
    ]
    if name is not None:
        if name not in cameras:
            raise RecordingError(f"{layout.folder} has no camera {name}; it has {_list_keys(cameras)}")
        return name, []
    tactile = [key for key in cameras if _TACTILE.search(key)]
    if len(tactile) == 1:
        return tactile[0], []
    if len(cameras) == 1:
        return cameras[0], [f"{cameras[0]} was taken for the tactile camera, for there is no other."]
    if not cameras:
        raise RecordingError(f"{layout.folder} has no camera; record one, as video or images")
    several = f"{_list_keys(cameras)}, of which {_list_keys(tactile)} could be tactile"
    raise RecordingError(f"{layout.folder} has cameras {several}; name one with --camera-key")


def _choose_force(layout: Layout, name: str | None) -> str | None:
    fitting = [
        key
        for key, feature in layout.features.items()
        if feature.dtype.startswith("float") and feature.shape in ((3,), (6,))
    ]
    if name is not None:
        if name not in layout.features:
            raise RecordingError(f"{layout.folder} has no feature {name}; 3 or 6 numbers have {_list_keys(fitting)}")
        if name not in fitting:
            feature = layout.features[name]
            kind = f"{feature.dtype} of shape {list(feature.shape)}"
            raise RecordingError(f"{name} of {layout.folder} is {kind}; a force has 3 or 6 floating-point numbers")
        forces = [name]
    else:
        # what was commanded is not what was felt
        forces = [key for key in fitting if _FORCE.search(key) and not key.startswith("action")]
        if len(forces) > 1:
            raise RecordingError(f"{layout.folder} has forces {_list_keys(forces)}; name one with --force-key")
    if not forces:
        return None
    # names of the numbers are a list, or lists by group
    names = layout.features[forces[0]].names
    groups = names.values() if isinstance(names, dict) else [names]
    first = [str(name) for group in groups if isinstance(group, list) for name in group][:3]
    if any(_TORQUE.search(name) for name in first):
        raise RecordingError(f"{forces[0]} of {layout.folder} begins with {', '.join(first)}; forces must come first")
    return forces[0]


def _is_depth(feature: Feature) -> bool:
    details = [each for each in (feature.info, feature.video_info) if isinstance(each, dict)]
    return any(each.get("is_depth_map") or each.get("video.is_depth_map") for each in details)


def _list_keys(keys: list[str]) -> str:
    return ", ".join(keys) or "none"
