"""LeRobot v3 data sets of a tactile camera and a force sensor."""

import re
from collections.abc import Callable, Iterator
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

from sliplens.codec import open_parquet, read_parquet, telling_parquet
from sliplens.errors import InputError, RecordingError
from sliplens.files import read_json
from sliplens.images import telling_damage
from sliplens.recordings.capture import Capture, Forces, Frame
from sliplens.recordings.formats.images import open_encoded, rgb_pixels
from sliplens.recordings.formats.stored import ExportedTrial
from sliplens.recordings.formats.tables import trial_name
from sliplens.recordings.formats.video import display_turn, open_video, read_display_turn, require_size
from sliplens.recordings.options import ReadOptions
from sliplens.recordings.store import load_forces

_COPY = "copy the data set again"
_NO_VIDEO = "copy the data set again, with its videos"
_LATEST_S = 1e7  # of a stamp in a video: four months
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
class Feature:
    """One of the features that `meta/info.json` lists; what it may tell besides is believed where it is used."""

    dtype: str
    shape: tuple[int, ...]
    names: Any = None
    info: Any = None
    video_info: Any = None


@dataclass(frozen=True, kw_only=True)
class Layout:
    """What `meta/info.json` says."""

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
        raise RecordingError(
            f"{folder} is a LeRobot data set of version {version}, v3.0 is needed; convert it with "
            "`python -m lerobot.scripts.convert_dataset_v21_to_v30`"
        )
    try:
        return msgspec.convert({**info, "folder": folder}, Layout)
    except msgspec.ValidationError as error:
        raise RecordingError(f"{path} is not that of a LeRobot data set ({error}); copy it again") from None


def read_episodes(layout: Layout, *, camera_key: str) -> list[Episode]:
    """Episodes of a data set and where their frames from a camera lie, in their order."""
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
            raise RecordingError(
                f"{folder} begins episode {index} at {video[2]:g} s of a video; copy the data set again"
            )
        data = {"chunk_index": chunk, "file_index": file}
        where = {"video_key": camera_key, **dict(zip(data, video, strict=False))}
        episodes.append(
            Episode(
                index=index,
                length=length,
                data_file=_expand(layout, layout.data_path, data),
                video_file=_expand(layout, layout.video_path or "", where) if in_video else None,
                video_start_s=float(video[2]) if in_video else 0.0,
            )
        )
    return episodes


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


@dataclass(frozen=True, kw_only=True)
class Rows:
    """Rows of an episode, in their order."""

    layout: Layout
    episode: Episode
    table: pa.Table

    def vectors(self, key: str) -> Float[np.ndarray, "frames numbers"]:
        """A feature of several floating-point numbers a frame."""
        width = prod(self.layout.features[key].shape)
        column = self.table.column(key).combine_chunks()
        numbers = column.flatten() if hasattr(column, "flatten") else column
        if len(numbers) != len(self.table) * width or numbers.null_count or not pa.types.is_floating(numbers.type):
            raise RecordingError(
                f"{key} of {self.episode.data_file} does not hold {width} numbers a frame, as meta/info.json says; "
                "copy the data set again"
            )
        return numbers.to_numpy().astype(np.float64).reshape(-1, width)

    def values(self, key: str, fits: Callable[[pa.DataType], bool], what: str) -> np.ndarray:
        """A feature of one value a frame, as exact as it is stored."""
        column = self.table.column(key)
        if not fits(column.type):
            raise RecordingError(f"{key} of {self.episode.data_file} does not hold {what}; copy the data set again")
        return column.to_numpy()

    def numbers(self, key: str) -> Float[np.ndarray, " frames"]:
        """A feature of one number a frame."""
        return self.values(key, pa.types.is_floating, "numbers").astype(np.float64)

    def words(self, key: str) -> tuple[str, ...]:
        """A feature whose whole numbers count through words that `meta/info.json` lists."""
        codes = self.values(key, pa.types.is_integer, "whole numbers")
        info = self.layout.features[key].info
        words = info.get("values") if isinstance(info, dict) else None
        if not isinstance(words, list) or not all(isinstance(word, str) for word in words):
            raise RecordingError(
                f"meta/info.json of {self.layout.folder} does not list the values of {key}; copy the data set again"
            )
        if codes.min() < 0 or codes.max() >= len(words):
            raise RecordingError(
                f"{key} of {self.episode.data_file} leads beyond the {len(words)} values that meta/info.json lists; "
                "copy the data set again"
            )
        return tuple(words[code] for code in codes)


def read_rows(layout: Layout, episodes: list[Episode], columns: dict[str, str]) -> Iterator[Rows]:
    """Rows of episodes one after another, with columns of some kinds; those of one file share what was read of it."""
    wanted = {"episode_index": "whole numbers", **columns}
    read = lru_cache(maxsize=1)(partial(read_parquet, columns=wanted, cure=_COPY, error=RecordingError))
    for episode in episodes:
        path = episode.data_file
        rows = read(path).filter(pc.field("episode_index") == episode.index)
        if rows.num_rows != episode.length or not rows.num_rows:
            raise RecordingError(
                f"{path} has {rows.num_rows} frames of episode {episode.index}, its metadata say {episode.length}; "
                "leave the episode out, or copy the data set again"
            )
        yield Rows(layout=layout, episode=episode, table=rows)


def read_video_header(path: Path) -> tuple[tuple[int, int], tuple[str, ...]]:
    """Height and width of the frames of a video, and what is said of its coding."""
    with open_video(path, missing=_NO_VIDEO) as (_, video):
        codec = video.codec_context.codec
        note = f"Frames are coded with loss ({codec.canonical_name}), which moves markers a little."
        size = require_size(path, video)
    return read_display_turn(path, missing=_NO_VIDEO).size(*size), (note,) * codec.lossy


def video_frames(
    path: Path, wanted_s: Float[np.ndarray, " frames"], *, tolerance_s: float, frame_size: tuple[int, int]
) -> Iterator[Frame]:
    """Decode the frames nearest to some stamps of a video."""
    with open_video(path, missing=_NO_VIDEO) as (container, video):
        shown = _decode_from(container, video, float(wanted_s[0]) - tolerance_s)
        current, following = next(shown, None), next(shown, None)
        for wanted in wanted_s:
            while current and following and abs(following[0] - wanted) < abs(current[0] - wanted):
                current, following = following, next(shown, None)
            if current is None or abs(current[0] - wanted) > tolerance_s:
                raise RecordingError(
                    f"{path} has no frame at {wanted:.3f} s; it is cut off, or was not written with this data set"
                )
            frame = current[1]
            turn = display_turn(frame, where=path)
            height, width = turn.size(frame.height, frame.width)
            if (height, width) != frame_size:
                raise RecordingError(
                    f"{path} has frames of {height} x {width} pixels at {wanted:.3f} s, its header says "
                    f"{frame_size[0]} x {frame_size[1]}; leave the episode out"
                )
            yield turn.apply(frame.to_ndarray(format="rgb24"))


def image_frames(episode: Episode, key: str) -> tuple[tuple[int, int], Callable[[], Iterator[Frame]]]:
    """Size of the frames of an episode that lie in a Parquet file, and how they are read."""
    read = partial(_stored_images, episode.data_file, key, episode.index)
    first = next(read(frame_size=None), None)
    if first is None:
        raise RecordingError(f"{episode.data_file} has no frame of episode {episode.index}; copy the data set again")
    height, width, _ = first.shape
    return (height, width), partial(read, frame_size=(height, width))


def _stored_images(path: Path, key: str, episode: int, *, frame_size: tuple[int, int] | None) -> Iterator[Frame]:
    index = 0
    told: dict[str, Any] = {"cure": _COPY, "error": RecordingError}
    columns = {"episode_index": "whole numbers", key: "values"}
    with open_parquet(path, columns, **told) as file, telling_parquet(path, **told):
        # without this, each episode would cost all that share its file
        import pyarrow.dataset as ds  # noqa: PLC0415 (takes a second, and other formats are read without)

        (fragment,) = ds.dataset(path).get_fragments()
        groups = [group.id for group in fragment.subset(pc.field("episode_index") == episode).row_groups]
        for batch in file.iter_batches(batch_size=16, row_groups=groups, columns=list(columns)):
            own = batch.column("episode_index").to_numpy() == episode
            for cell in batch.filter(pa.array(own)).column(key).to_pylist():
                where = f"frame {index} of {key}, episode {episode} of {path},"
                data = cell.get("bytes") if isinstance(cell, dict) else None
                if not isinstance(data, bytes) or not data:
                    raise RecordingError(f"{where} is not in the file; embed the images, or copy the data set again")
                pixels = decode_image(data, where=where)
                if frame_size is not None and pixels.shape[:2] != frame_size:
                    raise RecordingError(
                        f"{where} is {pixels.shape[0]} x {pixels.shape[1]} pixels, the first is "
                        f"{frame_size[0]} x {frame_size[1]}; leave the episode out"
                    )
                yield pixels
                index += 1


def decode_image(data: bytes, *, where: str) -> Frame:
    """Pixels of a PNG or JPEG."""
    words = f"{where} cannot be read as PNG or JPEG"
    told = telling_damage(words, "copy the data set again", kind=RecordingError)
    with told, open_encoded(data, where=where) as image:
        return rgb_pixels(image)


def _decode_from(
    container: InputContainer, stream: VideoStream, start_s: float
) -> Iterator[tuple[float, av.VideoFrame]]:
    """Frames with their stamps, from a key frame at or before `start_s`."""
    stream.thread_type = "AUTO"
    if stream.time_base is not None:
        container.seek(max(floor(start_s / stream.time_base), 0), stream=stream)
    for frame in container.decode(stream):
        if frame.time is not None and not frame.is_corrupt:
            yield frame.time, frame


CAMERA, TIME, FORCE = "observation.images.tactile", "observation.time_s", "observation.force"
FORCE_AXES = ("tangential_n", "across_n", "normal_n")
NUMBERS = {
    name: f"observation.{name}"
    for name in ("friction_coefficient", "safety_margin", "safety_margin_sigma", "stick_ratio")
}
"""Features of one number, by the labels they hold."""
VALID, STATE, REASON = "observation.valid", "observation.contact_state", "observation.invalid_reason"
KEPT = Path("meta", "sliplens")
"""Folder of what LeRobot has no place for; its `trials.jsonl` has a line an episode."""
KEPT_REFERENCE, KEPT_FORCES = "reference-{:06d}.png", "forces-{:06d}.parquet"
_COLUMNS = [TIME, FORCE, *NUMBERS.values(), VALID, STATE, REASON]


def read_kept(layout: Layout) -> tuple[ExportedTrial, ...] | None:
    """Read what is kept of the trials, one an episode; None where nothing is."""
    path = layout.folder / KEPT / "trials.jsonl"
    try:
        lines = path.read_text(encoding="utf-8").rstrip("\n").split("\n")
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path} cannot be read ({error}); copy the data set again") from None
    trials = tuple(ExportedTrial.parse(line, where=f"line {number + 1} of {path}") for number, line in enumerate(lines))
    if len({trial.facts.trial for trial in trials}) < len(trials):
        raise RecordingError(f"{path} names a trial twice; copy the data set again")
    missing = [key for key in (CAMERA, *_COLUMNS) if key not in layout.features]
    if missing:
        raise RecordingError(
            f"meta/info.json of {layout.folder} lacks {', '.join(missing)}; copy the data set again, or remove {path} "
            "to read it without labels"
        )
    return trials


def kept_captures(layout: Layout, trials: tuple[ExportedTrial, ...]) -> list[Capture]:
    """Trials of a data set as they were exported."""
    episodes = read_episodes(layout, camera_key=CAMERA)
    exported = [(index, trial.frames) for index, trial in enumerate(trials)]
    if [(one.index, one.length) for one in episodes] != exported:
        path = layout.folder / KEPT / "trials.jsonl"
        raise RecordingError(
            f"the episodes of {layout.folder} are no longer those that {path} tells of; export the trials again, or "
            "remove that file to read the data set without labels"
        )
    rows = read_rows(layout, episodes, dict.fromkeys(_COLUMNS, "values"))
    return [_capture(one, trials[one.episode.index]) for one in rows]


def _capture(rows: Rows, trial: ExportedTrial) -> Capture:
    folder, index = rows.layout.folder, rows.episode.index
    size, read_frames = image_frames(rows.episode, CAMERA)
    source = f"{trial.facts.trial}, episode {index} of {folder}"
    path = folder / KEPT / KEPT_REFERENCE.format(index)
    try:
        png = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path} cannot be read ({error.strerror}); copy the data set again") from None
    sampled = folder / KEPT / KEPT_FORCES.format(index)
    forces = load_forces(sampled) if trial.force_samples else None
    if forces is not None and len(forces.time_s) != trial.force_samples:
        raise RecordingError(
            f"{sampled} has {len(forces.time_s)} samples of {trial.facts.trial}, {trial.force_samples} were exported; "
            "copy the data set again"
        )
    force = rows.vectors(FORCE)
    if force.shape[1] != len(FORCE_AXES):
        raise RecordingError(f"{FORCE} of {source} has {force.shape[1]} numbers, not 3; copy the data set again")
    numbers = {name: rows.numbers(key) for name, key in {"time_s": TIME, **NUMBERS}.items()}
    return trial.capture(
        {**numbers, "tangential_force_n": force[:, 0].copy(), "normal_force_n": force[:, 2].copy()},
        states=rows.words(STATE),
        valid=rows.values(VALID, pa.types.is_boolean, "true and false"),
        reasons=rows.words(REASON),
        source=source,
        frame_size=size,
        read_frames=read_frames,
        forces=forces,
        reference=decode_image(png, where=f"{path}"),
    )


_TACTILE = re.compile(r"tactile|touch|gel|digit|tactip|fingertip|skin", re.IGNORECASE)
_FORCE = re.compile(r"force|wrench|(?<![a-z])f_?t(?![a-z])", re.IGNORECASE)
_TORQUE = re.compile(r"torque|moment|(?<![a-z])[tm]_?[xyz](?![a-z])", re.IGNORECASE)


def read_lerobot(folder: Path, options: ReadOptions) -> list[Capture]:
    """Read a data set, one trial an episode; those that `write_lerobot` exported as they were, if no feature is named.

    Frames and forces are rows of one table and have its times. Frames of a video are those shown within half a frame of
    their row's time.
    """
    layout = read_layout(folder)
    if options.camera_key is None and options.force_key is None and (kept := read_kept(layout)) is not None:
        return kept_captures(layout, kept)
    camera, notes = _choose_camera(layout, options.camera_key)
    force = _choose_force(layout, options.force_key)
    if force is None:
        notes.append("There are no forces: no feature of 3 or 6 numbers is named like one.")
    video_header = cache(read_video_header)  # episodes share files
    captures = []
    episodes = read_episodes(layout, camera_key=camera)
    columns = {"timestamp": "numbers", **({force: "values"} if force else {})}
    for rows in read_rows(layout, episodes, columns):
        one, own_notes, forces = rows.episode, (), None
        time = rows.table.column("timestamp").to_numpy().astype(np.float64)
        source = f"episode {one.index} of {layout.folder}"
        if force is not None:
            forces = Forces(time_s=time, force_n=rows.vectors(force)[:, :3].copy(), source=f"{force} of {source}")
        if one.video_file is None:
            size, read_frames = image_frames(one, camera)
        else:
            size, own_notes = video_header(one.video_file)
            tolerance_s, shown_s = 0.5 / layout.fps, one.video_start_s + time
            read_frames = partial(video_frames, one.video_file, shown_s, tolerance_s=tolerance_s, frame_size=size)
        captures.append(
            Capture(
                trial=trial_name(f"{layout.folder.resolve().name}-{one.index:06d}"),
                source=f"{camera} of {source}",
                frame_time_s=time,
                frame_size=size,
                read_frames=read_frames,
                forces=forces,
                notes=(*notes, *own_notes),
            )
        )
    return captures


def _choose_camera(layout: Layout, named: str | None) -> tuple[str, list[str]]:
    cameras = [
        key
        for key, feature in layout.features.items()
        if feature.dtype in {"video", "image"} and not _is_depth(feature)
    ]
    if named is not None:
        if named not in cameras:
            raise RecordingError(f"{layout.folder} has no camera {named}; it has {_listed(cameras)}")
        return named, []
    tactile = [key for key in cameras if _TACTILE.search(key)]
    if len(tactile) == 1:
        return tactile[0], []
    if len(cameras) == 1:
        return cameras[0], [f"{cameras[0]} was taken for the tactile camera, for there is no other."]
    if not cameras:
        raise RecordingError(f"{layout.folder} has no camera; record one, as video or images")
    raise RecordingError(
        f"{layout.folder} has cameras {_listed(cameras)}, of which {_listed(tactile)} could be tactile; "
        "name one with --camera-key"
    )


def _choose_force(layout: Layout, named: str | None) -> str | None:
    fitting = [
        key
        for key, feature in layout.features.items()
        if feature.dtype.startswith("float") and feature.shape in ((3,), (6,))
    ]
    if named is not None:
        if named not in layout.features:
            raise RecordingError(f"{layout.folder} has no feature {named}; 3 or 6 numbers have {_listed(fitting)}")
        if named not in fitting:
            feature = layout.features[named]
            raise RecordingError(
                f"{named} of {layout.folder} is {feature.dtype} of shape {list(feature.shape)}; a force has 3 or 6 "
                "floating-point numbers"
            )
        found = [named]
    else:
        # what was commanded is not what was felt
        found = [key for key in fitting if _FORCE.search(key) and not key.startswith("action")]
        if len(found) > 1:
            raise RecordingError(f"{layout.folder} has forces {_listed(found)}; name one with --force-key")
    if not found:
        return None
    first = _names(layout.features[found[0]].names)[:3]
    if any(_TORQUE.search(name) for name in first):
        raise RecordingError(f"{found[0]} of {layout.folder} begins with {', '.join(first)}; forces must come first")
    return found[0]


def _names(names: object) -> list[str]:
    """Names of the numbers of a feature, in the two shapes there are: a list, or lists by group."""
    groups = names.values() if isinstance(names, dict) else [names]
    return [str(name) for group in groups if isinstance(group, list) for name in group]


def _is_depth(feature: Feature) -> bool:
    details = (feature.info, feature.video_info)
    return any(
        found.get("is_depth_map") or found.get("video.is_depth_map") for found in details if isinstance(found, dict)
    )


def _listed(keys: list[str]) -> str:
    return ", ".join(keys) or "none"
