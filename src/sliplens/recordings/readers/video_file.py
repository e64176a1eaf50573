"""A video file: what its container says of the frames, and the frames one at a time."""

from collections.abc import Iterator
from dataclasses import dataclass
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
