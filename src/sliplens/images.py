"""Tactile images: reading, writing and differences; 8-bit RGB in, PNG out."""

import io
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float32, Shaped, UInt8
from PIL import ExifTags, Image, ImageOps

from sliplens.errors import ImageError, InputError
from sliplens.extras import import_cv2, missing_packages
from sliplens.files import require_file, require_folder

Buffer: TypeAlias = Any  #: Bytes of a file in memory, or an image of Pillow.
Images: TypeAlias = Any  #: Images that `as_frames` takes: an array, a PyTorch tensor, an image, or a list of them.

IMAGE_SUFFIXES = frozenset({".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp"})

_REDUCE = "divide its levels by 256, or by 16 or 4 where the camera gives 12 or 10 bits"
_TAGGED = frozenset({"exif", "Raw profile type exif", "XML:com.adobe.xmp", "xmp"})
"""Entries of a header in which Pillow finds the tag; without any it would decode a PNG to search behind its pixels."""
MOST_PIXELS = 100_000_000
"""Largest number of pixels: more mean a damaged header, and would need gigabytes."""
_DAMAGE = (OSError, SyntaxError, ValueError, MemoryError, Image.DecompressionBombError)  # what Pillow raises


def has_colour(image: UInt8[np.ndarray, "height width 3"]) -> bool:
    """Check whether at least a hundredth of an image has a colour; the channels of a grey camera are equal."""
    spread = image.max(axis=-1) - image.min(axis=-1)
    return bool(np.mean(spread >= 16) >= 0.01)  # grey levels, more than a camera's noise on grey objects


def channel_correlations(image: UInt8[np.ndarray, "height width 3"]) -> tuple[float, float]:
    """Return the correlations over the pixels of red with green and of green with blue; 1 in a grey image."""
    red, green, blue = image.reshape(-1, 3).T.astype(np.float64)
    with np.errstate(invalid="ignore"):  # a channel may be constant
        pairs = [np.corrcoef(first, second)[0, 1] for first, second in ((red, green), (green, blue))]
    return float(np.nan_to_num(pairs[0], nan=1.0)), float(np.nan_to_num(pairs[1], nan=1.0))


def _require_plain(image: Image.Image, where: str) -> None:
    """Refuse an image that is not one of 8 bits a channel: of 16, Pillow keeps the upper 8, and of 12 these are 4."""
    bits = max(getattr(image, "tag_v2", {}).get(ExifTags.Base.BitsPerSample, (8,)))
    if image.mode.startswith("I;16") or any(";16" in str(tile.args) for tile in getattr(image, "tile", ())):
        bits = 16
    if bits > 8:
        raise ImageError(f"{where} has {bits} bits a channel; {_REDUCE}, and save it as 8-bit RGB")
    if image.mode not in {"RGB", "L"}:
        cure = "drop the alpha channel" if image.mode == "RGBA" else "convert it to 8-bit RGB or grey"
        raise ImageError(f"{where} has the colours {image.mode}, not RGB; {cure}")
    if (pages := getattr(image, "n_frames", 1)) > 1:
        raise ImageError(f"{where} holds {pages} images; save one image a file")


@contextmanager
def _open_image(source: Path | Buffer, where: str, cure: str = "") -> Iterator[Image.Image]:
    """Open an 8-bit RGB or grey image of a file or in memory; pixels are read inside, or never."""
    if isinstance(source, Path):
        require_file(source, error=ImageError)
    try:
        with warnings.catch_warnings():
            # Pillow warns near the limit that is checked below
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            if isinstance(source, Image.Image):
                opened = nullcontext(source)  # the caller closes it
            else:
                stream = source if isinstance(source, Path) else io.BytesIO(source)
                opened = Image.open(stream, formats=("PNG", "TIFF", "JPEG", "BMP"))
        with opened as image:
            if image.width * image.height > MOST_PIXELS:
                raise ValueError(f"{image.width} x {image.height} pixels are more than any camera has")
            _require_plain(image, where)
            yield image
    except _DAMAGE as error:
        raise ImageError(f"{where} cannot be read as an image ({error}); {cure or 'copy or export it again'}") from None


def _orientation(image: Image.Image) -> int:
    """Return the orientation tag of an image that is not decoded yet; 1 for a TIFF, which Pillow turns itself."""
    if image.format == "TIFF" or not _TAGGED & image.info.keys():
        return 1
    return image.getexif().get(ExifTags.Base.Orientation, 1)


def _upright_size(image: Image.Image) -> tuple[int, int]:
    width, height = image.size
    return (width, height) if _orientation(image) >= 5 else (height, width)


def image_size(source: Path | Buffer, *, where: str = "") -> tuple[int, int]:
    """Read height and width of an image after the turn of its orientation tag, in pixels, from its header."""
    with _open_image(source, where or str(source)) as image:
        return _upright_size(image)


def read_image(
    source: Path | Buffer,
    *,
    size: tuple[int, int] | None = None,
    where: str = "",
    cure: str = "",
) -> UInt8[np.ndarray, "height width 3"]:
    """Read an 8-bit image (PNG, TIFF, JPEG or BMP), of a size (height, width) in pixels unless that is None.

    Images with an orientation tag (EXIF) are turned upright; grey is repeated in all three channels.

    Parameters
    ----------
    source
        File, its bytes in memory, or an image of Pillow.
    size
        Height and width that it must have, in pixels.
    where, cure
        Name and cure in messages.

    Raises
    ------
    ImageError
        If the file is missing, truncated or no image, is neither 8-bit RGB nor grey, or has another size.

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
    with _open_image(source, where := where or str(source), cure) as image:
        if size is not None and (actual := _upright_size(image)) != tuple(size):
            sizes = f"{actual[0]} x {actual[1]} pixels, {size[0]} x {size[1]} are needed"
            raise ImageError(f"{where} is {sizes}; use frames of the sensor the network was trained for")
        pixels = np.array(image if _orientation(image) == 1 else ImageOps.exif_transpose(image))
        return pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=2)


def write_png(path: Path, pixels: UInt8[np.ndarray, "height width *channels"]) -> None:
    """Write an image as PNG, losslessly."""
    Image.fromarray(pixels).save(path, format="PNG")


def encode_image(pixels: UInt8[np.ndarray, "height width *channels"], *, jpeg_quality: int | None = None) -> bytes:
    """Encode an image as PNG, which hardly shrinks noisy frames above the lowest level, or with loss as JPEG."""
    form = "PNG" if jpeg_quality is None else "JPEG"
    Image.fromarray(pixels).save(buffer := io.BytesIO(), format=form, compress_level=1, quality=jpeg_quality)
    return buffer.getvalue()


def list_images(folder: Path) -> list[Path]:
    """List the image files of a folder in natural order (frame 2 before frame 10).

    Raises
    ------
    InputError
        If the folder is missing, or holds no image.
    """
    require_folder(folder, what="the image folder")
    # macOS writes `._NAME` beside a file on other disks
    files = (path for path in folder.iterdir() if not path.name.startswith("._"))
    images = [path for path in files if path.suffix.lower() in IMAGE_SUFFIXES]
    for path in images:
        # without a frame that is a dead link, all later ones would move up
        require_file(path)
    if not images:
        raise InputError(f"{folder} holds no image (looked for {', '.join(sorted(IMAGE_SUFFIXES))}); check the path")
    return sorted(images, key=lambda path: natural_key(path.name))


def is_image(path: Path) -> bool:
    """Check whether a path is a file with the suffix of an image."""
    return path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()


def natural_key(text: str) -> list[tuple[int, int | str]]:
    """Return a sort key in which runs of digits count as numbers."""
    return [(0, int(part)) if part.isdecimal() else (1, part.lower()) for part in re.split(r"(\d+)", text)]


_opencv = cache(lambda: None if missing_packages("cv2", extra="markers") else import_cv2())


def shrink(image: UInt8[np.ndarray, "height width 3"], factor: int) -> UInt8[np.ndarray, "rows columns 3"]:
    """Average square blocks and round; incomplete blocks at the right and below are cut off."""
    if factor == 1:
        return image
    height, width = (side // factor for side in image.shape[:2])
    image = image[: height * factor, : width * factor]
    if (cv2 := _opencv()) is not None:  # several times as fast
        return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(Image.fromarray(image).reduce(factor))


_MOTION_BLOCKS = 28  # across the shorter side: wide enough to average noise, narrower than a marker's spacing
Soft: TypeAlias = Float32[np.ndarray, "rows columns 3"]
"""Means of square blocks of a frame, in grey levels."""


def soften(frame: UInt8[np.ndarray, "height width 3"]) -> Soft:
    """Average square blocks of a frame; pixels that fill no block at the right and below are left out."""
    height, width, _ = frame.shape
    side = max(1, min(height, width) // _MOTION_BLOCKS)
    rows, columns = height // side, width // side
    # row by row, not by a sum over an axis: several times as fast, and uint16 holds 257 rows of 255
    lines = frame[: rows * side].reshape(rows, side, width, 3)
    sums = lines[:, 0].astype(np.uint16 if side <= 257 else np.uint32)
    for line in range(1, side):
        sums += lines[:, line]
    blocks = np.add.reduceat(sums[:, : columns * side], np.arange(0, columns * side, side), axis=1, dtype=np.uint32)
    return (blocks / np.float32(side * side)).astype(np.float32)


LEAST_TOUCH = 7.0
"""Least `picture_change` that shows a contact, in grey levels: noise and lossy video change a picture by less."""


def picture_change(softened: Soft, untouched: Soft) -> float:
    """Compute the largest difference (98 %) of a softened picture from the untouched sensor, in grey levels."""
    return float(np.quantile(np.abs(softened - untouched).max(axis=-1), 0.98))


def absolute_difference(
    frames: UInt8[np.ndarray, "*batch height width 3"], reference: UInt8[np.ndarray, "_ _ 3"]
) -> UInt8[np.ndarray, "*batch height width 3"]:
    """Compute the absolute difference |T_n - T_0| of frames T_n and the reference frame T_0, in grey levels.

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
    require_same_size(frames, reference)
    # max - min instead of a subtraction: it stays in uint8 and cannot wrap
    return np.maximum(frames, reference) - np.minimum(frames, reference)


def signed_difference(
    frames: UInt8[np.ndarray, "*batch height width 3"], reference: UInt8[np.ndarray, "_ _ 3"]
) -> UInt8[np.ndarray, "*batch height width 3"]:
    """Compute the signed difference T_n - T_0 of frames and the reference frame, halved, plus 128, in 8 bits.

    Values above 128 are brighter, values below darker; a step is two grey levels, less than the noise of a camera.

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
    require_same_size(frames, reference)
    # T_n / 2 - T_0 / 2 + 128 without leaving uint8: halves of both, rounded alike, so that equal pixels give 128
    return (frames >> 1) + (np.uint8(128) - (reference >> 1))


_CURES = {
    "f": "multiply them by 255 if they are in [0, 1], round them, and convert them with .astype(np.uint8)",
    "u": f"{_REDUCE}, and convert them with .astype(np.uint8)",
    "i": "if they are from 0 to 255, convert them with .astype(np.uint8)",
}
"""Conversions to 8-bit levels, by NumPy's kind of a type."""


def require_rgb(images: Images, *, what: str = "frames") -> None:
    """Refuse an array that holds no 8-bit RGB images, one or a batch with the colours on the last axis.

    Levels of other types are ambiguous: 1.0 may be white or almost black.
    """
    if not isinstance(images, np.ndarray):
        raise ImageError(f"the {what} are of type {type(images).__name__}; give an array of uint8, or images")
    if images.dtype != np.uint8:
        cure = _CURES.get(images.dtype.kind, "give the levels of the camera, from 0 to 255")
        raise ImageError(f"the {what} hold {images.dtype}, and sliplens takes 8-bit RGB (uint8); {cure}")
    if images.ndim < 3 or images.shape[-1] != 3:
        shape = f"shape {tuple(images.shape)}, which does not end in (height, width, 3)"
        raise ImageError(f"the {what} have {shape}; give RGB images with the colours on the last axis, grey as three")


def as_frames(images: Images, *, what: str = "frames") -> UInt8[np.ndarray, "frames height width 3"]:
    """Return images as 8-bit RGB frames; their layout is converted, their levels are not.

    Parameters
    ----------
    images
        Array or PyTorch tensor: frames (frames, height, width, 3), or one of them; of a tensor also with the colours
        first (frames, 3, height, width); the path of an image, or one of Pillow; or a list of such images.

    Raises
    ------
    ImageError
        If they are none of these, have different sizes, or hold other levels than uint8.

    Examples
    --------
    >>> as_frames(np.zeros((24, 32, 3), dtype=np.uint8)).shape
    (1, 24, 32, 3)
    >>> as_frames([np.zeros((24, 32, 3), dtype=np.uint8)] * 5).shape
    (5, 24, 32, 3)
    """
    if isinstance(images, list | tuple):
        parts = [as_frames(image, what=what) for image in images]
        if not parts:
            raise ImageError("there is no frame; give one or more")
        if len(sizes := {part.shape[1:] for part in parts}) > 1:
            sides = " and ".join(f"{height} x {width}" for height, width, _ in sorted(sizes)[:2])
            raise ImageError(f"the {what} have different sizes, such as {sides} pixels; give those of one camera")
        return np.concatenate(parts)
    if isinstance(images, Path | str):
        return read_image(Path(images))[None]
    if isinstance(images, Image.Image):
        return read_image(images, where=f"an image of the {what}")[None]
    if tensor := hasattr(images, "detach"):  # PyTorch, which this module does without
        images = images.detach().cpu().numpy()
    if tensor and images.ndim in {3, 4} and images.shape[-1] != 3 == images.shape[-3]:
        images = np.moveaxis(images, -3, -1)
    require_rgb(images, what=what)
    images = images[None] if images.ndim == 3 else images
    if images.ndim != 4:
        raise ImageError(f"the {what} have shape {images.shape}; give (frames, height, width, 3)")
    return images


def require_same_size(frames: Shaped[np.ndarray, "..."], reference: Shaped[np.ndarray, "..."]) -> None:
    """Refuse frames of another size or type than their reference frame."""
    require_rgb(frames)
    require_rgb(reference, what="levels of the reference")
    if frames.shape[-3:] != reference.shape:
        frame, untouched = (f"{image.shape[-3]} x {image.shape[-2]}" for image in (frames, reference))
        raise ImageError(f"frame of {frame} pixels against a reference of {untouched}; record both alike")
