"""Image files as frames: 8-bit RGB, or grey repeated in all three channels."""

import warnings
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from sliplens.errors import ImageError, RecordingError
from sliplens.images.files import read_image


def frame_size(path: Path) -> tuple[int, int]:
    """Height and width of an image, in pixels, read from its header.

    Raises
    ------
    ImageError
        If it is missing or no image, claims an absurd size, or holds several images.
    """
    try:
        with warnings.catch_warnings(), Image.open(path) as image:
            # Pillow warns of a size that would fill the memory, and goes on
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            pages = getattr(image, "n_frames", 1)
            if pages > 1:
                raise ImageError(f"{path} holds {pages} images; save one image a file")
            return image.height, image.width
    except FileNotFoundError:
        raise ImageError(f"{path} does not exist; check the path") from None
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise ImageError(f"{path} cannot be read as an image ({error}); copy or export it again") from None


def read_frame(path: Path, *, size: tuple[int, int]) -> UInt8[np.ndarray, "height width 3"]:
    """Read an image as a frame.

    Raises
    ------
    ImageError
        If it is missing, truncated or no image, is neither 8-bit RGB nor 8-bit grey, or has another size.
    """
    try:
        with Image.open(path) as image:
            if image.mode != "L" or image.size != size[::-1]:
                return read_image(path, size=size)  # says what is wrong, too
            grey = np.array(image)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise ImageError(f"{path} cannot be read as an image ({error}); copy or export it again") from None
    return np.repeat(grey[:, :, None], 3, axis=2)


def common_size(paths: tuple[Path, ...]) -> tuple[int, int]:
    """Height and width that all images share.

    Raises
    ------
    ImageError
        If one cannot be read.
    RecordingError
        If one has another size than the first.
    """
    first = frame_size(paths[0])
    for path in paths[1:]:
        size = frame_size(path)
        if size != first:
            raise RecordingError(
                f"{path} is {size[1]} x {size[0]} pixels but {paths[0].name} is {first[1]} x {first[0]}; "
                "record all frames of a trial with the same camera settings"
            )
    return first
