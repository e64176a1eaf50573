from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from readers import read_image_folder, refused

from sliplens.errors import ImageError
from sliplens.images import write_png
from sliplens.recordings.source import open_source


@pytest.fixture
def frames(rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, 256, (12, 20, 30, 3), dtype=np.uint8)


@pytest.fixture
def folder(tmp_path: Path, frames: np.ndarray) -> Path:
    """Twelve lossless frames whose names do not sort as text."""
    folder = tmp_path / "trial 7"
    folder.mkdir()
    for index, frame in enumerate(frames):
        suffix = ("png", "tiff", "bmp")[index % 3]
        Image.fromarray(frame).save(folder / f"image_{index + 1}.{suffix}")
    return folder


def test_frames_come_in_natural_order(folder: Path, frames: np.ndarray):
    capture = read_image_folder(folder, frame_rate=30.0)
    np.testing.assert_array_equal(list(capture.read_frames()), frames)
    np.testing.assert_allclose(capture.frame_time_s, np.arange(12) / 30)
    assert (capture.trial, capture.frame_size, capture.forces) == ("trial-7", (20, 30), None)
    assert capture.notes == ("trial 7: frames were declared to be taken 30 times a second.",)


def test_a_table_of_times_orders_the_frames(folder: Path, frames: np.ndarray, tmp_path: Path):
    rows = [f"C:\\camera\\{path.name},{10 - 0.1 * int(path.stem[6:])}" for path in folder.iterdir()]
    table = tmp_path / "times.csv"
    table.write_text("\n".join(["file,time_s", *rows, "image_99.png,0"]))
    capture = read_image_folder(folder, times=table)
    np.testing.assert_array_equal(list(capture.read_frames()), frames[::-1])
    np.testing.assert_allclose(capture.frame_time_s, 8.8 + 0.1 * np.arange(12))
    assert capture.notes == (
        "times.csv: times of images are those of column 'time_s', in s (by its name), their names those of 'file'.",
        "times.csv: 1 of 13 rows name no image of the folder.",
    )


def test_names_may_lack_their_ending(folder: Path, tmp_path: Path):
    table = tmp_path / "times.csv"
    table.write_text("image;stamp [ms]\n" + "".join(f"image_{number};{number},5\n" for number in range(1, 13)))
    np.testing.assert_allclose(read_image_folder(folder, times=table).frame_time_s, (np.arange(1, 13) + 0.5) * 1e-3)


def test_times_must_be_given_in_one_way(folder: Path):
    refused(lambda path: open_source(path, whole=True), folder, "trial 7 have no times; give --times or --fram")
    refused(read_image_folder, folder, "two sources of times", frame_rate=30.0, times=folder / "times.csv")
    for rate in (0.0, -8.0, float("nan"), float("inf")):
        refused(read_image_folder, folder, f"a frame rate of {rate} frames/s cannot be", frame_rate=rate)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("file,time_s\nimage_1.png,0\n", "has no time for image_2.tiff; add a row"),
        ("file,time_s\nimage_1.png,0\nimage_1.png,1\n", "line 3 names 'image_1.png' again"),
        ("file,time_s\n" + "".join(f"image_{number},0\n" for number in range(1, 13)), "'time_s' repeats"),
        ("file,time_s\nimage_1.png,soon\n", "line 2, 'time_s' is 'soon', not a finite number"),
        ("who,time_s\nimage_1.png,0\n", "no column with the names of images among 'who', 'time_s'; call it file"),
    ],
)
def test_a_table_of_times_that_cannot_be_trusted_is_refused(folder: Path, tmp_path: Path, text: str, message: str):
    table = tmp_path / "times.csv"
    table.write_text(text)
    refused(read_image_folder, folder, message, times=table)


def test_frames_of_two_sizes_are_refused(folder: Path, frames: np.ndarray):
    write_png(folder / "image_5.png", frames[0, :10])
    refused(read_image_folder, folder, r"image_5\.png is 30 x 10 pixels but image_1\.png is 30 x 20", frame_rate=30.0)


def test_damaged_images_are_refused(folder: Path):
    first = folder / "image_1.png"
    whole = first.read_bytes()
    first.write_bytes(whole[:200])
    capture = read_image_folder(folder, frame_rate=30.0)
    with pytest.raises(ImageError, match=r"image_1\.png cannot be read as an image"):
        list(capture.read_frames())
    absurd = whole[:16] + (30_000).to_bytes(4, "big") * 2 + whole[24:]  # width and height of the header
    for data in (b"no image", absurd):
        first.write_bytes(data)
        with pytest.raises(ImageError, match=r"image_1\.png cannot be read as an image"):
            read_image_folder(folder, frame_rate=30.0)


def test_several_images_in_a_file_are_refused(folder: Path, frames: np.ndarray):
    pages = [Image.fromarray(frame) for frame in frames[:3]]
    pages[0].save(folder / "image_2.tiff", save_all=True, append_images=pages[1:])
    with pytest.raises(ImageError, match=r"image_2\.tiff holds 3 images; save one image a file"):
        read_image_folder(folder, frame_rate=30.0)
