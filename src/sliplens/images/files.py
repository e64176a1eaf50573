"""Images on disk: 8-bit RGB in, PNG out."""

import io
import re
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from sliplens.errors import ImageError, InputError
from sliplens.files import require_folder

IMAGE_SUFFIXES = frozenset({".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp"})

_OTHER_MODES = {
    "L": "1 channel (grey)",
    "1": "1 channel (black and white)",
    "P": "a colour palette",
    "LA": "2 channels (grey and alpha)",
    "RGBA": "4 channels (alpha)",
    "CMYK": "4 channels (CMYK)",
    "I;16": "16 bits a pixel",
    "I": "more than 8 bits a pixel",
    "F": "floating-point pixels",
}
_BITS_PER_SAMPLE = 258  # TIFF tag
_DAMAGE = (OSError, SyntaxError, ValueError, Image.DecompressionBombError)  # what Pillow raises


def read_image(path: Path, *, size: tuple[int, int] | None = None) -> UInt8[np.ndarray, "height width 3"]:
    """Read an 8-bit RGB image.

    Parameters
    ----------
    path
        PNG, TIFF, JPEG or BMP.
    size
        Height and width that the image must have, in pixels; any size if None.

    Raises
    ------
    ImageError
        If the file is missing, truncated or no image, is not 8-bit RGB, or has another size.

    Examples
    --------
    >>> import numpy as np
    >>> from pathlib import Path
    >>> import tempfile
    >>> from sliplens.images import read_image, write_png
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_png(Path(folder) / "frame.png", np.zeros((4, 6, 3), dtype=np.uint8))
    ...     read_image(Path(folder) / "frame.png").shape
    (4, 6, 3)
    """
    try:
        with Image.open(path) as image:
            bits = max(getattr(image, "tag_v2", {}).get(_BITS_PER_SAMPLE, (8,)))
            if image.mode != "RGB" or bits > 8:
                what = f"{bits} bits a pixel" if bits > 8 else _OTHER_MODES.get(image.mode, f"mode {image.mode}")
                cure = "drop the alpha channel" if image.mode == "RGBA" else "convert it to 8-bit RGB"
                raise ImageError(f"{path} has {what}; {cure}")
            pixels = np.array(image)
    except FileNotFoundError:
        raise ImageError(f"{path} does not exist; check the path") from None
    except _DAMAGE as error:
        raise ImageError(f"{path} cannot be read as an image ({error}); copy or export it again") from None
    if size is not None and pixels.shape[:2] != tuple(size):
        raise ImageError(
            f"{path} is {pixels.shape[0]} x {pixels.shape[1]} pixels, {size[0]} x {size[1]} are needed; "
            "use frames of the sensor the network was trained for"
        )
    return pixels


def write_png(path: Path, pixels: UInt8[np.ndarray, "height width *channels"]) -> None:
    """Write an image as PNG, losslessly."""
    Image.fromarray(pixels).save(path, format="PNG")


def encode_png(pixels: UInt8[np.ndarray, "height width *channels"], *, compress_level: int = 1) -> bytes:
    """Bytes of an image as PNG; noisy tactile frames hardly shrink above the lowest level."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG", compress_level=compress_level)
    return buffer.getvalue()


def decode_png(data: bytes, *, where: str) -> UInt8[np.ndarray, "height width 3"]:
    """Pixels of an RGB PNG held in memory."""
    try:
        with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
            if image.mode != "RGB":
                raise ImageError(f"{where} has {_OTHER_MODES.get(image.mode, image.mode)}; make the data set again")
            return np.array(image)
    except _DAMAGE as error:
        raise ImageError(f"{where} cannot be read as PNG ({error}); make the data set again") from None


def list_images(folder: Path) -> list[Path]:
    """Image files of a folder in natural order (frame 2 before frame 10).

    Raises
    ------
    InputError
        If the folder is missing, or holds no image.
    """
    require_folder(folder, what="the image folder")
    found = [path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()]
    if not found:
        raise InputError(f"{folder} holds no image (looked for {', '.join(sorted(IMAGE_SUFFIXES))}); check the path")
    return sorted(found, key=lambda path: natural_key(path.name))


def natural_key(text: str) -> list[tuple[int, int | str]]:
    """Sort key that reads runs of digits as numbers."""
    return [(0, int(part)) if part.isdecimal() else (1, part.lower()) for part in re.split(r"(\d+)", text)]
