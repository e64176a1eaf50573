"""A recording as a user brings it: a video of the frames, and a table of what a force sensor saw."""

import csv
from pathlib import Path

import av
import numpy as np

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
    with av.open(str(path), "w", format="matroska") as container:
        stream = container.add_stream("ffv1", rate=30)
        stream.height, stream.width = trial.reference.shape[:2]
        stream.pix_fmt = "bgr0"
        for frame in trial.frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
    return path
