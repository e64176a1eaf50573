import numpy as np
import pytest
from hypothesis import given
from hypothesis.extra.numpy import arrays

from sliplens import images
from sliplens.errors import ImageError
from sliplens.images import absolute_difference, shrink

PIXELS = arrays(np.uint8, (4, 5, 3))


@given(PIXELS, PIXELS)
def test_difference_is_the_absolute_difference_of_integers(frame: np.ndarray, reference: np.ndarray):
    expected = np.abs(frame.astype(int) - reference.astype(int))
    np.testing.assert_array_equal(absolute_difference(frame, reference), expected)
    np.testing.assert_array_equal(absolute_difference(reference, frame), expected)


def test_a_reference_of_another_size_is_refused():
    with pytest.raises(ImageError, match=r"frame of 4 x 4 pixels against a reference of 5 x 4"):
        absolute_difference(np.zeros((4, 4, 3), np.uint8), np.zeros((5, 4, 3), np.uint8))


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_shrinking_gives_the_means_of_blocks_with_opencv_and_without(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, factor: int
):
    image = rng.integers(0, 256, (13, 17, 3), dtype=np.uint8)
    rows, columns = 13 // factor, 17 // factor
    blocks = image[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor, 3).mean(axis=(1, 3))
    assert np.abs(shrink(image, factor) - blocks).max() <= 0.5 + 1e-6
    monkeypatch.setattr(images, "missing_packages", lambda *_, **__: "none")
    assert np.abs(shrink(image, factor) - blocks).max() <= 1  # Pillow rounds in fixed point
