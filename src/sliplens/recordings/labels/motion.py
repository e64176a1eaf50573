"""How much the image moves from frame to frame, cheap enough for any recording."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float, Float32, UInt8

_BLOCKS = 28
"""Blocks across the shorter side: wide enough to average the camera's noise, narrower than a marker's spacing."""


def soften(frame: UInt8[np.ndarray, "height width 3"]) -> Float32[np.ndarray, "rows columns 3"]:
    """Means of square blocks of a frame, in grey levels; what does not fill a block at the right and below is left out.

    Parameters
    ----------
    frame
        RGB image.
    """
    height, width, _ = frame.shape
    side = max(1, min(height, width) // _BLOCKS)
    rows, columns = height // side, width // side
    # row by row, not by a sum over an axis: several times as fast, and uint16 holds 257 rows of 255
    lines = frame[: rows * side].reshape(rows, side, width, 3)
    sums = lines[:, 0].astype(np.uint16 if side <= 257 else np.uint32)
    for line in range(1, side):
        sums += lines[:, line]
    blocks = np.add.reduceat(sums[:, : columns * side], np.arange(0, columns * side, side), axis=1, dtype=np.uint32)
    return (blocks / np.float32(side * side)).astype(np.float32)


def image_motion(previous: UInt8[np.ndarray, "height width 3"], frame: UInt8[np.ndarray, "height width 3"]) -> float:
    """Mean absolute difference of two softened frames, in grey levels."""
    return float(np.mean(np.abs(soften(frame) - soften(previous))))


def measure_motion(frames: Iterable[UInt8[np.ndarray, "height width 3"]]) -> Float[np.ndarray, " frames"]:
    """How much each frame differs from the one before it (`image_motion`); 0 for the first.

    Parameters
    ----------
    frames
        One image for each time; they are taken one at a time.
    """
    motion: list[float] = []
    previous = None
    for frame in frames:
        soft = soften(frame)
        motion.append(0.0 if previous is None else float(np.mean(np.abs(soft - previous))))
        previous = soft
    return np.array(motion, dtype=np.float64)
