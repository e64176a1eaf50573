"""Trials to follow markers in: of a data set, a folder of images, a video, or whatever a reader opens."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from sliplens.errors import InputError
from sliplens.images import list_images, read_image
from sliplens.images.files import IMAGE_SUFFIXES
from sliplens.recordings import Dataset
from sliplens.recordings.capture import Capture
from sliplens.recordings.dataset import DATASET_FILE, trial_path
from sliplens.recordings.formats import open_captures
from sliplens.recordings.formats.images import read_frame
from sliplens.recordings.options import ReadOptions
from sliplens.recordings.store import load_recording, stream_frames

Frame = UInt8[np.ndarray, "height width 3"]


@dataclass(frozen=True, kw_only=True)
class MarkedTrial:
    """One trial whose frames show markers, not read yet."""

    name: str
    frames: int
    read_frames: Callable[[], Iterator[Frame]]
    """Begins anew at every call."""
    read_reference: Callable[[], Frame]
    """The sensor untouched, T_0."""
    time_s: Float[np.ndarray, " frames"] | None = None
    notes: tuple[str, ...] = ()
    """What was assumed, a sentence each, for people."""


def open_marked(
    path: Path,
    *,
    split: str | None = None,
    reference: Path | None = None,
    reference_frame: int | None = None,
    format: str | None = None,
    options: ReadOptions | None = None,
) -> list[MarkedTrial]:
    """Open what markers are to be followed in.

    Parameters
    ----------
    path
        Data set, folder of images, or recording.
    split
        Trials of a data set; all if None.
    reference, reference_frame
        Image of the sensor untouched, or number of the frame that shows it. Where neither is given and the source names
        none, displacements count from the first frame, and the trial's notes say so.
    format
        Row of `FORMATS`; recognised if None.
    options
        For the reader.

    Raises
    ------
    InputError
        If the source is missing, or does not take an option that was given, or has one frame alone and no reference.
    RecordingError
        If it cannot be read.
    """
    if reference is not None and reference_frame is not None:
        raise InputError("the untouched sensor is named twice; give --reference or --reference-frame, not both")
    options = ReadOptions() if options is None else options
    if format in {None, "sliplens"} and (path / DATASET_FILE).is_file():
        if reference is not None or reference_frame is not None or options.given():
            raise InputError(
                f"the trials of {path} bring their reference frames and times; leave out what names others"
            )
        data = Dataset.open(path)
        return [_stored(trial_path(data.folder, info.trial), info.trial) for info in data.select(split=split)]
    if split is not None:
        raise InputError(f"{path} is no data set of sliplens and has no splits; leave out --split")
    if _is_bare_folder(path, format, options):
        trials = [_images(path)]
    else:
        trials = [_capture(capture) for capture in open_captures(path, format=format, options=options)]
    return [_with_reference(trial, reference, reference_frame) for trial in trials]


def _stored(path: Path, name: str) -> MarkedTrial:
    recording = load_recording(path, truth=False, pixels=False)
    return MarkedTrial(
        name=name,
        frames=len(recording),
        read_frames=partial(stream_frames, path),
        read_reference=lambda: recording.reference,
        time_s=recording.time_s,
    )


def _is_bare_folder(path: Path, format: str | None, options: ReadOptions) -> bool:
    """Whether a path is a folder of images that nothing is said of: their times may stay unknown."""
    if not path.is_dir() or format not in {None, "images"} or options.given():
        return False
    if (path / "labels.csv").is_file() or (path / "meta" / "info.json").is_file() or (path / "metadata.yaml").is_file():
        return False
    return any(file.suffix.lower() in IMAGE_SUFFIXES for file in path.iterdir())


def _images(folder: Path) -> MarkedTrial:
    paths = list_images(folder)
    size = read_image(paths[0]).shape[:2]

    def read() -> Iterator[Frame]:
        return (read_frame(path, size=(size[0], size[1])) for path in paths)

    return _first_frame_unless_named(
        MarkedTrial(
            name=folder.resolve().name, frames=len(paths), read_frames=read, read_reference=lambda: next(read())
        )
    )


def _capture(capture: Capture) -> MarkedTrial:
    trial = MarkedTrial(
        name=capture.trial,
        frames=len(capture.frame_time_s),
        read_frames=capture.read_frames,
        read_reference=lambda: next(capture.read_frames()),
        time_s=capture.frame_time_s,
        notes=capture.notes,
    )
    if capture.reference is not None:
        image = capture.reference
        return replace(trial, read_reference=lambda: image)
    if capture.reference_index is not None:
        return _of_frame(trial, capture.reference_index)
    return _first_frame_unless_named(trial)


_FIRST = "no untouched frame was named, so displacements count from the first frame."


def _first_frame_unless_named(trial: MarkedTrial) -> MarkedTrial:
    return replace(trial, notes=(*trial.notes, f"{trial.name}: {_FIRST}"))


def _of_frame(trial: MarkedTrial, number: int) -> MarkedTrial:
    if not 0 <= number < trial.frames:
        raise InputError(
            f"{trial.name} has no frame {number}; name one from 0 to {trial.frames - 1} with --reference-frame"
        )
    return replace(trial, read_reference=lambda: next(islice(trial.read_frames(), number, None)))


def _with_reference(trial: MarkedTrial, image: Path | None, number: int | None) -> MarkedTrial:
    """Take the reference that the user named, and forget that there was none."""
    if image is None and number is None:
        if trial.frames == 1 and any(note.endswith(_FIRST) for note in trial.notes):
            raise InputError(
                f"{trial.name} has one frame only, which cannot have moved against itself; name the untouched sensor "
                "with --reference IMAGE"
            )
        return trial
    trial = replace(trial, notes=tuple(note for note in trial.notes if not note.endswith(_FIRST)))
    if number is not None:
        return _of_frame(trial, number)
    assert image is not None  # one of the two was named
    pixels = read_image(image)
    return replace(trial, read_reference=lambda: pixels)
