"""Whatever `predict` opens, `explain` opens: the same frames give the same answers, or one sentence says the cure."""

import pickle
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from command_line import refused, typed
from own_recording import write_frames, write_images
from ros_bags import CAMERA, raw_image, write_bag

import sliplens as sl
from sliplens.errors import InputError
from sliplens.images import write_png
from sliplens.recordings.source import open_source
from sliplens.results.explanation import load_explanation

NETWORK = "chromatouch-pair"
SENTENCES = r"sliplens takes 8-bit RGB \(uint8\); |give RGB images"
TIMES_NS = range(10**18, 10**18 + 120_000_000, 40_000_000)
"""A frame each 40 ms."""


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    """Three frames of the network's size."""
    return np.random.default_rng(3).integers(90, 160, (3, 224, 224, 3), dtype=np.uint8)


def write(path: Path, frames: np.ndarray) -> Path:
    """Write frames as what the path's suffix names; a folder of images where it has none."""
    if path.suffix == ".npy":
        np.save(path, frames)
    elif path.suffix == ".npz":
        np.savez(path, frames=frames, other=np.zeros(2))
    elif path.suffix == ".png":
        write_png(path, frames[1])
    elif path.suffix == ".mkv":
        write_frames(path, frames)
    elif path.name == "bag":
        write_bag(path, [(CAMERA, raw_image(frame, at), at) for at, frame in zip(TIMES_NS, frames, strict=True)])
    else:
        write_images(path, frames)
    return path


IN_MEMORY: dict[str, Callable[[np.ndarray], object]] = {
    "array": lambda frames: frames,
    "one image": lambda frames: frames[1],
    "list": list,
    "tensor": torch.tensor,
    "tensor, colours first": lambda frames: torch.tensor(frames).permute(0, 3, 1, 2),
}
FILES = ("frames", "a.png", "a.npy", "a.npz", "a.mkv", "bag")
REFUSED: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "floats in [0, 1]": lambda frames: frames / np.float32(255),
    "grey": lambda frames: frames[..., 0],
    "16 bits": lambda frames: frames.astype(np.uint16) * 256,
}


@pytest.mark.parametrize("kind", [*IN_MEMORY, *FILES])
def test_predict_and_explain_see_the_same_frames(kind: str, frames: np.ndarray, tmp_path: Path):
    source = IN_MEMORY[kind](frames) if kind in IN_MEMORY else write(tmp_path / kind, frames)
    expected, predicted = (
        sl.predict(NETWORK, images, reference=reference).to_arrow()["prediction"].to_numpy()
        for images, reference in ((frames, frames[1]), (source, torch.tensor(frames[1])))
    )
    np.testing.assert_allclose(predicted, expected if len(predicted) == 3 else expected[1:2], atol=1e-5)
    finite = np.isfinite(predicted)  # the untouched frame at least; noise is withheld
    assert finite.any()
    explanation = sl.explain(NETWORK, source, reference=frames[1], method="grad-cam", baseline=torch.tensor(frames[1]))
    explained = [frame.prediction for frame in explanation.frames]
    np.testing.assert_allclose(np.array(explained)[finite], predicted[finite], atol=1e-5)
    withheld = [frame.id for frame in explanation.frames if frame.withheld is not None]
    warnings = [text for text in explanation.methods["grad-cam"].warnings if "the prediction is withheld" in text]
    assert len(warnings) == bool(withheld)
    assert all(name in warnings[0] for name in withheld)
    if kind in FILES:  # and so do the commands
        words = NETWORK, source, "--reference", write(tmp_path / "untouched.png", frames)
        typed("predict", *words, "-o", tmp_path / "margins.parquet")
        typed("explain", *words, "--method", "grad-cam", "-o", tmp_path / "maps")
        np.testing.assert_array_equal(pq.read_table(tmp_path / "margins.parquet")["prediction"].to_numpy(), predicted)
        maps = load_explanation(tmp_path / "maps")
        np.testing.assert_allclose([frame.prediction for frame in maps.frames], explained, atol=1e-6)


@pytest.mark.parametrize("call", [sl.predict, sl.explain])
@pytest.mark.parametrize("kind", REFUSED)
def test_levels_and_layouts_that_may_mean_two_things_are_refused(
    call: Callable, kind: str, frames: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    images = REFUSED[kind](frames)
    # three grey frames in a tensor are one image, colours first
    for source in (images, torch.tensor(images)) if images.ndim == 4 else (images,):
        with pytest.raises(InputError, match=SENTENCES):
            call(NETWORK, source, reference=frames[1])
    words = call.__name__, NETWORK, write(tmp_path / "a.npy", images), "-o", tmp_path / "out.csv"
    assert re.search(SENTENCES, refused(capsys, *words))
    assert [*tmp_path.iterdir()] == [tmp_path / "a.npy"]


@pytest.mark.parametrize("junk", [[], {}, 3.5, ["frames"], np.zeros(4, dtype=np.uint8), [np.zeros((4, 4, 3))]])
def test_what_is_no_image_is_refused(junk: object):
    with pytest.raises(InputError):
        open_source(junk)  # pyright: ignore[reportArgumentType]


def test_a_list_of_two_sizes_is_refused(frames: np.ndarray):
    with pytest.raises(InputError, match="different sizes, such as 100 x 224 and 224 x 224 pixels"):
        open_source([frames[0], frames[0, :100]])


class _Trap:
    def __reduce__(self) -> tuple:
        return pytest.fail, ("a pickle was opened",)


@pytest.mark.parametrize("suffix", [".npy", ".npz"])
@pytest.mark.parametrize("damage", ["empty", "cut", "pickle", "noise"])
def test_damaged_arrays_are_refused(tmp_path: Path, frames: np.ndarray, suffix: str, damage: str):
    path = write(tmp_path / f"a{suffix}", frames)
    whole = path.read_bytes()
    data = {"empty": b"", "cut": whole[: len(whole) // 2], "pickle": pickle.dumps(_Trap()), "noise": b"x" * 500}[damage]
    path.write_bytes(data)
    with pytest.raises(InputError, match="cannot be read as a NumPy array"):
        open_source(path)


def test_frames_without_a_contact_have_no_margin_in_the_summary(frames: np.ndarray):
    dark = np.zeros_like(frames)
    assert "nothing touches the sensor" in sl.predict(NETWORK, dark, reference=dark[0]).summary
    assert "median" in sl.predict(NETWORK, frames, reference=frames[1]).summary
