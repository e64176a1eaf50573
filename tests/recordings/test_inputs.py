"""Whatever `predict` opens, `explain` opens: the same frames give the same answers, or one sentence says the cure."""

import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from own_recording import write_images

import sliplens as sl
from sliplens.errors import InputError
from sliplens.images import write_png
from sliplens.recordings.source import open_source

NETWORK = "chromatouch-pair"


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
    else:
        write_images(path, frames)
    return path


TAKEN: dict[str, Callable[[np.ndarray, Path], object]] = {
    "array": lambda frames, _: frames,
    "one image": lambda frames, _: frames[1],
    "list": lambda frames, _: list(frames),
    "tensor": lambda frames, _: torch.tensor(frames),
    "tensor, colours first": lambda frames, _: torch.tensor(frames).permute(0, 3, 1, 2),
    "folder": lambda frames, path: write(path / "frames", frames),
    "image file": lambda frames, path: write(path / "a.png", frames),
    "npy": lambda frames, path: write(path / "a.npy", frames),
    "npz": lambda frames, path: write(path / "a.npz", frames),
}
REFUSED: dict[str, Callable[[np.ndarray], object]] = {
    "floats in [0, 1]": lambda frames: torch.tensor(frames) / 255,
    "grey": lambda frames: frames[..., 0],
    "16 bits": lambda frames: frames.astype(np.uint16) * 256,
}


@pytest.mark.parametrize("kind", TAKEN)
def test_predict_and_explain_see_the_same_frames(kind: str, frames: np.ndarray, tmp_path: Path):
    source = TAKEN[kind](frames, tmp_path)
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


@pytest.mark.parametrize("call", [sl.predict, sl.explain])
@pytest.mark.parametrize("kind", REFUSED)
def test_levels_and_layouts_that_may_mean_two_things_are_refused(call: Callable, kind: str, frames: np.ndarray):
    with pytest.raises(InputError, match=r"sliplens takes 8-bit RGB \(uint8\); |give RGB images"):
        call(NETWORK, REFUSED[kind](frames), reference=frames[1])


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
