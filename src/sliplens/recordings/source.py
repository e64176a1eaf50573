"""Sources of frames: data sets, folders of images, videos, bags and whatever else a reader opens, or arrays."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TypeAlias, TypedDict, TypeVar, Unpack

import numpy as np
from jaxtyping import UInt8

from sliplens.errors import ImageError, InputError, RecordingError
from sliplens.files import hash_json, hash_tree
from sliplens.images import Images, as_frames, is_image, read_image, require_rgb
from sliplens.recordings.capture import Capture, Frame, capture_recording
from sliplens.recordings.dataset import DATASET_FILE, Dataset, load_dataset
from sliplens.recordings.formats import open_captures
from sliplens.recordings.formats.arrays import SUFFIXES as ARRAY_SUFFIXES
from sliplens.recordings.formats.tables import evenly_spaced, trial_name
from sliplens.recordings.options import ReadOptions, option_flags
from sliplens.recordings.sensor import SensorProfile, load_profile
from sliplens.recordings.trial import Recording
from sliplens.runner import LONGEST, Part, part

Frames: TypeAlias = UInt8[np.ndarray, "frames height width 3"]  #: RGB images of the camera, one after another.
Other = TypeVar("Other")


class SourceOptions(TypedDict, total=False):
    """Parameters of `open_source` that a command passes on."""

    reference: Path | str | Images | None
    reference_frame: int | None
    split: str | None
    trial: str | None
    format: str | None
    options: ReadOptions | None
    sensor: SensorProfile | Path | str | None


def open_source(
    source: Path | str | Dataset | Images,
    *,
    reference: Path | str | Images | None = None,
    reference_frame: int | None = None,
    split: str | None = None,
    trial: str | None = None,
    format: str | None = None,
    options: ReadOptions | None = None,
    sensor: SensorProfile | Path | str | None = None,
    whole: bool = False,
) -> tuple[Capture, ...]:
    """Open frames of a source; no frame is read yet.

    Parameters
    ----------
    source
        Data set or one of its trials, folder of images, recording, one image, or uint8 frames as
        `sliplens.images.as_frames` takes them.
    reference, reference_frame
        Untouched sensor: an image, or the number of the frame that shows it. If neither, that of the source.
    split, trial
        Trials of a data set, or the name of one; all if None.
    format
        Name of a format (docs/recordings.md); recognised if None.
    options
        Facts about a source that is no data set.
    sensor
        Profile of the sensor, its file (TOML), or the name of one that comes with sliplens; frames and reference are
        prepared by it. Those of a data set were prepared on import.
    whole
        If True, read the samples of forces that a data set stores; images must then have times.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.recordings.source import open_source
    >>> (trial,) = open_source(np.zeros((5, 8, 6, 3), dtype=np.uint8), reference_frame=0)
    >>> len(trial), trial.frame_size
    (5, (8, 6))
    """
    if reference is not None and reference_frame is not None:
        raise InputError("the untouched sensor is named twice; give --reference or --reference-frame, not both")
    options = ReadOptions() if options is None else options
    profile = None if sensor is None else load_profile(sensor)
    opened = _open_dataset(source, format)
    if isinstance(opened, Dataset):
        facts = {"reference": reference, "reference_frame": reference_frame, "sensor": sensor, **vars(options)}
        if flags := option_flags(name for name, fact in facts.items() if fact is not None):
            raise InputError(f"the trials of {opened.folder} bring their reference frames and facts; leave out {flags}")
        return tuple(opened.open(info, samples=whole) for info in opened.select(split=split, trial=trial))
    name = str(opened) if isinstance(opened, Path) else Capture.opened
    if split is not None:
        raise InputError(f"{name} is no data set of sliplens and has no splits; leave out --split")
    if profile is not None and options.frame_rate is None:
        options = replace(options, frame_rate=profile.frame_rate_hz)
    read = _read_captures(opened, format, options, whole=whole)
    captures = [replace(_with_reference(each, reference, reference_frame), opened=name) for each in read]
    captures = captures if profile is None else [profile.prepare(capture) for capture in captures]
    if trial is not None and all(capture.trial != trial for capture in captures):
        raise InputError(f"{name} has no trial {trial}; choose one such as {captures[0].trial}")
    return tuple(capture for capture in captures if trial in {None, capture.trial})


def _open_dataset(source: Path | str | Other, format: str | None) -> Path | Dataset | Other:
    """Open the data set that a path names; any other source stays as it is."""
    if not isinstance(source, str | Path):
        return source
    path = Path(source)
    return load_dataset(path) if format in {None, "sliplens"} and (path / DATASET_FILE).is_file() else path


@dataclass(frozen=True, kw_only=True)
class Trials:
    """Trials of a source that every process can open again, by their paths and names."""

    source: Path | Dataset | tuple[Capture, ...]  #: Source to open; captures stay in this process.
    options: SourceOptions
    kinds: tuple[Capture, ...]  #: A capture of each sensor and size of frames, by which to check a source quickly.
    rows: tuple[tuple[str, int, str], ...]
    """Name, number of frames, and hash of each trial; the hash is empty where parts are not stored."""

    @property
    def frames(self) -> int:
        """Number of frames of all trials."""
        return sum(frames for _, frames, _ in self.rows)

    def __getstate__(self) -> dict:
        return {**vars(self), "kinds": ()}  # every process opens its own

    @property
    def travels(self) -> bool:
        """True where other processes can open the source."""
        return isinstance(self.source, Path | Dataset)

    def parts(self, recipe: object, *, longest: int | None = LONGEST) -> list[Part]:
        """Return parts of (trial, first frame, number of frames), Parquet files; whole trials if `longest` is None."""
        recipe = hash_json(recipe)
        return [
            part(
                (trial, at, size), trial=trial, first=at, frames=size, suffix=".parquet", recipe=recipe, content=content
            )
            for trial, total, content in self.rows
            for at in range(0, total, longest or total)
            for size in (min(longest or total, total - at),)
        ]

    @property
    def recipe(self) -> object:
        """Options of the source as JSON holds them; an image by its hash."""
        image = self.options.get("reference")
        if image is not None:
            image = hashlib.sha256(read_reference(image).tobytes()).hexdigest()
        return {**self.options, "reference": image}

    def reader(self) -> Callable[[str, int, int], tuple[Capture, Iterator[tuple[int, Frame]]]]:
        """Return a function that opens a part: its trial, and its frames with their numbers."""
        source, options = self.source, self.options
        opened = open_source(source, **options) if isinstance(source, Path) else source
        by_name = {} if isinstance(opened, Dataset) else {capture.trial: capture for capture in opened}
        # the next part of a trial goes on where this one ended: frames before it are not decoded again
        following: dict[tuple[str, int], Iterator[tuple[int, Frame]]] = {}

        def read_part(capture: Capture, first: int, count: int) -> Iterator[tuple[int, Frame]]:
            frames = following.pop((capture.trial, first), None)
            following.clear()
            if frames is None:
                frames = islice(enumerate(capture.read_frames()), first, None)
            number = first - 1
            for number, frame in islice(frames, count):
                require_rgb(frame, what=f"levels of frame {number} of {capture.source}")
                yield number, frame
            if number + 1 < first + count:
                raise RecordingError(f"{capture.source} ends after {number + 1} frames; make or copy it again")
            following[capture.trial, first + count] = frames

        def read(trial: str, first: int, count: int) -> tuple[Capture, Iterator[tuple[int, Frame]]]:
            if isinstance(source, Dataset):
                (capture,) = open_source(source, **{**options, "trial": trial})
            else:
                capture = by_name[trial]
            return capture, read_part(capture, first, count)

        return read


def open_trials(
    source: Path | str | Dataset | Sequence[Capture] | Images,
    *,
    on: str = "serial",
    resumable: bool = True,
    **options: Unpack[SourceOptions],
) -> Trials:
    """Open a source for work that other processes may do; the options are those of `open_source`."""
    source = _open_dataset(source, options.get("format"))
    if isinstance(source, Dataset):
        trial = options.pop("trial", None)
        infos = source.select(split=options.get("split"), trial=trial)
        first = {(info.sensor, info.height, info.width): info.trial for info in reversed(infos)}
        kinds = tuple(open_source(source, **{**options, "trial": name})[0] for name in reversed(first.values()))
        rows = tuple((info.trial, info.frames, info.sha256) for info in infos)
        return Trials(source=source, options=options, kinds=kinds, rows=rows)
    if on != "serial" and not isinstance(source, Path):
        raise InputError("frames in memory are worked on in this process; name their file or folder, or leave out --on")
    if isinstance(source, list | tuple) and source and all(isinstance(each, Capture) for each in source):
        captures = tuple(source)
    else:
        captures = open_source(source, **options)
    if len({capture.trial for capture in captures}) < len(captures):
        raise InputError("two of the trials have the same name; give each its own")
    sha256 = hash_tree(source) if resumable and isinstance(source, Path) else ""
    return Trials(
        source=source if isinstance(source, Path) else captures,
        options=options,
        kinds=captures,
        rows=tuple((capture.trial, len(capture), sha256) for capture in captures),
    )


def _read_captures(
    source: Path | Images, format: str | None, options: ReadOptions, *, whole: bool
) -> Sequence[Capture]:
    name, where, what, files, rate = "frames", Capture.opened, "frames", None, options.frame_rate
    if isinstance(source, Path):
        if whole or format is not None or not is_image(source):
            captures = open_captures(source, format=format, options=options)
            # unlike on import, the times of images may stay unknown
            if whole and any(capture.time_s is None for capture in captures):
                raise RecordingError(f"the frames of {source} have no times; give --times or --frame-rate")
            return captures
        name, where, what, files = trial_name(source.stem), str(source), f"frames of {source}", (source.name,)
        source = read_image(source)
    if strange := [option for option in options.given() if option != "frame_rate"]:
        raise InputError(f"{where} do not take {option_flags(strange)}; leave it out")
    if isinstance(source, Recording):
        return [capture_recording(source)]
    frames = as_frames(source, what=what)
    if not len(frames):
        raise InputError("there is no frame; give one or more")
    time_s = np.full(len(frames), np.nan) if rate is None else evenly_spaced(len(frames), frame_rate=rate)
    read, size = frames.__iter__, frames.shape[1:3]
    return [Capture(trial=name, source=where, frame_time_s=time_s, frame_size=size, read_frames=read, files=files)]


def read_reference(image: Path | str | Images, *, what: str = "reference") -> Frame:
    """Return one image: that in memory, that of a file, or the frame of an array on disk (.npy, .npz)."""
    if isinstance(image, Path | str) and Path(image).suffix.lower() in ARRAY_SUFFIXES:
        (capture,) = open_captures(Path(image), options=ReadOptions())
        image = list(islice(capture.read_frames(), 2))
    frames = as_frames(image, what=f"levels of the {what}")
    if len(frames) != 1:
        raise ImageError(f"the {what} has {len(frames)} images or more; give one")
    return frames[0]


def _with_reference(trial: Capture, image: Path | str | Images | None, number: int | None) -> Capture:
    """Set the image of the untouched sensor; that of the trial stays if neither image nor number is given."""
    if image is None and number is None and trial.reference is None:
        number = trial.reference_index
    if number is not None:
        if not 0 <= number < len(trial):
            raise InputError(f"{trial.trial} has no frame {number}; name one from 0 to {len(trial) - 1}")
        return replace(trial, reference=None, reference_index=number)
    if image is None:
        return trial
    pixels = read_reference(image)
    if pixels.shape[:2] != trial.frame_size:
        sizes = [" x ".join(map(str, size)) for size in (pixels.shape[:2], trial.frame_size)]
        mixed = f"the reference is {sizes[0]} pixels but the frames of {trial.trial} are {sizes[1]}"
        raise ImageError(f"{mixed}; record both alike")
    return replace(trial, reference=pixels)
