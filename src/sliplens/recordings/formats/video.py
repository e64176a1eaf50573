"""Frames of a video file, with the presentation stamps of its container."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
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
from sliplens.images import MOST_PIXELS, is_image
from sliplens.progress import number_of
from sliplens.recordings.capture import Capture, Frame
from sliplens.recordings.formats.tables import evenly_spaced, place_on_clock, trial_name
from sliplens.recordings.options import ReadOptions

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
                size = f"{codec.width} x {codec.height} pixels"
                raise RecordingError(f"{path} claims frames of {size}; the file is damaged, copy it")
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


def read_size(path: Path) -> tuple[tuple[int, int], tuple[str, ...]]:
    """Return height and width of the upright frames of a video, from the first, and a note if its coding has loss."""
    with open_video(path) as (container, video):
        codec = video.codec_context.codec
        loss = f"{path.name}: frames are coded with loss ({codec.canonical_name}), which moves markers a little"
        for frame in container.decode(video):
            size = upright(frame, frame.to_ndarray(format="rgb24"), where=path).shape[:2]
            return size, (f"{loss}; record losslessly (FFV1, PNG) where you can.",) if codec.lossy else ()
    raise RecordingError(f"{path} holds no frame; record it again")


def _ends_early(
    container: InputContainer, video: VideoStream, frames: int, time_s: Float[np.ndarray, " frames"] | None
) -> bool:
    if video.frames:  # AVI and MP4 say how many frames they hold
        return frames < video.frames
    # Matroska says how long it lasts, which may be the length of a sound stream
    alone = container.format.name.startswith("matroska") and len(container.streams) == 1
    if time_s is None or not (alone and container.duration):
        return False
    steps = [*np.diff(time_s).tolist(), *([float(1 / video.average_rate)] if video.average_rate else [])]
    return bool(steps) and float(time_s[-1]) + 1.5 * max(steps) < container.duration / av.time_base


def _decode(
    path: Path, *, frames: int, stamps: Int64[np.ndarray, " frames"] | None, size: tuple[int, int]
) -> Iterator[Frame]:
    """Decode the frames in the order they are shown, upright; stamps are None where the container counts frames."""
    count = 0
    to_rgb = VideoReformatter()  # one for all: preparing it costs as much as a frame
    with open_video(path) as (container, video):
        try:
            for frame in container.decode(video):
                if frame.is_corrupt:
                    raise _damaged(path, count, "it is incomplete")
                if count == frames or not (stamps is None or frame.pts in {None, stamps[count]}):
                    raise _damaged(path, count, "its stamp is not among those of the file")
                pixels = upright(frame, to_rgb.reformat(frame, format="rgb24").to_ndarray(), where=path)
                if pixels.shape[:2] != size:
                    raise _damaged(path, count, "it is of another size than the first")
                count += 1
                yield pixels
        except FFmpegError as error:
            raise _damaged(path, count, error.strerror) from None
    if count < frames:
        raise _damaged(path, count, f"the file has stamps of {number_of(frames, 'frame')}")


def _damaged(path: Path, frame: int, reason: str | None) -> RecordingError:
    return RecordingError(f"frame {frame} of {path} cannot be decoded ({reason}); the file is damaged, copy it again")


def read_video(path: Path, options: ReadOptions) -> Capture:
    """Open a video at its presentation stamps, which keep a variable rate, and a table of forces recorded beside it.

    Of a video that was cut off, the frames up to the cut are kept.
    """
    packets, cut, stamps, time_s, notes = list[int | None](), False, None, None, list[str]()
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
            raise _damaged(path, len(packets), error.strerror) from None
        if packets and None not in packets and video.time_base is not None:
            stamps = np.sort(np.array(packets, dtype=np.int64))
            # the clock of a transport stream starts anywhere
            zero = stamps[0] if container.format.name in {"mpegts", "mpeg"} else 0
            time_s = (stamps - zero) * float(video.time_base)
        cut |= _ends_early(container, video, len(packets), time_s)
        if (streams := len(_moving(container))) > 1:
            notes.append(f"{path.name}: the first of {streams} video streams was read.")
        pixels = video.codec_context.format
        if pixels is not None and max(part.bits for part in pixels.components) > 8:
            notes.append(f"{path.name}: frames have more than 8 bits a channel and were reduced to 8.")
    (size, loss), frames = read_size(path), len(packets)
    decode = partial(_decode, path, frames=frames, stamps=None if counted else stamps, size=size)
    if cut:
        frames = 0
        with suppress(RecordingError):
            for _ in decode():
                frames += 1
        whole = f"{number_of(frames, 'frame')} before the cut were kept"
        notes.append(f"{path.name}: the file is cut off: {whole}; copy it again if it was longer.")
    if options.frame_rate is not None:
        time_s = evenly_spaced(frames, frame_rate=options.frame_rate)
        notes.append(f"{path.name}: frames were declared to be taken {options.frame_rate:g} times a second.")
    if time_s is None:
        raise RecordingError(f"{path} has no presentation stamps; declare its rate with --frame-rate")
    time_s, samples, more = place_on_clock(time_s[:frames], options, source=path.name)
    skipped = options.skip_frames or 0
    if not 0 <= skipped < frames:
        raise RecordingError(f"{skipped} of {number_of(frames, 'frame')} of {path} cannot be skipped; skip fewer")
    if skipped:
        more = (*more, f"{path.name}: the first {skipped} of {frames} frames were left out.")
    return Capture(
        trial=trial_name(path.stem),
        source=str(path),
        frame_time_s=time_s[skipped:],
        frame_size=size,
        read_frames=lambda: islice(decode(), skipped, frames if cut else None),
        forces=samples,
        notes=(*loss, *notes, *more),
    )
