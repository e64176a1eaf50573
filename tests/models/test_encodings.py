import numpy as np
import pytest
import torch
from torch.nn import functional

from sliplens.errors import ImageError
from sliplens.models.encodings import ENCODINGS


@pytest.fixture
def frames(rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, 200, (3, 16, 16, 3), dtype=np.uint8)


@pytest.mark.parametrize("name", [name for name, encoding in ENCODINGS.items() if encoding.own_maximum])
def test_an_image_divided_by_its_own_maximum_spans_up_to_one(name: str, frames: np.ndarray):
    encoded = ENCODINGS[name].encode(frames, np.zeros_like(frames[0]), image_size=8)
    assert encoded.shape == (3, 3, 8, 8)
    torch.testing.assert_close(encoded.amax(dim=(1, 2, 3)), torch.ones(3))
    assert encoded.min() >= 0


def empty(name: str, reference: np.ndarray) -> torch.Tensor:
    return ENCODINGS[name].encode(reference[None], reference, image_size=reference.shape[0])[0]


def test_the_untouched_sensor_is_black_as_a_difference_and_itself_as_a_raw_frame(frames: np.ndarray):
    assert not empty("difference", frames[0]).any()
    expected = torch.from_numpy(frames[0]).permute(2, 0, 1) / frames[0].max()
    torch.testing.assert_close(empty("raw", frames[0]), expected)


def test_a_pair_is_the_frame_and_beside_it_the_untouched_sensor(frames: np.ndarray):
    reference = frames[::-1][0]
    seen = ENCODINGS["pair"].encode(frames, reference, image_size=16)
    torch.testing.assert_close(seen[:, :3], torch.from_numpy(frames).permute(0, 3, 1, 2) / 255)
    untouched = empty("pair", reference)
    assert torch.equal(untouched[:3], untouched[3:])
    assert torch.equal(seen[:, 3:], untouched[3:].expand(3, -1, -1, -1))


def test_frame_and_untouched_sensor_are_made_small_as_one_image_of_six_channels(rng: np.random.Generator):
    *frames, reference = rng.integers(0, 256, (4, 30, 41, 3), dtype=np.uint8)
    reference.flags.writeable = False  # as an image that Pillow holds; torch warns of such memory
    six = np.stack([np.concatenate([frame, reference], axis=-1) for frame in frames])
    whole = functional.interpolate(
        torch.from_numpy(six).permute(0, 3, 1, 2), size=(17, 17), mode="bilinear", antialias=True
    )
    assert torch.equal(ENCODINGS["pair"].compare_small(np.stack(frames), reference, image_size=17), whole)


def test_halving_the_size_averages_neighbours_in_the_middle(frames: np.ndarray):
    # a tent of half-width 2 on a ratio of 2: weights 1/8, 3/8, 3/8, 1/8 in each direction
    resized = ENCODINGS["raw"].resize(frames, image_size=8)[0, 1, 3, 4].item()
    weights = np.array([1, 3, 3, 1]) / 8
    patch = frames[0, 5:9, 7:11, 1].astype(float)
    assert abs(resized - weights @ patch @ weights) <= 1  # each way is rounded to whole levels


def test_frames_of_another_size_than_the_reference_are_refused(frames: np.ndarray):
    for encoding in ENCODINGS.values():
        with pytest.raises(ImageError, match="against a reference of 8 x 16"):
            encoding.encode(frames, frames[0, :8], image_size=8)


def test_a_signed_difference_tells_up_from_down_and_leaves_equal_pixels_alone(rng: np.random.Generator):
    reference = rng.integers(0, 256, (8, 8, 3), dtype=np.uint8)
    frame = rng.integers(0, 256, (8, 8, 3), dtype=np.uint8)
    encoding = ENCODINGS["signed"]
    untouched = empty("signed", reference)
    torch.testing.assert_close(untouched, torch.full_like(untouched, encoding.neutral))
    told = encoding.encode(frame[None], reference, image_size=8)[0].permute(1, 2, 0).numpy()
    true = (frame.astype(float) - reference) / 2 / 255 + 128 / 255
    # each of the two images is halved and rounded down: at most half a step apart
    np.testing.assert_allclose(told, true, atol=0.5 / 255 + 1e-6)
