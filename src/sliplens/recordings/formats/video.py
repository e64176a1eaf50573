"""Frames of a video file, with the presentation stamps of its container."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.container import InputContainer
from av.error import FFmpegError
from av.stream import Disposition
from av.video.reformatter import VideoReformatter
from av.video.stream import VideoStream
from jaxtyping import Float, Int64, UInt8

from sliplens.errors import RecordingError
from sliplens.recordings.capture import Capture
from sliplens.recordings.formats.stored import stale_frames
from sliplens.recordings.formats.tables import (
    TIME_UNITS,
    TextTable,
    evenly_spaced,
    guess_time_column,
    guess_time_unit,
    open_table,
    place_on_clock,
    read_force_table,
    require_rising,
    to_number,
    trial_name,
    unit_of,
)

_NAME_COLUMNS = ("file", "filename", "file_name", "image", "image_name", "frame", "path", "name")


@dataclass(frozen=True, kw_only=True)
class FrameTimes:
    """Images in the order they were taken."""

    paths: tuple[Path, ...]
    time_s: Float[np.ndarray, " frames"]
    notes: tuple[str, ...]


def read_frame_times(table: Path, images: Sequence[Path]) -> FrameTimes:
    """Find the time of every image in a table with a column of file names and one of times.

    Parameters
    ----------
    table
        Text table with a header; folders before a file's name, and its ending, may be left out or differ.
    images
        Files of one folder.

    Raises
    ------
    RecordingError
        If a column or an image is missing in the table, or two images have one time.
    """
    text = open_table(table)
    name_column, time_column = _name_column(text), guess_time_column(text)
    stamps, listed = _stamps(text, name_column, time_column)
    found = []
    for image in images:
        row = stamps.get(image.name, stamps.get(image.stem))
        if row is None:
            raise RecordingError(f"{table} has no time for {image.name}; add a row for every image of the folder")
        found.append((row[0], row[1], image))
    found.sort(key=lambda row: row[0])
    time = np.array([row[0] for row in found])
    require_rising(time, [row[1] for row in found], path=table, column=time_column)
    unit = unit_of(time_column, quantity="time", path=str(table))
    how = "by its name"
    if unit is None:
        unit, how = guess_time_unit(time), "guessed from its steps"
    notes = [
        f"{table.name}: times of images are those of column {time_column!r}, in {unit} ({how}), "
        f"their names those of {name_column!r}."
    ]
    if listed > len(images):
        notes.append(f"{table.name}: {listed - len(images)} of {listed} rows name no image of the folder.")
    return FrameTimes(paths=tuple(row[2] for row in found), time_s=time * TIME_UNITS[unit], notes=tuple(notes))


def _name_column(text: TextTable) -> str:
    found = next((name for name in text.header if name.lower().replace(" ", "_") in _NAME_COLUMNS), None)
    if found is None:
        raise RecordingError(
            f"{text.path} has no column with the names of images among {', '.join(map(repr, text.header))}; "
            "call it file"
        )
    return found


def _stamps(text: TextTable, name_column: str, time_column: str) -> tuple[dict[str, tuple[float, int]], int]:
    """Time and line of every name, with and without its ending, and how many rows there are."""
    name_at, time_at = text.header.index(name_column), text.header.index(time_column)
    stamps: dict[str, tuple[float, int]] = {}
    count = 0
    for line, fields in text.rows():
        count += 1
        name = fields[name_at].replace("\\", "/").rsplit("/", maxsplit=1)[-1]
        where = f"{text.path}, line {line}, {time_column!r}"
        value = to_number(fields[time_at].replace(",", "."), shown=fields[time_at], where=where)
        if name in stamps:
            raise RecordingError(f"{text.path}, line {line} names {name!r} again; give each image one time")
        stamps[name] = value, line
    # "frame_1.5" has no ending: a full name is looked for before one without it
    for name in list(stamps):
        stamps.setdefault(Path(name).stem, stamps[name])
    return stamps, count


MOST_PIXELS = 100_000_000
"""Of a frame: a larger one is a damaged header, and would ask for gigabytes."""

# FFmpeg also plays text files and play lists, and would follow these to other files and hosts
_OPTIONS = {
    "protocol_whitelist": "file",
    "format_whitelist": (
        "mov,mp4,m4a,3gp,3g2,mj2,avi,matroska,webm,mpegts,mpeg,asf,flv,ogg,nut,ivf,h264,hevc,m4v,mjpeg,"
        "yuv4mpegpipe,apng,gif"
    ),
}
# titles that are no UTF-8 must not keep a recording from being read; from PyAV 19 on they never do
_LENIENT: dict[str, Any] = {"metadata_errors": "replace"} if int(av.__version__.split(".")[0]) < 19 else {}
_NO_DECODER = "is coded in a way that FFmpeg cannot read; export it as FFV1 or H.264"
_ANY_ZERO = frozenset({"mpegts", "mpeg"})


@dataclass(frozen=True, kw_only=True)
class VideoFile:
    """What the container says of its frames, without any being decoded."""

    path: Path
    frames: int
    stamps: Int64[np.ndarray, " frames"] | None
    """In units of the stream, in the order the frames are shown; None where there are none."""
    time_s: Float[np.ndarray, " frames"] | None
    counted: bool
    """The container counts frames and holds no presentation stamps."""
    frame_size: tuple[int, int]
    """Height and width, in pixels."""
    notes: tuple[str, ...]


def inspect_video(path: Path) -> VideoFile:
    """Read the stamps of all frames.

    Raises
    ------
    RecordingError
        If the file is missing, no video, truncated, holds no frame or claims absurdly large ones.
    """
    with _open(path) as container:
        video = _video_stream(container, path)
        size = video.codec_context.height, video.codec_context.width
        if min(size) <= 0 or size[0] * size[1] > MOST_PIXELS:
            raise RecordingError(
                f"{path} claims frames of {size[1]} x {size[0]} pixels; the file is damaged, copy or export it again"
            )
        # AVI counts frames; the presentation stamps made up from that are late where frames are reordered
        counted = container.format.name == "avi"
        found, cut = _read_stamps(container, video, path=path, counted=counted)
        stamps = time = None
        if None not in found and video.time_base is not None:
            stamps = np.sort(np.array(found, dtype=np.int64))
            # the clock of a transport stream starts anywhere
            zero = stamps[0] if container.format.name in _ANY_ZERO else 0
            time = (stamps - zero) * float(video.time_base)
        if cut or _ends_early(container, video, len(found), time):
            raise RecordingError(
                f"{path} is truncated or damaged: it ends before frame {len(found)}, sooner than its header says; "
                "copy it again"
            )
        notes = _notes(container, video, path)
    return VideoFile(
        path=path,
        frames=len(found),
        stamps=stamps,
        time_s=time,
        counted=counted,
        frame_size=size,
        notes=notes,
    )


def _read_stamps(
    container: InputContainer, video: VideoStream, *, path: Path, counted: bool
) -> tuple[list[int | None], bool]:
    """Stamps in the order of the file, and whether the last packet is cut off."""
    found: list[int | None] = []
    cut = False
    try:
        for packet in container.demux(video):
            # packets to be discarded are decoded for those that need them, but never shown
            if packet.size and not packet.is_discard:
                found.append(packet.dts if counted else packet.pts)
                cut = packet.is_corrupt
    except FFmpegError as error:
        raise RecordingError(_damaged(path, len(found), error.strerror)) from None
    if not found:
        raise RecordingError(f"{path} holds no frame; record it again")
    return found, cut


def _open(path: Path) -> InputContainer:
    if not path.is_file():
        raise RecordingError(f"{path} {'is no file' if path.exists() else 'does not exist'}; name a video file")
    try:
        # an absolute path cannot be taken for an address or a pattern of file names
        return av.open(str(path.absolute()), options=_OPTIONS, **_LENIENT)
    except (FFmpegError, OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RecordingError(f"{path} cannot be read as a video ({reason}); copy or export it again") from None


def _video_stream(container: InputContainer, path: Path) -> VideoStream:
    streams = _moving(container)
    if not streams:
        raise RecordingError(f"{path} has no video stream; name the file that the camera wrote")
    if streams[0].codec_context is None:
        raise RecordingError(f"{path} {_NO_DECODER}")
    return streams[0]


def _moving(container: InputContainer) -> list[VideoStream]:
    # the cover picture of a sound file is a stream too
    return [stream for stream in container.streams.video if not stream.disposition & Disposition.attached_pic]


def _notes(container: InputContainer, video: VideoStream, path: Path) -> tuple[str, ...]:
    codec, pixels = video.codec_context.codec, video.codec_context.format
    if pixels is None:
        raise RecordingError(f"{path} {_NO_DECODER}")
    notes = []
    streams = len(_moving(container))
    if streams > 1:
        notes.append(f"{path.name}: the first of {streams} video streams was read.")
    if codec.lossy:
        notes.append(
            f"{path.name}: frames are coded with loss ({codec.canonical_name}), which moves markers a little; "
            "record losslessly (FFV1, PNG) where you can."
        )
    if max(part.bits for part in pixels.components) > 8:
        notes.append(f"{path.name}: frames have more than 8 bits a channel and were reduced to 8.")
    return tuple(notes)


def _ends_early(
    container: InputContainer, video: VideoStream, frames: int, time_s: Float[np.ndarray, " frames"] | None
) -> bool:
    if video.frames:  # AVI and MP4 say how many frames they hold
        return frames < video.frames
    # Matroska says how long it lasts, which may be the length of a sound stream
    if not (container.format.name.startswith("matroska") and container.duration and len(container.streams) == 1):
        return False
    steps = [] if time_s is None else np.diff(time_s).tolist()
    if video.average_rate:
        steps.append(float(1 / video.average_rate))
    if time_s is None or not steps:
        return False
    return float(time_s[-1]) + 1.5 * max(steps) < container.duration / av.time_base


def decode_video(file: VideoFile) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Decode the frames in the order they are shown.

    Raises
    ------
    RecordingError
        If a frame is damaged, missing or of another size than the first.
    """
    path, count = file.path, 0
    to_rgb = VideoReformatter()  # one for all: preparing it costs as much as a frame
    with _open(path) as container:
        video = _video_stream(container, path)
        video.thread_type = "AUTO"
        try:
            for frame in container.decode(video):
                if frame.is_corrupt:
                    raise RecordingError(_damaged(path, count, "it is incomplete"))
                if count == file.frames or not (
                    file.stamps is None or file.counted or frame.pts in {None, file.stamps[count]}
                ):
                    raise RecordingError(_damaged(path, count, "its stamp is not among those of the file"))
                if (frame.height, frame.width) != file.frame_size:
                    raise RecordingError(
                        f"frame {count} of {path} is {frame.width} x {frame.height} pixels but the file says "
                        f"{file.frame_size[1]} x {file.frame_size[0]}; record one size a file"
                    )
                count += 1
                yield to_rgb.reformat(frame, format="rgb24").to_ndarray()
        except FFmpegError as error:
            raise RecordingError(_damaged(path, count, error.strerror)) from None
    if count < file.frames:
        raise RecordingError(_damaged(path, count, f"the file has stamps of {file.frames} frames"))


def _damaged(path: Path, frame: int, reason: str | None) -> str:
    return f"frame {frame} of {path} cannot be decoded ({reason}); the file is damaged, copy or export it again"


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
