import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image, ImageOps
from there import there

from sliplens.errors import ImageError, InputError
from sliplens.images import encode_image, image_size, list_images, read_image, write_png
from sliplens.recordings.source import open_source


def save(path: Path, pixels: np.ndarray) -> Path:
    Image.fromarray(pixels).save(path)
    return path


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".bmp"])
def test_lossless_files_give_back_their_pixels(tmp_path: Path, rng: np.random.Generator, suffix: str):
    pixels = rng.integers(0, 256, (5, 7, 3), dtype=np.uint8)
    np.testing.assert_array_equal(read_image(save(tmp_path / f"a{suffix}", pixels)), pixels)


def test_png_in_memory_gives_back_its_pixels(rng: np.random.Generator):
    pixels = rng.integers(0, 256, (5, 7, 3), dtype=np.uint8)
    np.testing.assert_array_equal(read_image(encode_image(pixels), where="a"), pixels)


@pytest.mark.parametrize(
    ("name", "pixels", "message"),
    [
        ("a.png", np.zeros((5, 7, 2), np.uint8), r"a\.png has the colours LA, not RGB; convert"),
        ("a.png", np.zeros((5, 7, 4), np.uint8), r"a\.png has the colours RGBA, not RGB; drop the alpha"),
        ("a.png", np.zeros((5, 7, 3), np.uint8), r"a\.png is 5 x 7 pixels, 4 x 4 are needed"),
        ("a.tiff", np.full((5, 7), 40_000, np.uint16), r"a\.tiff has 16 bits a channel; divide its levels by 256"),
    ],
)
def test_images_of_other_colours_or_sizes_are_refused(tmp_path: Path, name: str, pixels: np.ndarray, message: str):
    with pytest.raises(ImageError, match=message):
        read_image(save(tmp_path / name, pixels), size=(4, 4))


def test_a_grey_image_is_repeated_in_all_channels(tmp_path: Path, rng: np.random.Generator):
    grey = rng.integers(0, 256, (5, 7), dtype=np.uint8)
    np.testing.assert_array_equal(read_image(save(tmp_path / "a.png", grey)), np.stack([grey] * 3, axis=-1))


def test_what_is_no_whole_image_is_refused(tmp_path: Path, rng: np.random.Generator):
    path = save(tmp_path / "a.png", rng.integers(0, 256, (64, 64, 3), dtype=np.uint8))
    for data in (path.read_bytes()[:2000], b"hello"):
        path.write_bytes(data)
        with pytest.raises(ImageError, match=r"a\.png cannot be read as an image .*; copy or export it again"):
            read_image(path)
    path.unlink()
    with pytest.raises(ImageError, match=r"a\.png does not exist; check the path"):
        read_image(path)


def test_images_are_listed_in_natural_order(tmp_path: Path):
    for name in ("frame10.png", "frame2.png", "frame1.PNG"):
        write_png(tmp_path / name, np.zeros((2, 2, 3), np.uint8))
    for name in ("notes.txt", "._frame2.png"):  # the latter by macOS
        (tmp_path / name).touch()
    assert [path.name for path in list_images(tmp_path)] == ["frame1.PNG", "frame2.png", "frame10.png"]


def test_what_is_no_folder_of_images_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match=r"holds no image \(looked for "):
        list_images(tmp_path)
    (tmp_path / "a").touch()
    for name, message in (("a", "a is a file, not a folder"), ("b", "b does not exist; check the path")):
        with pytest.raises(InputError, match=f"the image folder .*{message}"):
            list_images(tmp_path / name)


TAGGED = np.zeros((6, 10, 3), dtype=np.uint8)  # no turn and no mirror image leaves it as it is
TAGGED[:3, :5] = 250
TAGGED[:3, 5:] = 120


def save_tagged(path: Path, orientation: int) -> Path:
    tag = Image.Exif()
    tag[ExifTags.Base.Orientation] = orientation
    Image.fromarray(TAGGED).save(path, exif=tag)
    return path


@pytest.mark.parametrize("suffix", ["png", "tiff", "jpg"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_an_orientation_tag_is_applied_wherever_images_are_read(tmp_path: Path, suffix: str, orientation: int):
    path = save_tagged(tmp_path / f"a.{suffix}", orientation)
    with Image.open(path) as image:
        upright = np.asarray(ImageOps.exif_transpose(image))
    assert image_size(path) == upright.shape[:2]
    (trial,) = open_source(tmp_path, reference=path)
    read = [read_image(path, size=upright.shape[:2]), there(trial.reference), *trial.read_frames()]
    if suffix != "tiff":
        read.append(read_image(path.read_bytes(), where="a message"))
    for pixels in read:
        np.testing.assert_array_equal(pixels, upright)


def write_png_48(path: Path, pixels: np.ndarray) -> Path:
    """Write 16 bits a channel, which Pillow cannot: the chunks of the PNG specification, 11.2."""
    height, width, _ = pixels.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), pixels.astype(">u2").view(np.uint8).reshape(height, -1)], 1)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    parts = (chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(rows.tobytes())), chunk(b"IEND", b""))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    return path


@pytest.mark.parametrize("bits", [10, 12, 16])
def test_an_image_of_16_bits_is_refused_however_many_the_camera_used(tmp_path: Path, bits: int):
    path = write_png_48(tmp_path / "a.png", np.full((6, 10, 3), 2**bits - 1, dtype=np.uint16))
    for read in (
        lambda: read_image(path),
        lambda: open_source(tmp_path),
        lambda: open_source(np.zeros((1, 6, 10, 3), np.uint8), reference=path),
        lambda: image_size(path.read_bytes(), where="a message"),
    ):
        with pytest.raises(ImageError, match="has 16 bits a channel; divide its levels by 256, or by 16 or 4"):
            read()
