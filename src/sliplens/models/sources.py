"""Frames to predict: trials of a data set, a folder of images, or whatever a reader opens; one trial at a time."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from sliplens.errors import InputError
from sliplens.images import list_images, read_image
from sliplens.models import TrainedModel
from sliplens.recordings import Dataset, TrialInfo
from sliplens.recordings.capture import Capture
from sliplens.recordings.dataset import DATASET_FILE, trial_path
from sliplens.recordings.formats import ReadOptions, all_readers, open_captures
from sliplens.recordings.formats.images import read_frame
from sliplens.recordings.formats.tables import evenly_spaced, trial_name
from sliplens.recordings.store import load_recording, stream_frames

Frame = UInt8[np.ndarray, "height width 3"]


@dataclass(frozen=True, kw_only=True)
class FrameTrial:
    """One trial, its frames not read yet."""

    name: str
    read_frames: Callable[[], Iterator[Frame]]
    reference: Frame | None
    """The sensor untouched; None where frames are compared already, or need not be."""
    time_s: Float[np.ndarray, " frames"] | None = None
    safety_margin: Float[np.ndarray, " frames"] | None = None
    """Labels, NaN where a frame has none; None where the source has none at all."""
    files: tuple[str, ...] | None = None
    """Names of the images of a folder."""


@dataclass(frozen=True, kw_only=True)
class FrameSource:
    """All trials of a source."""

    frames: int
    labelled: bool
    """Whether any trial brings labels."""
    files: bool
    """Whether frames are image files."""
    open_trials: Callable[[], Iterator[FrameTrial]]
    notes: tuple[str, ...] = ()
    """What was assumed, a sentence each, for people."""


@dataclass(frozen=True, kw_only=True)
class SourceOptions:
    """What a user says of a source; None where nothing is said."""

    split: str | None = None
    """Trials of a data set; all if None."""
    reference: Path | None = None
    """Image of the sensor untouched."""
    reference_frame: int | None = None
    """Number of the frame that shows the sensor untouched."""
    format: str | None = None
    """Row of `all_readers`."""
    read: ReadOptions = field(default_factory=ReadOptions)
    """For the reader."""


def open_source(path: Path, trained: TrainedModel, options: SourceOptions) -> FrameSource:
    """Open what is to be predicted.

    Parameters
    ----------
    path
        Data set, folder of images, or recording. Images without a reference are taken for difference images that were
        compared before, as someone published them; for a network on raw frames they are its frames.
    trained
        The network: decides the size of the frames, and whether they need a reference.
    options
        What is known of the source.

    Raises
    ------
    InputError
        If the source is missing, has no reference where it needs one, or does not take an option that was given.
    ImageError
        If its frames are not of the size the network's sensor has.
    RecordingError
        If it cannot be read.
    """
    if options.reference is not None and options.reference_frame is not None:
        raise InputError("the untouched sensor is named twice; give --reference or --reference-frame, not both")
    if options.format in {None, "sliplens"} and (path / DATASET_FILE).is_file():
        return _stored(path, trained, options)
    if options.split is not None:
        raise InputError(f"{path} is no data set of sliplens and has no splits; leave out --split")
    if _is_image_folder(path, options.format):
        return _images(path, trained, options)
    return _captures(path, trained, options)


def _stored(path: Path, trained: TrainedModel, options: SourceOptions) -> FrameSource:
    if options.reference is not None or options.reference_frame is not None:
        raise InputError(f"the trials of {path} bring their reference frames; leave out --reference")
    if options.read.given():
        raise InputError(f"{path} is a data set of sliplens, which does not take {', '.join(options.read.given())}")
    data = Dataset.open(path)
    trials = data.select(split=options.split)
    for info in trials:
        trained.require_frame_size((info.height, info.width))
    return FrameSource(
        frames=sum(info.frames for info in trials),
        labelled=True,
        files=False,
        open_trials=lambda: (_stored_trial(data, info) for info in trials),
    )


def _stored_trial(data: Dataset, info: TrialInfo) -> FrameTrial:
    path = trial_path(data.folder, info.trial)
    recording = load_recording(path, truth=False, pixels=False)
    return FrameTrial(
        name=info.trial,
        read_frames=partial(stream_frames, path),
        reference=recording.reference,
        time_s=recording.time_s,
        # a label that cannot be trusted is none to compare with
        safety_margin=np.where(recording.labelled, recording.safety_margin, np.nan),
    )


def _is_image_folder(path: Path, format: str | None) -> bool:
    if format is not None:
        return format == "images"
    return next((name for name, reader in all_readers().items() if reader.recognises(path)), None) == "images"


def _images(folder: Path, trained: TrainedModel, options: SourceOptions) -> FrameSource:
    strange = set(options.read.given()) - {"frame_rate"}
    if strange:
        raise InputError(f"{folder} is a folder of images, which does not take {', '.join(sorted(strange))}")
    paths, size = list_images(folder), _size(trained)
    read_frames = partial(_read_files, paths, size)
    _require_frame(options, frames=len(paths), source=folder)
    reference, notes = _image(trained, options), ()
    if reference is None:
        reference = _frame(read_frames, options.reference_frame)
    if reference is None and trained.encoding.name != "raw":
        if not trained.encoding.empty_is_black:
            raise InputError(_no_reference(trained, folder))
        notes = (f"{folder.name}: no reference was given, so its images were taken for difference images.",)
    rate = options.read.frame_rate
    trial = FrameTrial(
        name=trial_name(folder.resolve().name),
        read_frames=read_frames,
        reference=reference,
        time_s=None if rate is None else evenly_spaced(len(paths), frame_rate=rate),
        files=tuple(path.name for path in paths),
    )
    return FrameSource(frames=len(paths), labelled=False, files=True, open_trials=lambda: iter((trial,)), notes=notes)


def _read_files(paths: Sequence[Path], size: tuple[int, int]) -> Iterator[Frame]:
    return (read_frame(path, size=size) for path in paths)


def _captures(path: Path, trained: TrainedModel, options: SourceOptions) -> FrameSource:
    captures = open_captures(path, format=options.format, options=options.read)
    for capture in captures:
        trained.require_frame_size(capture.frame_size)
        _require_frame(options, frames=len(capture.frame_time_s), source=capture.source)
        if _untold(capture, options) and trained.encoding.name != "raw":
            raise InputError(_no_reference(trained, path))
    image = _image(trained, options)
    return FrameSource(
        frames=sum(len(capture.frame_time_s) for capture in captures),
        labelled=any(capture.labels is not None for capture in captures),
        files=False,
        open_trials=lambda: (_capture_trial(capture, image, options.reference_frame) for capture in captures),
        notes=tuple(note for capture in captures for note in capture.notes),
    )


def _untold(capture: Capture, options: SourceOptions) -> bool:
    told = (options.reference, options.reference_frame, capture.reference, capture.reference_index)
    return all(one is None for one in told)


def _capture_trial(capture: Capture, image: Frame | None, number: int | None) -> FrameTrial:
    reference = image
    if reference is None and number is None:
        reference, number = capture.reference, capture.reference_index
    if reference is None:
        reference = _frame(capture.read_frames, number)
    margin = None
    if capture.labels is not None:
        margin, valid = capture.labels.safety_margin, capture.labels.valid
        margin = margin if valid is None else np.where(valid, margin, np.nan)
    return FrameTrial(
        name=capture.name,
        read_frames=capture.read_frames,
        reference=reference,
        time_s=capture.frame_time_s,
        safety_margin=margin,
    )


def _require_frame(options: SourceOptions, *, frames: int, source: Path | str) -> None:
    number = options.reference_frame
    if number is not None and not 0 <= number < frames:
        raise InputError(f"{source} has no frame {number}; name one from 0 to {frames - 1} with --reference-frame")


def _image(trained: TrainedModel, options: SourceOptions) -> Frame | None:
    """The sensor untouched, as an image that the user named."""
    return None if options.reference is None else read_image(options.reference, size=_size(trained))


def _frame(read_frames: Callable[[], Iterator[Frame]], number: int | None) -> Frame | None:
    return None if number is None else next(islice(read_frames(), number, None))


def _size(trained: TrainedModel) -> tuple[int, int]:
    height, width = trained.manifest.frame_size
    return int(height), int(width)


def _no_reference(trained: TrainedModel, source: Path) -> str:
    return (
        f"a network on {trained.encoding.name} images compares the frames of {source} with the untouched sensor; "
        "name its image with --reference IMAGE, or a frame of it with --reference-frame N"
    )
