"""Frames of a video file, with the presentation stamps of its container."""

from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from sliplens.errors import RecordingError
from sliplens.recordings.capture import Capture
from sliplens.recordings.readers.clocks import evenly_spaced, place_on_clock, trial_name
from sliplens.recordings.readers.csv_table import read_force_table
from sliplens.recordings.readers.stale import stale_frames
from sliplens.recordings.readers.video_file import VideoFile, decode_video, inspect_video


def read_video(
    path: Path,
    *,
    forces: Path | None = None,
    frame_rate: float | None = None,
    start_s: float | None = None,
    skip_frames: int = 0,
    skip_stale: bool = False,
    name: str | None = None,
    time_column: str | None = None,
    force_columns: Sequence[str] | None = None,
    time_unit: str | None = None,
    force_unit: str | None = None,
) -> Capture:
    """Open a video, and a table of forces recorded beside it.

    Times are the presentation stamps of the container, so that a variable frame rate is kept.

    Parameters
    ----------
    path
        Whatever FFmpeg reads: MP4, AVI, Matroska, ...
    forces
        Table of forces; `read_force_table` tells of it and of `time_column`, `force_columns`, `time_unit` and
        `force_unit`.
    frame_rate
        True frames per second, where the stamps are missing or wrong; takes their place.
    start_s
        When the first frame of the file was taken, on the clock of the forces; None where both count from one zero.
    skip_frames
        Leave out so many frames at the start.
    skip_stale
        Leave out what `stale_frames` finds at the start; reads the beginning of the video.
    name
        Of the trial; that of the file if None.

    Raises
    ------
    RecordingError
        If the file is missing, no video, truncated or damaged, holds no frame or absurdly large ones, or has no stamps.
    """
    file = inspect_video(path)
    notes = list(file.notes)
    if frame_rate is not None:
        time = evenly_spaced(file.frames, frame_rate=frame_rate)
        notes.append(
            f"{path.name}: frames were declared to be taken {frame_rate:g} times a second, whatever its stamps say."
        )
    elif file.time_s is None:
        raise RecordingError(f"{path} has no presentation stamps; declare its frame_rate")
    else:
        time = file.time_s
    table = None
    if forces is not None:
        table = read_force_table(
            forces,
            time_column=time_column,
            force_columns=force_columns,
            time_unit=time_unit,
            force_unit=force_unit,
        )
        notes.extend(table.notes)
    measured = table.forces if table else None
    clock = place_on_clock(time, forces=measured, start_s=start_s, source=path.name)
    notes.extend(clock.notes)
    skipped = _skipped(path, file, skip_frames=skip_frames, skip_stale=skip_stale)
    if skipped:
        notes.append(f"{path.name}: the first {skipped} of {file.frames} frames were left out.")

    def read_frames() -> Iterator[UInt8[np.ndarray, "height width 3"]]:
        return islice(decode_video(file), skipped, None)

    return Capture(
        name=trial_name(path.stem if name is None else name),
        source=str(path),
        frame_time_s=clock.time_s[skipped:],
        frame_size=file.frame_size,
        read_frames=read_frames,
        forces=measured,
        notes=tuple(notes),
    )


def _skipped(path: Path, file: VideoFile, *, skip_frames: int, skip_stale: bool) -> int:
    if skip_frames < 0:
        raise RecordingError(f"{skip_frames} frames cannot be skipped; give 0 or more")
    skipped = max(skip_frames, stale_frames(decode_video(file))) if skip_stale else skip_frames
    if skipped >= file.frames:
        raise RecordingError(f"{path} has {file.frames} frames, {skipped} were to be skipped; skip fewer")
    return skipped
