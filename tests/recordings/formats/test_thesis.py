from pathlib import Path

import numpy as np
import pytest
from readers import read_thesis, refused
from there import there

from sliplens.images import write_png
from sliplens.recordings.capture import Capture

HOME = "/home/training-pc/Data/november/"


@pytest.fixture
def images(tmp_path: Path, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Two trials of frames on disk, by their paths under the data folder."""
    images = {}
    for trial in ("trial77", "trial83"):
        (tmp_path / "data" / trial / "L").mkdir(parents=True)
        for number in (0, 9, 10, 51):
            name = f"{trial}/L/image_{number}.tiff"
            images[name] = rng.integers(0, 256, (16, 16, 3), dtype=np.uint8)
            write_png(tmp_path / "data" / name, images[name])
    return images


def write_lists(folder: Path, frames: list[str], references: list[str], margins: list[str]) -> Path:
    folder.mkdir(exist_ok=True)
    for ending, lines in (("images_L.txt", frames), ("images_Lref.txt", references), ("gamma.csv", margins)):
        (folder / f"train_dataset_{ending}").write_text("\n".join(lines) + "\n")
    return folder / "train_dataset_images_L.txt"


FRAMES = [f"trial77/L/image_{number}.tiff" for number in (9, 10, 51)]
REFERENCE = ["trial77/L/image_0.tiff"] * 3
MARGINS = ["1.0", "0.6", "0.2"]


def margins_of(capture: Capture) -> np.ndarray:
    return there(capture.labels).safety_margin


@pytest.fixture
def data(tmp_path: Path, images: dict[str, np.ndarray]) -> Path:
    return tmp_path / "data"


def test_the_lists_of_the_thesis_give_frames_reference_and_margins(data: Path, images: dict[str, np.ndarray]):
    (trial,) = read_thesis(write_lists(data, FRAMES, REFERENCE, MARGINS))
    np.testing.assert_array_equal(list(trial.read_frames()), [images[name] for name in FRAMES])
    np.testing.assert_array_equal(there(trial.reference), images[REFERENCE[0]])
    np.testing.assert_array_equal(margins_of(trial), [1, 0.6, 0.2])
    assert (trial.trial, len(trial), trial.frame_size) == ("train_dataset", 3, (16, 16))
    assert trial.notes[0] == "train_dataset_gamma.csv: safety margins were read as fractions, by their size."


@pytest.mark.parametrize("prefix", [HOME, "C:\\Users\\max\\Data\\november\\", "D:/november/", "./", "november/"])
def test_paths_of_another_computer_are_found_under_the_root(
    data: Path, images: dict[str, np.ndarray], tmp_path: Path, prefix: str
):
    frames, references = ([prefix + name for name in names] for names in (FRAMES, REFERENCE))
    if "\\" in prefix:
        frames, references = ([name.replace("/", "\\") for name in names] for names in (frames, references))
    (trial,) = read_thesis(write_lists(tmp_path / "lists", frames, references, MARGINS), image_root=tmp_path / "data")
    np.testing.assert_array_equal(list(trial.read_frames()), [images[name] for name in FRAMES])


def test_relative_paths_start_at_the_list_and_stay_in_the_root(data: Path, tmp_path: Path):
    frames, references = ([f"../data/{name}" for name in names] for names in (FRAMES, REFERENCE))
    lists = write_lists(tmp_path / "lists", frames, references, MARGINS)
    assert len(read_thesis(lists, image_root=tmp_path)) == 1
    refused(read_thesis, lists, r"line 1: '\.\./data/trial77/L/image_0\.tiff' leads out of .*lists; give")


def test_each_reference_frame_makes_a_trial(data: Path, images: dict[str, np.ndarray]):
    other = [name.replace("trial77", "trial83") for name in FRAMES]
    mixed = [name for pair in zip(other, FRAMES, strict=True) for name in pair]
    references = ["trial83/L/image_0.tiff", "trial77/L/image_0.tiff"] * 3
    margins = ["0.9", "0.8", "0.7", "0.6", "0.5", "0.4"]
    trials = read_thesis(write_lists(data, mixed, references, margins))
    assert [trial.trial for trial in trials] == ["train_dataset-1", "train_dataset-2"]
    for trial, place in zip(trials, ("trial83", "trial77"), strict=True):
        np.testing.assert_array_equal(there(trial.reference), images[f"{place}/L/image_0.tiff"])
    np.testing.assert_array_equal(margins_of(trials[1]), [0.8, 0.6, 0.4])


def test_shuffled_frames_are_put_in_order_with_their_margins(data: Path, images: dict[str, np.ndarray]):
    order = [2, 0, 1]
    lists = write_lists(data, [FRAMES[at] for at in order], REFERENCE, [MARGINS[at] for at in order])
    (trial,) = read_thesis(lists)
    np.testing.assert_array_equal(list(trial.read_frames()), [images[name] for name in FRAMES])
    np.testing.assert_array_equal(margins_of(trial), [1, 0.6, 0.2])
    assert any("natural order" in note for note in trial.notes)


@pytest.mark.parametrize("lines", ["100 60 20", "gamma 1.0 0.6 0.2"])
def test_margins_are_read_in_percent_or_as_fractions(data: Path, lines: str):
    (trial,) = read_thesis(write_lists(data, FRAMES, REFERENCE, lines.split()))
    np.testing.assert_allclose(margins_of(trial), [1, 0.6, 0.2])


def test_the_folder_of_one_list_is_enough(data: Path):
    lists = write_lists(data, FRAMES, REFERENCE, MARGINS)
    assert len(read_thesis(data)[0]) == 3
    lists.with_name("test_images_L.txt").write_text("a\n")
    refused(read_thesis, data, r"has test_images_L\.txt, train_.* of the thesis; name the file that ends in _images_L")


@pytest.mark.parametrize(
    ("frames", "references", "margins", "message"),
    [
        (FRAMES, REFERENCE[:2], MARGINS, "has 3 frames, .* 2 references and train_dataset_gamma.csv 3 margins"),
        (FRAMES, REFERENCE, ["", ""], r"gamma\.csv is empty"),
        (FRAMES, REFERENCE, ["gamma"], "holds no safety margin"),
        (FRAMES, REFERENCE, ["1.0", "much", "0.2"], r"gamma\.csv, line 2 is 'much', not a safety margin"),
        (FRAMES, REFERENCE, ["1.2", "0.6", "0.2"], r"gamma\.csv: safety_margin of frame 0 is 1\.2, outside \[0, 1\]"),
        (FRAMES, REFERENCE, ["150", "0.6", "0.2"], r"safety_margin of frame 0 is 1\.5, outside"),
        (FRAMES, REFERENCE, ["nan", "nan", "nan"], "holds no safety margin"),
        ([*FRAMES[:2], "trial77/L/image_7.tiff"], REFERENCE, MARGINS, "L.txt, line 3: .* is not there, nor under"),
        ([*FRAMES[:2], FRAMES[0]], REFERENCE, MARGINS, "twice with one reference"),
        ([*FRAMES[:2], "../../etc/passwd"], REFERENCE, MARGINS, "line 3: .* leads out of"),
        ([*FRAMES[:2], "x" * 5000], REFERENCE, MARGINS, "line 3: .* is not there"),
        ([*FRAMES[:2], HOME + FRAMES[0]], REFERENCE, MARGINS, "twice with one reference; list it once"),
    ],
)
def test_lists_that_do_not_fit_are_refused(
    data: Path, frames: list[str], references: list[str], margins: list[str], message: str
):
    refused(read_thesis, write_lists(data, frames, references, margins), message)


def test_missing_and_binary_lists_are_refused(data: Path):
    lists = write_lists(data, FRAMES, REFERENCE, MARGINS)
    refused(read_thesis, data / "train_dataset_gamma.csv", "has no list of the thesis; name the file that ends in")
    (data / "train_dataset_images_Lref.txt").unlink()
    refused(read_thesis, lists, r"Lref\.txt does not exist; the lists of a set must lie in one folder")
    lists.write_bytes(b"\x00\xff\x00\xfe")
    refused(read_thesis, lists, "is not a text file")
