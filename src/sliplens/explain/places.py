"""Where the markers of an image lie, for occlusion by marker."""

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from sliplens.errors import InputError
from sliplens.markers import detect_markers
from sliplens.recordings import Recording


def find_markers(
    image: Float[Tensor, "3 height width"], reference: Float[Tensor, "3 height width"]
) -> Float[Tensor, "markers 2"]:
    """Places (x, y) of the markers that an image shows, in pixels.

    Parameters
    ----------
    image, reference
        As a network takes them, in [0, 1]; the reference tells whether the markers show at all.

    Raises
    ------
    InputError
        If the image is a difference image, or OpenCV is missing.
    ImageError
        If too few markers are found.
    """
    if not float(reference.std(dim=(1, 2)).max()):
        # a uniform reference is that of differences, in which a marker shows twice or, at rest, not at all
        raise InputError(
            "markers do not show in difference images; give their places (markers_px), or explain camera frames "
            "or a data set, where they are found in the raw frames"
        )
    pixels = (255 * image).round().clamp(0, 255).to(torch.uint8)
    return torch.from_numpy(detect_markers(pixels.permute(1, 2, 0).cpu().numpy()).centre_px)


def markers_in_frame(frame: UInt8[np.ndarray, "height width 3"], *, image_size: int) -> Float[Tensor, "markers 2"]:
    """Places (x, y) of the markers of a camera frame, in pixels of the network's square image.

    Raises
    ------
    InputError
        If OpenCV is missing.
    ImageError
        If too few markers are found.
    """
    return _scaled(detect_markers(frame).centre_px, frame.shape[:2], image_size)


def markers_in_recording(recording: Recording, row: int, *, image_size: int) -> Float[Tensor, "markers 2"]:
    """Places (x, y) of the markers in one frame of a trial, in pixels of the network's square image.

    The simulator's own where the trial has a truth, else found in the frame.

    Raises
    ------
    InputError
        If OpenCV is missing where markers have to be found.
    ImageError
        If too few markers are found.
    """
    if recording.truth is None:
        return markers_in_frame(recording.frames[row], image_size=image_size)
    return _scaled(recording.truth.marker_px[row], recording.frames.shape[1:3], image_size)


def _scaled(places_px: np.ndarray, size: tuple[int, ...], image_size: int) -> Tensor:
    # pixel centres are whole numbers in both images
    scale = image_size / np.array([size[1], size[0]])
    return torch.from_numpy((places_px.astype(np.float64) + 0.5) * scale - 0.5)
