"""Frames of a video file, with the presentation stamps of its container."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
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
from jaxtyping import Float, Float32, Int64, UInt8

from sliplens.errors import RecordingError
from sliplens.images import MOST_PIXELS, is_image
from sliplens.progress import number_of
from sliplens.recordings.capture import Capture, Frame
from sliplens.recordings.formats.tables import evenly_spaced, place_on_clock, trial_name
from sliplens.recordings.options import ReadOptions

_HEAD = 13  # frames at the start that may be stale
_HORIZON = 500  # frames that the head is compared with; a longer video is read no further
_BLOCKS = 24, 32
_LEAST_LEAP = 1.5  # grey levels, mean over the image: several times what noise and coding change
_FROZEN = 0.75  # grey levels: no more than noise and coding change
_WAKES = 1.015  # a camera that adapts its exposure when it is started grows brighter by more


def small_copies(frames: Iterable[Frame]) -> Float32[np.ndarray, "frames rows columns 3"]:
    """Reduce frames to the means of blocks, enough to tell scenes apart and small enough to keep."""
    copies = []
    for frame in islice(frames, _HORIZON):
        rows, columns = (min(most, size) for most, size in zip(_BLOCKS, frame.shape[:2], strict=True))
        height, width = frame.shape[0] // rows, frame.shape[1] // columns
        whole = frame[: rows * height, : columns * width]
        # rows first, which lie in one piece: several times faster than both at once
        lines = whole.reshape(rows, height, -1).sum(axis=1, dtype=np.uint32)
        copies.append((lines.reshape(rows, columns, width, 3).sum(axis=2) / (height * width)).astype(np.float32))
    return np.stack(copies) if copies else np.empty((0, *_BLOCKS, 3), dtype=np.float32)


def count_stale(copies: Float32[np.ndarray, "frames rows columns 3"]) -> int:
    """Count the frames at the start of `small_copies` that belong to another scene.

    A camera that was just started hands out dark frames, then frozen frames of an earlier moment from its buffers, the
    last of them unlike every frame that follows. Of an object that slides all frames leap, or none does. (Where the
    camera ran already, an object that is pressed all at once within the first 13 frames and never released looks like
    a frozen start; do not count there.)
    """
    head = min(_HEAD, len(copies) // 3)  # enough frames must follow to compare with
    if not head:
        return 0
    flat = copies.reshape(len(copies), -1)
    leap = np.array([np.abs(flat[at + 1 :] - flat[at]).mean(axis=1).min() for at in range(head)])
    brightness = flat[: head + 1].mean(axis=1)
    wakes = bool(np.any(brightness[1:] > _WAKES * brightness[:-1]))
    frozen = np.append(False, leap[:-1] < np.minimum(leap[1:] / 4, _FROZEN))
    # where all frames move, none of them leaps
    stale = (leap > max(_LEAST_LEAP, 4 * float(np.median(leap)))) & (frozen | wakes)
    return int(np.flatnonzero(stale)[-1]) + 1 if stale.any() else 0


def least_contact(copies: Float32[np.ndarray, "frames rows columns 3"]) -> int:
    """Find the frame with the least relief: the candidate for a reference where none was recorded."""
    colour = copies[..., [0, 2]] - copies[..., [1]]
    padded = np.pad(colour, ((0, 0), (2, 2), (2, 2), (0, 0)), mode="edge")
    smooth = np.lib.stride_tricks.sliding_window_view(padded, (5, 5), axis=(1, 2)).mean(axis=(-2, -1))
    return int(np.argmin(np.abs(colour - smooth).mean(axis=(1, 2, 3))))


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


@contextmanager
def open_video(path: Path) -> Iterator[tuple[InputContainer, VideoStream]]:
    """Open the container of a video, never a play list, and its first video stream; FFmpeg's errors are reported."""
    if not path.is_file():
        raise RecordingError(f"{path} {'is no file' if path.exists() else 'does not exist'}; name a video, or copy it")
    if is_image(path):
        raise RecordingError(f"{path} is an image and no video; name the folder that it lies in")
    try:
        # an absolute path cannot be taken for an address or a pattern of file names
        with av.open(str(path.absolute()), options=_OPTIONS, **_LENIENT) as container:
            streams = _moving(container)
            if not streams:
                raise RecordingError(f"{path} has no video stream; name the file that the camera wrote")
            codec = streams[0].codec_context
            if codec is not None and not 0 < codec.height * codec.width <= MOST_PIXELS:
                size = f"{codec.width} x {codec.height}"
                raise RecordingError(f"{path} claims frames of {size} pixels; the file is damaged, copy it")
            if codec is None or codec.format is None:
                raise RecordingError(f"{path} is coded in a way that FFmpeg cannot read; export it as FFV1 or H.264")
            if max(part.bits for part in codec.format.components) >= 16:
                # a decoder keeps the upper 8, and of a camera with 12 bits those hold four
                raise RecordingError(f"{path} has 16 bits a channel ({codec.format.name}); export it with 8")
            streams[0].thread_type = "AUTO"
            yield container, streams[0]
    except (FFmpegError, OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RecordingError(f"{path} cannot be read as a video ({reason}); copy or export it again") from None


def _moving(container: InputContainer) -> list[VideoStream]:
    # the cover picture of a sound file is a stream too
    return [stream for stream in container.streams.video if not stream.disposition & Disposition.attached_pic]


def upright(
    frame: av.VideoFrame, pixels: UInt8[np.ndarray, "rows columns 3"], *, where: object
) -> UInt8[np.ndarray, "_ _ 3"]:
    """Turn and mirror a frame by its display matrix, in which a telephone keeps how it was held."""
    side_data = frame.side_data.get("DISPLAYMATRIX")
    if side_data is None:
        return pixels
    fixed = np.frombuffer(bytes(side_data), dtype=np.int32)  # pyright: ignore[reportArgumentType]
    a, b, _, c, d = (fixed[:5] / 65536).tolist()
    if (abs(a), abs(b), abs(c), abs(d)) not in {(1, 0, 0, 1), (0, 1, 1, 0)}:
        raise RecordingError(f"{where} is turned by {frame.rotation} degrees, or stretched; export it upright")
    pixels = pixels.transpose(1, 0, 2) if a == 0 else pixels
    return np.ascontiguousarray(pixels[:: -1 if b + d < 0 else 1, :: -1 if a + c < 0 else 1])


def first_frame_size(path: Path) -> tuple[int, int]:
    """Return height and width of the upright frames of a video, from the first."""
    with open_video(path) as (container, video):
        for frame in container.decode(video):
            return upright(frame, frame.to_ndarray(format="rgb24"), where=path).shape[:2]
    raise RecordingError(f"{path} holds no frame; record it again")


def loss_note(video: VideoStream, *, name: str) -> tuple[str, ...]:
    """Return a note if frames are coded with loss."""
    codec = video.codec_context.codec
    loss = f"{name}: frames are coded with loss ({codec.canonical_name}), which moves markers a little"
    return (f"{loss}; record losslessly (FFV1, PNG) where you can.",) if codec.lossy else ()


@dataclass(frozen=True, kw_only=True)
class _VideoFile:
    """Facts about the frames of a video from its container."""

    frames: int
    stamps: Int64[np.ndarray, " frames"] | None
    """Stamps in units of the stream, in the order of display; None where there are none."""
    time_s: Float[np.ndarray, " frames"] | None
    counted: bool  #: True where the container counts frames and holds no presentation stamps.
    frame_size: tuple[int, int]  #: Height and width of the upright frames, in pixels.
    notes: tuple[str, ...]


def _inspect(path: Path) -> _VideoFile:
    """Read the stamps of all frames, and decode the first for its size."""
    packets: list[int | None] = []
    cut, stamps, time_s = False, None, None
    with open_video(path) as (container, video):
        # AVI counts frames; the presentation stamps made up from that are late where frames are reordered
        counted = container.format.name == "avi"
        try:
            for packet in container.demux(video):
                # packets to be discarded are decoded for those that need them, but never shown
                if packet.size and not packet.is_discard:
                    packets.append(packet.dts if counted else packet.pts)
                    cut = packet.is_corrupt
        except FFmpegError as error:
            raise RecordingError(_damaged(path, len(packets), error.strerror)) from None
        if packets and None not in packets and video.time_base is not None:
            stamps = np.sort(np.array(packets, dtype=np.int64))
            # the clock of a transport stream starts anywhere
            zero = stamps[0] if container.format.name in {"mpegts", "mpeg"} else 0
            time_s = (stamps - zero) * float(video.time_base)
        if cut or _ends_early(container, video, len(packets), time_s):
            raise RecordingError(f"{path} is truncated or damaged: it ends before frame {len(packets)}; copy it again")
        notes = list(loss_note(video, name=path.name))
        if (streams := len(_moving(container))) > 1:
            notes.append(f"{path.name}: the first of {streams} video streams was read.")
        pixels = video.codec_context.format
        if pixels is not None and max(part.bits for part in pixels.components) > 8:
            notes.append(f"{path.name}: frames have more than 8 bits a channel and were reduced to 8.")
    return _VideoFile(
        frames=len(packets),
        stamps=stamps,
        time_s=time_s,
        counted=counted,
        frame_size=first_frame_size(path),
        notes=tuple(notes),
    )


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


def _decode(path: Path, file: _VideoFile) -> Iterator[Frame]:
    """Decode the frames in the order they are shown, upright."""
    count = 0
    to_rgb = VideoReformatter()  # one for all: preparing it costs as much as a frame
    with open_video(path) as (container, video):
        try:
            for frame in container.decode(video):
                if frame.is_corrupt:
                    raise RecordingError(_damaged(path, count, "it is incomplete"))
                if count == file.frames or not (
                    file.stamps is None or file.counted or frame.pts in {None, file.stamps[count]}
                ):
                    raise RecordingError(_damaged(path, count, "its stamp is not among those of the file"))
                pixels = upright(frame, to_rgb.reformat(frame, format="rgb24").to_ndarray(), where=path)
                if pixels.shape[:2] != file.frame_size:
                    raise RecordingError(_damaged(path, count, "it is of another size than the first"))
                count += 1
                yield pixels
        except FFmpegError as error:
            raise RecordingError(_damaged(path, count, error.strerror)) from None
    if count < file.frames:
        raise RecordingError(_damaged(path, count, f"the file has stamps of {number_of(file.frames, 'frame')}"))


def _damaged(path: Path, frame: int, reason: str | None) -> str:
    return f"frame {frame} of {path} cannot be decoded ({reason}); the file is damaged, copy or export it again"


def read_video(path: Path, options: ReadOptions) -> Capture:
    """Open a video at its presentation stamps, which keep a variable rate, and a table of forces recorded beside it."""
    file, frame_rate, skipped = _inspect(path), options.frame_rate, options.skip_frames or 0
    notes, time_s = list(file.notes), file.time_s
    if frame_rate is not None:
        time_s = evenly_spaced(file.frames, frame_rate=frame_rate)
        notes.append(f"{path.name}: frames were declared to be taken {frame_rate:g} times a second.")
    if time_s is None:
        raise RecordingError(f"{path} has no presentation stamps; declare its rate with --frame-rate")
    time_s, samples, more = place_on_clock(time_s, options, source=path.name)
    if options.skip_stale:
        skipped = max(skipped, count_stale(small_copies(_decode(path, file))))
    if not 0 <= skipped < file.frames:
        raise RecordingError(f"{skipped} of {number_of(file.frames, 'frame')} of {path} cannot be skipped; skip fewer")
    if skipped:
        more = (*more, f"{path.name}: the first {skipped} of {file.frames} frames were left out.")
    return Capture(
        trial=trial_name(path.stem),
        source=str(path),
        frame_time_s=time_s[skipped:],
        frame_size=file.frame_size,
        read_frames=lambda: islice(_decode(path, file), skipped, None),
        forces=samples,
        notes=(*notes, *more),
    )
