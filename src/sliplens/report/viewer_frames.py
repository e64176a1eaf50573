"""Pictures of a trial for the Rerun viewer, a few in memory at a time."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

from sliplens.images import absolute_difference
from sliplens.images.files import encode_png
from sliplens.recordings import Recording
from sliplens.recordings.store import stream_frames
from sliplens.report.trial_charts import brighten
from sliplens.report.viewer_numbers import clock
from sliplens.report.viewer_process import require_rerun

if TYPE_CHECKING:
    from rerun import RecordingStream

_PNG = "image/png"
_TOGETHER = 8  # frames that are sent together: a megabyte or so, as much as Rerun itself sends at once


def log_frames(
    stream: "RecordingStream", path: Path, trial: Recording, factor: float, on_frames: Callable[[int, int], None] | None
) -> None:
    """Log camera frames and their bright differences from the reference, losslessly.

    As PNG: two thirds the size of raw pixels, in the file and in the viewer's memory, for some 5 ms a picture.
    """
    rerun, frames, done = require_rerun(), stream_frames(path), 0

    def encode(frame: UInt8[np.ndarray, "_ _ 3"]) -> tuple[bytes, bytes]:
        return encode_png(frame), encode_png(brighten(absolute_difference(frame, trial.reference), factor))

    stream.log("reference", rerun.EncodedImage(contents=encode_png(trial.reference), media_type=_PNG), static=True)
    with ThreadPoolExecutor() as pool:
        while some := list(islice(frames, _TOGETHER)):
            places = np.arange(done, done + len(some))
            times, pictures = clock(trial.time_s[places], places), zip(*pool.map(encode, some), strict=True)
            for entity, blobs in zip(("camera/frame", "difference"), pictures, strict=True):
                columns = rerun.EncodedImage.columns(blob=list(blobs), media_type=[_PNG] * len(blobs))
                stream.send_columns(entity, times, columns)
            done += len(some)
            if on_frames is not None:
                on_frames(done, len(trial))
