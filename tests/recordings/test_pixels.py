"""Images in a trial's file: nothing is lost, and damage is told."""

from itertools import product

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from sliplens.errors import RecordingError
from sliplens.recordings.store import decode_pixels, encode_pixels

shapes = st.one_of(
    arrays.array_shapes(min_dims=2, max_dims=2), st.tuples(st.integers(1, 9), st.integers(1, 9), st.just(3))
)


@given(shapes.flatmap(lambda shape: arrays.arrays(np.uint8, shape)))
def test_every_image_comes_back_as_it_was(image):
    np.testing.assert_array_equal(decode_pixels(encode_pixels(image), size=image.shape, where="it"), image)


def test_anything_that_knows_zstandard_can_undo_it(rng: np.random.Generator):
    image = rng.integers(0, 256, (5, 7, 3), dtype=np.uint8)
    rows = np.frombuffer(pa.decompress(encode_pixels(image), decompressed_size=105, codec="zstd"), np.uint8)
    slow = np.zeros((5, 7, 3), dtype=int)
    for row, left in enumerate(rows.reshape(5, 7, 3).astype(int)):
        slow[row] = (left + (slow[row - 1] if row else 0)) % 256
    np.testing.assert_array_equal(slow, image)


@pytest.mark.parametrize(
    ("damage", "size"),
    [
        *product([lambda data: data[:-5], lambda _: b"nonsense", lambda _: b""], [(5, 7, 3), (50, 7, 3)]),
        *product([lambda data: data], [(5, 7), (50, 7, 3), (2000, 2000, 3)]),
    ],
)
def test_damaged_bytes_and_another_size_are_refused(damage, size, rng: np.random.Generator):
    data = encode_pixels(rng.integers(0, 256, (5, 7, 3), dtype=np.uint8))
    with pytest.raises(RecordingError, match=r"frame 3 of a\.parquet .*make the data set again"):
        decode_pixels(damage(data), size=size, where="frame 3 of a.parquet")
