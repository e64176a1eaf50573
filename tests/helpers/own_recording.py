"""A recording as a user brings it: a video of the frames, and a table of what a force sensor saw."""

import csv
from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from sliplens.images import write_png
from sliplens.recordings import Recording

_FORCE_RATE = 500
TARE = np.array([0.3, -0.2, 1.1])


def write_forces(trial: Recording, path: Path) -> Path:
    """Forces of a trial as a sensor saw them: tared wrongly, upside down, with noise."""
    rng = np.random.default_rng(1)
    time = np.arange(0, trial.time_s[-1] + 0.1, 1 / _FORCE_RATE)
    normal, pull = (
        np.interp(time, trial.time_s, values) for values in (trial.normal_force_n, trial.tangential_force_n)
    )
    seen = np.stack([pull, np.zeros_like(pull), -normal], axis=-1) + TARE + rng.normal(0, 0.02, (len(time), 3))
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["time [s]", "Fx [N]", "Fy [N]", "Fz [N]"])
        writer.writerows(np.column_stack([time, seen]).round(5).tolist())
    return path


def write_video(trial: Recording, path: Path) -> Path:
    """Frames of a trial as a lossless video, 30 a second."""
    return write_frames(path, trial.frames, rate=30)


def write_frames(
    path: Path,
    frames: Sequence[np.ndarray] | np.ndarray,
    *,
    codec: str = "ffv1",
    pixels: str = "bgr0",
    rate: int = 25,
    stamps_ms: list[int] | None = None,
    reordered: int = 0,
    title: str = "",
) -> Path:
    """Frames at a rate, or at milliseconds as they are given; `reordered` B-frames in a row."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # the table of an MP4 first, so that a file that is cut off has it
    faststart = {"movflags": "faststart"} if path.suffix == ".mp4" else {}
    with av.open(str(path), "w", options=faststart) as container:
        container.metadata["title"] = title
        stream = container.add_stream(codec, rate=rate)
        assert isinstance(stream, av.VideoStream)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = pixels
        stream.codec_context.max_b_frames = reordered
        stream.codec_context.gop_size = 12
        stream.codec_context.bit_rate = 4_000_000
        if codec == "libx264":
            # keep the B-frames that were asked for
            stream.options = {"b-adapt": "0", "threads": "1"}
        tick = Fraction(1, rate) if stamps_ms is None else Fraction(1, 1000)
        stream.codec_context.time_base = stream.time_base = tick
        for index, pixel in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(pixel, format="rgb24")
            frame.pts, frame.time_base = index if stamps_ms is None else stamps_ms[index], tick
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def write_images(folder: Path, frames: Iterable[np.ndarray], name: str = "{}.png") -> Path:
    """Frames as images of a folder, named by their numbers."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, frame in enumerate(frames):
        write_png(folder / name.format(number), frame)
    return folder
