"""One way to open frames: of a data set, a folder of images, a video, a bag, whatever a reader opens, or arrays."""

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float, UInt8

from sliplens.errors import ImageError, InputError, RecordingError
from sliplens.files import as_path, hash_file, hash_json, hash_tree
from sliplens.images import list_images, read_image, require_rgb
from sliplens.parts import Shard, shard
from sliplens.progress import number_of
from sliplens.recordings.capture import Capture, Frame
from sliplens.recordings.dataset import DATASET_FILE, Dataset, load_dataset
from sliplens.recordings.formats import open_captures, recognise
from sliplens.recordings.formats.images import frame_size, read_frame
from sliplens.recordings.formats.stored import read_stored_trial
from sliplens.recordings.formats.tables import evenly_spaced, trial_name
from sliplens.recordings.options import LIMITS, Budget, ReadOptions, spoken
from sliplens.recordings.repeats import inspect_repeats
from sliplens.recordings.sensor import SensorProfile, load_profile
from sliplens.shards import LONGEST

Frames: TypeAlias = UInt8[np.ndarray, "frames height width 3"]
"""RGB images of the camera, one after another."""
_INSPECTED = 8
"""Recordings whose first frames are looked at for repeats."""


def open_source(
    source: Path | str | Frames | Dataset,
    *,
    reference: Path | str | Frame | None = None,
    reference_frame: int | None = None,
    split: str | None = None,
    trial: str | None = None,
    format: str | None = None,
    options: ReadOptions | None = None,
    sensor: SensorProfile | Path | str | None = None,
    whole: bool = False,
) -> tuple[Capture, ...]:
    """Open frames wherever they are; no frame is read yet.

    Parameters
    ----------
    source
        Data set, folder of images, recording, or uint8 RGB frames (frames, height, width, 3).
    reference, reference_frame
        The sensor untouched, as an image or the number of the frame that shows it; what the source names if None.
    split, trial
        Trials of a data set, or the name of one; all if None.
    format
        Row of `FORMATS`; recognised if None.
    options
        What is known of a source that is no data set.
    sensor
        Profile of the sensor, its file (TOML), or the name of one that comes with sliplens: what frames and reference
        go through before they are read. Those of a data set went through it on import.
    whole
        With the samples of forces that a data set keeps; images must then have times.

    Raises
    ------
    InputError
        If something named is missing, damaged or does not fit the source; of an image an `ImageError`, of a recording a
        `RecordingError`.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.recordings.source import open_source
    >>> (trial,) = open_source(np.zeros((5, 8, 6, 3), dtype=np.uint8), reference_frame=0)
    >>> trial.frames, trial.frame_size
    (5, (8, 6))
    """
    if reference is not None and reference_frame is not None:
        raise InputError("the untouched sensor is named twice; give --reference or --reference-frame, not both")
    options = ReadOptions() if options is None else options
    profile = None if sensor is None else load_profile(sensor)
    source = as_path(source) if isinstance(source, Path | str) else source
    if isinstance(source, Path) and format in {None, "sliplens"} and (source / DATASET_FILE).is_file():
        source = load_dataset(source)
    if isinstance(source, Dataset):
        if reference is not None or reference_frame is not None:
            raise InputError(f"the trials of {source.folder} bring their reference frames; leave out --reference")
        if given := options.given():
            raise InputError(f"{source.folder} is a data set of sliplens, which does not take {spoken(given)}")
        if profile is not None:
            raise InputError(
                f"{source.folder} is a data set of sliplens, whose frames went through their profile on import; "
                "leave out --sensor"
            )
        infos = source.select(split=split)
        names = [info.trial for info in infos]
        opened = [
            read_stored_trial(source, info, samples=whole) for info in _chosen(infos, names, trial, source.folder)
        ]
        return tuple(replace(one, opened=str(source.folder)) for one in opened)
    if split is not None:
        raise InputError(f"{_words(source)} is no data set of sliplens and has no splits; leave out --split")
    if profile is not None and profile.frame_rate_hz is not None and options.frame_rate is None:
        options = replace(options, frame_rate=profile.frame_rate_hz)
    opened = [
        replace(_with_reference(one, reference, reference_frame), opened=_words(source))
        for one in _open(source, format, options, whole=whole)
    ]
    for one in opened if isinstance(source, Path) else ():
        _require_usual(one, options.allow_large)
    if profile is not None:
        opened = [profile.prepare(one) for one in opened]
    return tuple(_chosen(opened, [one.name for one in opened], trial, source))


@dataclass(frozen=True, kw_only=True)
class Trials:
    """Trials of a source that every process can open again, by paths and names."""

    source: Path | Dataset | tuple[Capture, ...]
    """What is opened; captures stay in this process."""
    named: Mapping[str, Any]
    """Parameters of `open_source`."""
    kinds: tuple[Capture, ...]
    """A capture of each sensor and size of frames, to see whether it can be read: to open all takes as long as there
    are trials."""
    rows: tuple[tuple[str, int, str], ...]
    """Name, number of frames, and hash of what it shows, of each trial; empty where nobody asks."""

    @property
    def frames(self) -> int:
        """Number of frames of all trials."""
        return sum(frames for _, frames, _ in self.rows)

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "kinds": ()}  # whoever gets it opens its own

    @property
    def travels(self) -> bool:
        """Whether other processes can open it."""
        return isinstance(self.source, Path | Dataset)

    def shards(self, recipe: object, *, longest: int | None = LONGEST) -> Iterator[Shard]:
        """Shards of (trial, first frame, number of frames), whose parts are Parquet files; whole trials with None."""
        recipe = hash_json(recipe)
        for trial, total, shown in self.rows:
            for first in range(0, total, longest or total):
                frames, known = min(longest or total, total - first), {"recipe": recipe, "shown": shown}
                yield shard((trial, first, frames), trial=trial, first=first, frames=frames, suffix=".parquet", **known)

    @property
    def recipe(self) -> object:
        """What was named of the source, as JSON holds it: an image by its hash."""
        image = self.named.get("reference")
        if image is not None:
            pixels = isinstance(image, np.ndarray)
            image = hashlib.sha256(image.tobytes()).hexdigest() if pixels else hash_file(Path(image))
        return {**self.named, "reference": image}

    def reader(self) -> Callable[[str, int, int], tuple[Capture, Iterator[tuple[int, Frame]]]]:
        """Open shards, in whatever process: gives the trial, and the frames with their numbers.

        Shards of a long trial that come one after another go on where the one before ended.
        """
        given = self.source
        opened = open_source(given, **self.named) if isinstance(given, Path) else given
        known = {} if isinstance(opened, Dataset) else {one.name: one for one in opened}
        following: tuple[tuple[str, int], Iterator[tuple[int, Frame]]] | None = None

        def read(trial: str, first: int, count: int) -> tuple[Capture, Iterator[tuple[int, Frame]]]:
            nonlocal following
            (capture,) = open_source(given, trial=trial, **self.named) if isinstance(given, Dataset) else [known[trial]]
            if following is not None and following[0] == (trial, first):
                frames = following[1]
            else:
                frames = islice(enumerate(capture.read_frames()), first, None)
            following = None  # until this shard was read to its end: one that failed leaves the frames anywhere

            def own() -> Iterator[tuple[int, Frame]]:
                nonlocal following
                number = first - 1
                for number, frame in islice(frames, count):
                    require_rgb(frame, what=f"levels of frame {number} of {capture.source}")
                    yield number, frame
                if number + 1 < first + count:
                    ends = f"ends after {number + 1} of its {first + count} frames"
                    raise RecordingError(f"{capture.source} {ends}; make or copy it again")
                following = (trial, first + count), frames

            return capture, own()

        return read


def open_trials(
    source: Path | str | Frames | Dataset | Sequence[Capture],
    *,
    on: str = "serial",
    resumable: bool = True,
    **named: Any,
) -> Trials:
    """Open a source for work that may be done elsewhere; the other parameters are those of `open_source`.

    Where parts are kept for another run (`resumable`), files other than a data set are read whole for their hash.

    Raises
    ------
    InputError
        As `open_source`, and if frames in memory are to be worked on elsewhere than in this process.
    """
    if isinstance(source, Path | str):
        source = as_path(source)
        if named.get("format") in {None, "sliplens"} and (source / DATASET_FILE).is_file():
            source = load_dataset(source)
    if isinstance(source, Dataset):
        infos = [info for info in source.select(split=named.get("split")) if named.get("trial") in {None, info.trial}]
        first = {(info.sensor, info.height, info.width): info.trial for info in reversed(infos)}
        told = {"trial": named.pop("trial", None)}
        kinds = [open_source(source, **named, trial=trial)[0] for trial in reversed(first.values() or told.values())]
        rows = [(info.trial, info.frames, info.sha256) for info in infos]
        return Trials(source=source, named=named, kinds=tuple(kinds), rows=tuple(rows))
    if on != "serial" and not isinstance(source, Path):
        raise InputError("frames in memory are worked on in this process; name their file or folder, or leave out --on")
    opened = tuple(open_source(source, **named) if isinstance(source, Path | np.ndarray) else source)
    if len({one.name for one in opened}) < len(opened):
        raise InputError("two of the trials have one name; give each its own")
    shown = hash_tree(source) if resumable and isinstance(source, Path) else ""
    rows = [(one.name, one.frames, shown) for one in opened]
    # of many recordings a few: to open all takes long enough
    kinds = tuple(
        replace(one, notes=(*one.notes, *inspect_repeats(one))) if at < _INSPECTED else one
        for at, one in enumerate(opened)
    )
    return Trials(source=source if isinstance(source, Path) else opened, named=named, kinds=kinds, rows=tuple(rows))


def _open(source: Path | Frames, format: str | None, options: ReadOptions, *, whole: bool) -> Sequence[Capture]:
    if not isinstance(source, Path):
        return [_array(source, options)]
    if not whole and set(options.given()) <= {"frame_rate"} and (format or recognise(source)) == "images":
        return [_images(source, options.frame_rate)]
    return open_captures(source, format=format, options=options)


def _require_usual(capture: Capture, allowed: Sequence[Budget]) -> None:
    """Refuse a recording that is larger than any usual one, before anything of its size is made."""
    height, width = capture.frame_size
    clocks = [time for time in (capture.time_s, capture.forces and capture.forces.time_s) if time is not None]
    sizes: dict[Budget, tuple[float, str]] = {
        "frames": (len(capture), number_of(len(capture), "frame")),
        "pixels": (height * width, f"frames of {height} x {width} pixels"),
        "samples": (samples := len(capture.forces.time_s) if capture.forces else 0, f"{samples:,} samples of forces"),
        "span": max(((float(time[-1] - time[0]), _span(time)) for time in clocks), default=(0.0, "")),
    }
    for name, (size, told) in sizes.items():
        if size > LIMITS[name] and name not in allowed:
            raise RecordingError(
                f"{capture.source} has {told}, more than the {LIMITS[name]:,} that are usual; cut or mend it, or say "
                f"--allow-large {name} if it is right"
            )


def _span(time_s: np.ndarray) -> str:
    """Length of a series of times, and its longest gap, in words."""
    at = int(np.argmax(np.diff(time_s))) if len(time_s) > 1 else 0
    gap = f", {time_s[at + 1] - time_s[at]:.6g} s of them after stamp {at}" if len(time_s) > 1 else ""
    return f"times over {time_s[-1] - time_s[0]:.6g} s{gap}"


def _chosen(trials: Sequence[Any], names: list[str], trial: str | None, source: Path | Frames) -> Sequence[Any]:
    if trial is None:
        return trials
    if trial not in names:
        raise InputError(f"{_words(source)} has no trial {trial}; choose one such as {names[0]}")
    return [trials[names.index(trial)]]


def _words(source: Path | Frames) -> str:
    return str(source) if isinstance(source, Path) else Capture.opened


def _array(frames: Frames, options: ReadOptions) -> Capture:
    if not len(frames):
        raise InputError("there is no frame; give one or more")
    require_rgb(frames)
    if strange := [option for option in options.given() if option != "frame_rate"]:
        raise InputError(f"{Capture.opened} do not take {spoken(strange)}; leave it out")
    return Capture(
        trial="frames",
        source=Capture.opened,
        frame_time_s=_frame_times(len(frames), options.frame_rate),
        frame_size=frames.shape[1:3],
        read_frames=lambda: iter(frames),
    )


def _images(folder: Path, frame_rate: float | None) -> Capture:
    """Images as one trial; unlike on import, their times may stay unknown."""
    paths = list_images(folder)
    size, count = frame_size(paths[0]), len(paths)
    return Capture(
        trial=trial_name(folder.resolve().name),
        source=str(folder),
        frame_time_s=_frame_times(count, frame_rate),
        frame_size=size,
        read_frames=lambda: (read_frame(path, size=size) for path in paths),
        files=tuple(path.name for path in paths),
    )


def _frame_times(count: int, frame_rate: float | None) -> Float[np.ndarray, " frames"]:
    """Times of frames, NaN where their rate is not told."""
    return np.full(count, np.nan) if frame_rate is None else evenly_spaced(count, frame_rate=frame_rate)


def _with_reference(trial: Capture, image: Path | str | Frame | None, number: int | None) -> Capture:
    """Name the untouched sensor; what the trial names itself stays where nothing is named."""
    if image is None and number is None and trial.reference is None:
        number = trial.reference_index
    if number is not None:
        if not 0 <= number < trial.frames:
            raise InputError(
                f"{trial.name} has no frame {number}; name one from 0 to {trial.frames - 1} with --reference-frame"
            )
        return replace(trial, reference=None, reference_index=number)
    if image is None:
        return trial
    pixels = read_image(Path(image)) if isinstance(image, str | Path) else image
    if pixels.shape[:2] != trial.frame_size:
        height, width = trial.frame_size
        raise ImageError(
            f"the reference is {pixels.shape[0]} x {pixels.shape[1]} pixels but the frames of {trial.name} are "
            f"{height} x {width}; record both with the same camera settings"
        )
    return replace(trial, reference=pixels)
