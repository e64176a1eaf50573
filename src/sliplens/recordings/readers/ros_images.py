"""Images in ROS 2 messages: what is claimed of them is checked before a pixel is touched."""

import io
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from sliplens.errors import RecordingError

RAW, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"

_CHANNELS = {"rgb8": 3, "bgr8": 3, "mono8": 1}
_FORMATS = ("JPEG", "PNG")
_DAMAGED = (OSError, SyntaxError, ValueError, Image.DecompressionBombError, Image.DecompressionBombWarning)


def image_size(message: Any, *, where: str) -> tuple[int, int]:
    """Height and width of an image, in pixels, without decoding it.

    Parameters
    ----------
    message
        A `sensor_msgs/Image` or `CompressedImage`.
    where
        Beginning of the error message.

    Raises
    ------
    RecordingError
        If the encoding is another one, or the message claims more pixels than it holds.
    """
    if message.__msgtype__ == COMPRESSED:
        with _open_compressed(message, where=where) as image:
            return image.height, image.width
    channels = _CHANNELS.get(message.encoding)
    if channels is None:
        raise RecordingError(
            f"{where} has encoding {message.encoding[:40]!r}; record it as {', '.join(_CHANNELS)}, JPEG or PNG"
        )
    if min(message.height, message.width) == 0 or message.step < message.width * channels:
        raise RecordingError(
            f"{where} claims {message.height} x {message.width} pixels in rows of {message.step} bytes, which cannot "
            f"be in {message.encoding}; record it again"
        )
    # Python's integers do not overflow, and nothing has the claimed size until it is known to be there
    if message.height * message.step > len(message.data):
        raise RecordingError(
            f"{where} claims {message.height} rows of {message.step} bytes but holds {len(message.data)} bytes; "
            "record it again"
        )
    return message.height, message.width


def image_pixels(message: Any, *, where: str) -> UInt8[np.ndarray, "height width 3"]:
    """Pixels of an image as RGB; grey is repeated in all three channels.

    Parameters
    ----------
    message
        A `sensor_msgs/Image` or `CompressedImage`.
    where
        Beginning of the error message.

    Raises
    ------
    RecordingError
        If the image is damaged or has another encoding.
    """
    if message.__msgtype__ == COMPRESSED:
        return _decompress(message, where=where)
    height, width = image_size(message, where=where)
    channels = _CHANNELS[message.encoding]
    # rows may be padded: step counts the padding too
    rows = message.data[: height * message.step].reshape(height, message.step)[:, : width * channels]
    pixels = rows.reshape(height, width, channels)
    if message.encoding == "mono8":
        return np.repeat(pixels, 3, axis=2)
    return np.array(pixels[..., ::-1] if message.encoding == "bgr8" else pixels, order="C")


def _open_compressed(message: Any, *, where: str) -> Image.Image:
    """Image with its header read; Pillow refuses one that would expand beyond its limit (a decompression bomb)."""
    try:
        # the bytes say what they are; `format` is free text, and drivers differ in it
        image = Image.open(io.BytesIO(message.data), formats=_FORMATS)
    except _DAMAGED as error:
        raise RecordingError(
            f"{where}, of format {message.format[:40]!r}, cannot be read as {' or '.join(_FORMATS)} ({error}); "
            "record it again, or as one of these"
        ) from None
    if image.mode not in {"RGB", "L"}:
        raise RecordingError(f"{where} has pixels of mode {image.mode}; record it as 8-bit RGB or grey")
    return image


def _decompress(message: Any, *, where: str) -> UInt8[np.ndarray, "height width 3"]:
    with _open_compressed(message, where=where) as image:
        try:
            pixels = np.array(image)
        except _DAMAGED as error:
            raise RecordingError(f"{where} is damaged ({error}); cut the bag before it") from None
    return pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=2)
