"""Frames of one episode of a LeRobot data set: from a video of many episodes, or from images in Parquet."""

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from math import floor
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from av.container import InputContainer
from av.error import FFmpegError
from jaxtyping import Float, UInt8
from PIL import Image

from sliplens.errors import RecordingError
from sliplens.recordings.parquet import DAMAGED_PARQUET, one_line
from sliplens.recordings.readers.lerobot_layout import Episode

# what FFmpeg would guess from the content may be a play list that leads to other files and hosts
_CONTAINERS = {".mp4": "mp4", ".mov": "mov", ".mkv": "matroska", ".webm": "webm"}
_MOST_PIXELS = 100_000_000
"""Of a frame: a larger one is a damaged header."""
_DAMAGED_IMAGE = (OSError, SyntaxError, ValueError, Image.DecompressionBombError, Image.DecompressionBombWarning)


@dataclass(frozen=True, kw_only=True)
class VideoInfo:
    """What a video says of its frames, without any being decoded."""

    frame_size: tuple[int, int]
    codec: str
    lossy: bool


def read_video_info(path: Path) -> VideoInfo:
    """Read the header of a video.

    Raises
    ------
    RecordingError
        If the file is missing, no video, or its frames are absurdly large.
    """
    with _open_video(path) as container:
        coder = container.streams.video[0].codec_context
        if coder is None:
            raise RecordingError(f"{path} is coded in a way that FFmpeg cannot read; write it as AV1 or H.264")
        size = coder.height, coder.width
        if min(size) <= 0 or size[0] * size[1] > _MOST_PIXELS:
            raise RecordingError(f"{path} claims frames of {size[0]} x {size[1]} pixels; copy it again")
        return VideoInfo(frame_size=size, codec=coder.codec.canonical_name, lossy=coder.codec.lossy)


def video_frames(
    path: Path, wanted_s: Float[np.ndarray, " frames"], *, tolerance_s: float, frame_size: tuple[int, int]
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Decode the frames nearest to some stamps of a video.

    Parameters
    ----------
    path
        Video of many episodes.
    wanted_s
        Presentation stamps, rising.
    tolerance_s
        How far from it a frame may lie.
    frame_size
        Height and width that each must have.

    Raises
    ------
    RecordingError
        If there is no frame near a stamp, its size changes, or the video is damaged.
    """
    with _open_video(path) as container:
        shown = _decode_from(container, float(wanted_s[0]) - tolerance_s)
        current, following = next(shown, None), next(shown, None)
        for wanted in wanted_s:
            while current and following and abs(following[0] - wanted) < abs(current[0] - wanted):
                current, following = following, next(shown, None)
            if current is None or abs(current[0] - wanted) > tolerance_s:
                raise RecordingError(
                    f"{path} has no frame at {wanted:.3f} s; it is cut off, or was not written with this data set"
                )
            frame = current[1]
            if (frame.height, frame.width) != frame_size:
                raise RecordingError(
                    f"{path} has frames of {frame.height} x {frame.width} pixels at {wanted:.3f} s, its header says "
                    f"{frame_size[0]} x {frame_size[1]}; leave the episode out"
                )
            yield frame.to_ndarray(format="rgb24")


def image_frames(
    episode: Episode, key: str
) -> tuple[tuple[int, int], Callable[[], Iterator[UInt8[np.ndarray, "height width 3"]]]]:
    """Find the height and width of the frames of an episode that lie in a Parquet file, and how they are read.

    Parameters
    ----------
    episode
        Where they lie.
    key
        Column of the images.

    Raises
    ------
    RecordingError
        If an image is missing, damaged, neither RGB nor grey, or of another size than the first; of those that follow,
        when they are read.
    """
    read = partial(_stored_images, episode.data_file, key, episode.index)
    first = next(read(frame_size=None), None)
    if first is None:
        raise RecordingError(f"{episode.data_file} has no frame of episode {episode.index}; copy the data set again")
    height, width, _ = first.shape
    return (height, width), partial(read, frame_size=(height, width))


def _stored_images(
    path: Path, key: str, episode: int, *, frame_size: tuple[int, int] | None
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    index = 0
    try:
        file = pq.ParquetFile(path)
        groups = _row_groups(file, episode)
        for batch in file.iter_batches(batch_size=16, row_groups=groups, columns=["episode_index", key]):
            own = batch.column("episode_index").to_numpy() == episode
            for cell in batch.filter(pa.array(own)).column(key).to_pylist():
                where = f"frame {index} of {key}, episode {episode} of {path},"
                data = cell.get("bytes") if isinstance(cell, dict) else None
                if not isinstance(data, bytes) or not data:
                    raise RecordingError(f"{where} is not in the file; embed the images, or copy the data set again")
                pixels = decode_image(data, where=where)
                if frame_size is not None and pixels.shape[:2] != frame_size:
                    raise RecordingError(
                        f"{where} is {pixels.shape[0]} x {pixels.shape[1]} pixels, the first is "
                        f"{frame_size[0]} x {frame_size[1]}; leave the episode out"
                    )
                yield pixels
                index += 1
    except DAMAGED_PARQUET as error:
        raise RecordingError(f"{path} is not a readable Parquet file ({one_line(error)}); copy it again") from None


def _row_groups(file: pq.ParquetFile, episode: int) -> list[int]:
    """Row groups that may hold rows of an episode: without this, each episode would cost all that share its file."""
    # columns with parts, such as images, count as several here
    column = [file.schema.column(index).path for index in range(len(file.schema))].index("episode_index")
    found = []
    for group in range(file.num_row_groups):
        told = file.metadata.row_group(group).column(column).statistics
        if told is not None and told.has_min_max and told.physical_type == "INT64":
            if told.min <= episode <= told.max:
                found.append(group)
        else:
            found.append(group)
    return found


def decode_image(data: bytes, *, where: str) -> UInt8[np.ndarray, "height width 3"]:
    """Pixels of a PNG or JPEG; a grey one gets three equal channels.

    Raises
    ------
    RecordingError
        If it is damaged, or neither RGB nor grey; the message begins with `where`.
    """
    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as image:
            if image.mode not in {"RGB", "L"}:
                raise RecordingError(f"{where} has pixels of mode {image.mode}; record it as 8-bit RGB or grey")
            pixels = np.array(image)
    except _DAMAGED_IMAGE as error:
        raise RecordingError(f"{where} cannot be read as PNG or JPEG ({error}); copy the data set again") from None
    return pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=2)


def _decode_from(container: InputContainer, start_s: float) -> Iterator[tuple[float, av.VideoFrame]]:
    """Frames with their stamps, from a key frame at or before `start_s`."""
    stream = container.streams.video[0]
    stream.thread_type = "AUTO"
    if stream.time_base is not None:
        container.seek(max(floor(start_s / stream.time_base), 0), stream=stream)
    for frame in container.decode(stream):
        if frame.time is not None and not frame.is_corrupt:
            yield frame.time, frame


@contextmanager
def _open_video(path: Path) -> Iterator[InputContainer]:
    if not path.is_file():
        raise RecordingError(f"{path} does not exist; copy the data set again, with its videos")
    form = _CONTAINERS.get(path.suffix.lower())
    if form is None:
        raise RecordingError(f"{path} is no video that can be read; write {', '.join(_CONTAINERS)}")
    try:
        # an absolute path cannot be taken for an address
        with av.open(str(path.absolute()), format=form, options={"protocol_whitelist": "file"}) as container:
            if not container.streams.video:
                raise RecordingError(f"{path} has no video stream; copy it again")
            yield container
    except (FFmpegError, OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RecordingError(f"{path} cannot be decoded as a video ({reason}); copy it again") from None
