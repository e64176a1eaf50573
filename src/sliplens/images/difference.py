"""Temporal difference images: the current frame against the untouched sensor."""

import numpy as np
from jaxtyping import UInt8

from sliplens.errors import ImageError


def absolute_difference(
    frames: UInt8[np.ndarray, "*batch height width 3"], reference: UInt8[np.ndarray, "_ _ 3"]
) -> UInt8[np.ndarray, "*batch height width 3"]:
    """Absolute difference |T_n - T_0| of frames T_n against the reference frame T_0, in grey levels.

    Raises
    ------
    ImageError
        If a frame's size differs from the reference's.

    References
    ----------
    Polak, *Explainable Neural Networks for Incipient Slip Sensing in Robot Tactile Learning*, section 3.1.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.images import absolute_difference
    >>> untouched = np.full((2, 2, 3), 100, dtype=np.uint8)
    >>> pressed = untouched + np.array([[[0], [30]], [[60], [90]]], dtype=np.uint8)
    >>> absolute_difference(pressed, untouched)[..., 0]
    array([[ 0, 30],
           [60, 90]], dtype=uint8)
    """
    _require_same_size(frames, reference)
    # max - min instead of a subtraction: it stays in uint8 and cannot wrap
    return np.maximum(frames, reference) - np.minimum(frames, reference)


def signed_difference(
    frames: UInt8[np.ndarray, "*batch height width 3"], reference: UInt8[np.ndarray, "_ _ 3"]
) -> UInt8[np.ndarray, "*batch height width 3"]:
    """Signed difference T_n - T_0 of frames against the reference frame, in 8 bits: half the grey levels, plus 128.

    What brightens lies above 128, what darkens below; a step is two grey levels, less than the noise of a camera.

    Raises
    ------
    ImageError
        If a frame's size differs from the reference's.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.images import signed_difference
    >>> untouched = np.full((1, 3, 3), 100, dtype=np.uint8)
    >>> frame = np.array([[[100] * 3, [140] * 3, [60] * 3]], dtype=np.uint8)
    >>> signed_difference(frame, untouched)[..., 0]
    array([[128, 148, 108]], dtype=uint8)
    """
    _require_same_size(frames, reference)
    # T_n / 2 - T_0 / 2 + 128 without leaving uint8: halves of both, rounded alike, so that equal pixels give 128
    return (frames >> 1) + (np.uint8(128) - (reference >> 1))


def _require_same_size(frames: np.ndarray, reference: np.ndarray) -> None:
    if frames.shape[-3:] != reference.shape:
        frame, untouched = (f"{image.shape[-3]} x {image.shape[-2]}" for image in (frames, reference))
        raise ImageError(
            f"frame of {frame} pixels against a reference of {untouched}; "
            "record the reference with the same camera settings"
        )
