"""One way to open frames: of a data set, a folder of images, a video, a bag, whatever a reader opens, or arrays."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TypeAlias, TypeVar

import numpy as np
from jaxtyping import Float, UInt8

from sliplens.errors import ImageError, InputError
from sliplens.images import list_images, read_image
from sliplens.recordings.capture import Capture, Frame
from sliplens.recordings.dataset import DATASET_FILE, Dataset, TrialInfo, load_dataset, trial_path
from sliplens.recordings.formats import open_captures, recognise
from sliplens.recordings.formats.images import frame_size, read_frame
from sliplens.recordings.formats.tables import evenly_spaced, trial_name
from sliplens.recordings.options import ReadOptions, spoken
from sliplens.recordings.store import load_recording, stream_frames

Frames: TypeAlias = UInt8[np.ndarray, "frames height width 3"]
"""RGB images of the camera, one after another."""
_Trial = TypeVar("_Trial")


@dataclass(frozen=True, kw_only=True)
class TrialFrames:
    """Frames of one trial, read one at a time, and what they are compared with."""

    name: str
    frames: int
    frame_size: tuple[int, int]
    """Height and width, in pixels."""
    read_frames: Callable[[], Iterator[Frame]]
    """Begins anew at every call."""
    read_reference: Callable[[], Frame] | None = None
    """The sensor untouched, T_0; None where neither the source nor the user names it."""
    time_s: Float[np.ndarray, " frames"] | None = None
    safety_margin: Float[np.ndarray, " frames"] | None = None
    """Labels, NaN where a frame has none that can be trusted; None where the source has none at all."""
    files: tuple[str, ...] | None = None
    """Names of the images of a folder."""
    notes: tuple[str, ...] = ()
    """What was assumed, a sentence each, for people."""
    source: str = "frames in memory"
    """Path that was opened, for people and metadata."""

    @property
    def frame_rate_hz(self) -> float:
        """Frames a second at which it can be watched, 1 to 120; 25 where times are not known."""
        if self.time_s is None or len(self.time_s) < 2:
            return 25.0
        return float(np.clip(1 / np.median(np.diff(self.time_s)), 1, 120))


def open_source(
    source: Path | str | Frames | Dataset,
    *,
    reference: Path | str | Frame | None = None,
    reference_frame: int | None = None,
    split: str | None = None,
    trial: str | None = None,
    format: str | None = None,
    options: ReadOptions | None = None,
) -> tuple[TrialFrames, ...]:
    """Open frames wherever they are; no frame is read yet.

    Parameters
    ----------
    source
        Data set, folder of images, recording, or uint8 RGB frames (frames, height, width, 3).
    reference, reference_frame
        The sensor untouched, as an image or the number of the frame that shows it; what the source names if None.
    split
        Trials of a data set; all if None.
    trial
        Name of one trial; all if None.
    format
        Row of `FORMATS`; recognised if None.

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
    source = Path(source) if isinstance(source, str) else source
    if isinstance(source, Path) and format in {None, "sliplens"} and (source / DATASET_FILE).is_file():
        source = load_dataset(source)
    if isinstance(source, Dataset):
        _require_nothing_given(source, reference, reference_frame, options)
        infos = source.select(split=split)
        chosen = _chosen(infos, [info.trial for info in infos], trial, source.folder)
        return tuple(_stored(source.folder, info) for info in chosen)
    if split is not None:
        raise InputError(f"{_words(source)} is no data set of sliplens and has no splits; leave out --split")
    opened = [
        replace(_with_reference(one, reference, reference_frame), source=_words(source))
        for one in _open(source, format, options)
    ]
    return tuple(_chosen(opened, [one.name for one in opened], trial, source))


def _open(source: Path | Frames, format: str | None, options: ReadOptions) -> list[TrialFrames]:
    if not isinstance(source, Path):
        return [_array(source)]
    if set(options.given()) <= {"frame_rate"} and (format or recognise(source)) == "images":
        return [_images(source, options.frame_rate)]
    return [_recorded(capture) for capture in open_captures(source, format=format, options=options)]


def _require_nothing_given(
    data: Dataset, reference: Path | str | Frame | None, reference_frame: int | None, options: ReadOptions
) -> None:
    if reference is not None or reference_frame is not None:
        raise InputError(f"the trials of {data.folder} bring their reference frames; leave out --reference")
    if options.given():
        raise InputError(f"{data.folder} is a data set of sliplens, which does not take {spoken(options.given())}")


def _chosen(trials: Sequence[_Trial], names: list[str], trial: str | None, source: Path | Frames) -> Sequence[_Trial]:
    if trial is None:
        return trials
    if trial not in names:
        raise InputError(f"{_words(source)} has no trial {trial}; choose one such as {names[0]}")
    return [trials[names.index(trial)]]


def _words(source: Path | Frames) -> str:
    return str(source) if isinstance(source, Path) else TrialFrames.source


def _stored(folder: Path, info: TrialInfo) -> TrialFrames:
    path = trial_path(folder, info.trial)
    recording = load_recording(path, truth=False, pixels=False)
    return TrialFrames(
        name=info.trial,
        frames=info.frames,
        frame_size=(info.height, info.width),
        source=str(folder),
        read_frames=partial(stream_frames, path),
        read_reference=lambda: recording.reference,
        time_s=recording.time_s,
        safety_margin=np.where(recording.labelled, recording.safety_margin, np.nan),
    )


def _array(frames: Frames) -> TrialFrames:
    if not len(frames):
        raise InputError("there is no frame; give one or more")
    return TrialFrames(
        name="frames", frames=len(frames), frame_size=frames.shape[1:3], read_frames=lambda: iter(frames)
    )


def _images(folder: Path, frame_rate: float | None) -> TrialFrames:
    """Images as one trial; unlike on import, their times may stay unknown."""
    paths = list_images(folder)
    size = frame_size(paths[0])
    return TrialFrames(
        name=trial_name(folder.resolve().name),
        frames=len(paths),
        frame_size=size,
        read_frames=lambda: (read_frame(path, size=size) for path in paths),
        time_s=None if frame_rate is None else evenly_spaced(len(paths), frame_rate=frame_rate),
        files=tuple(path.name for path in paths),
    )


def _recorded(capture: Capture) -> TrialFrames:
    margin = None
    if capture.labels is not None:
        margin, valid = capture.labels.safety_margin, capture.labels.valid
        margin = margin if valid is None else np.where(valid, margin, np.nan)
    opened = TrialFrames(
        name=capture.trial,
        frames=len(capture.frame_time_s),
        frame_size=capture.frame_size,
        read_frames=capture.read_frames,
        time_s=capture.frame_time_s,
        safety_margin=margin,
        notes=capture.notes,
    )
    return _with_reference(opened, capture.reference, capture.reference_index if capture.reference is None else None)


def _with_reference(trial: TrialFrames, image: Path | str | Frame | None, number: int | None) -> TrialFrames:
    """Name the untouched sensor; what the trial names itself stays where nothing is named."""
    if number is not None:
        if not 0 <= number < trial.frames:
            raise InputError(
                f"{trial.name} has no frame {number}; name one from 0 to {trial.frames - 1} with --reference-frame"
            )
        return replace(trial, read_reference=lambda: next(islice(trial.read_frames(), number, None)))
    if image is None:
        return trial
    pixels = read_image(Path(image)) if isinstance(image, str | Path) else image
    if pixels.shape[:2] != trial.frame_size:
        height, width = trial.frame_size
        raise ImageError(
            f"the reference is {pixels.shape[0]} x {pixels.shape[1]} pixels but the frames of {trial.name} are "
            f"{height} x {width}; record both with the same camera settings"
        )
    return replace(trial, read_reference=lambda: pixels)
