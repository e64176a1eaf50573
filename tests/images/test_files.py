from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sliplens.errors import ImageError, InputError
from sliplens.images import decode_png, encode_png, list_images, read_image, write_png


def save(path: Path, pixels: np.ndarray) -> Path:
    Image.fromarray(pixels).save(path)
    return path


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".bmp"])
def test_lossless_files_give_back_their_pixels(tmp_path: Path, rng: np.random.Generator, suffix: str):
    pixels = rng.integers(0, 256, (5, 7, 3), dtype=np.uint8)
    np.testing.assert_array_equal(read_image(save(tmp_path / f"a{suffix}", pixels)), pixels)


def test_png_in_memory_gives_back_its_pixels(rng: np.random.Generator):
    pixels = rng.integers(0, 256, (5, 7, 3), dtype=np.uint8)
    np.testing.assert_array_equal(decode_png(encode_png(pixels), where="a"), pixels)


def test_a_missing_image_is_refused(tmp_path: Path):
    with pytest.raises(ImageError, match=r"nothing\.png does not exist; check the path"):
        read_image(tmp_path / "nothing.png")


def test_an_image_of_another_size_is_refused(tmp_path: Path):
    path = save(tmp_path / "a.png", np.zeros((5, 7, 3), np.uint8))
    with pytest.raises(ImageError, match=r"a\.png is 5 x 7 pixels, 4 x 4 are needed"):
        read_image(path, size=(4, 4))


def test_an_image_with_one_channel_is_refused(tmp_path: Path):
    path = save(tmp_path / "a.png", np.zeros((5, 7), np.uint8))
    with pytest.raises(ImageError, match=r"a\.png has 1 channel \(grey\); convert it to 8-bit RGB"):
        read_image(path)


def test_an_image_with_four_channels_is_refused(tmp_path: Path):
    path = save(tmp_path / "a.png", np.zeros((5, 7, 4), np.uint8))
    with pytest.raises(ImageError, match=r"a\.png has 4 channels \(alpha\); drop the alpha channel"):
        read_image(path)


def test_a_16_bit_tiff_is_refused(tmp_path: Path):
    path = save(tmp_path / "a.tiff", np.full((5, 7), 40_000, np.uint16))
    with pytest.raises(ImageError, match=r"a\.tiff has 16 bits a pixel; convert it to 8-bit RGB"):
        read_image(path)


def test_a_truncated_png_is_refused(tmp_path: Path, rng: np.random.Generator):
    path = save(tmp_path / "a.png", rng.integers(0, 256, (64, 64, 3), dtype=np.uint8))
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(ImageError, match=r"a\.png cannot be read as an image .*; copy or export it again"):
        read_image(path)


def test_a_text_file_is_no_image(tmp_path: Path):
    (tmp_path / "a.png").write_text("hello")
    with pytest.raises(ImageError, match=r"a\.png cannot be read as an image"):
        read_image(tmp_path / "a.png")


def test_images_are_listed_in_natural_order(tmp_path: Path):
    for name in ("frame10.png", "frame2.png", "frame1.PNG", "notes.txt"):
        write_png(tmp_path / name, np.zeros((2, 2, 3), np.uint8)) if name[-3:] != "txt" else (tmp_path / name).touch()
    assert [path.name for path in list_images(tmp_path)] == ["frame1.PNG", "frame2.png", "frame10.png"]


def test_a_missing_folder_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match=r"the image folder .*nothing does not exist; check the path"):
        list_images(tmp_path / "nothing")


def test_a_file_instead_of_a_folder_is_refused(tmp_path: Path):
    (tmp_path / "a").touch()
    with pytest.raises(InputError, match=r"the image folder .*a is a file, not a folder"):
        list_images(tmp_path / "a")


def test_a_folder_without_images_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match=r"holds no image \(looked for "):
        list_images(tmp_path)
