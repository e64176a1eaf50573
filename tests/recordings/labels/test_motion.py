import numpy as np
import pytest

from sliplens.images import soften
from sliplens.recordings.labels.lag import measure_motion


@pytest.mark.parametrize("size", [(224, 224), (480, 640), (61, 83), (20, 16)])
def test_blocks_are_means(rng: np.random.Generator, size: tuple[int, int]):
    frame = rng.integers(0, 256, (*size, 3), dtype=np.uint8)
    soft = soften(frame)
    side = max(1, min(size) // 28)
    assert soft.shape == (size[0] // side, size[1] // side, 3)
    last = soft.shape[0] - 1, soft.shape[1] - 1
    for row, column in ((0, 0), last):
        block = frame[row * side : (row + 1) * side, column * side : (column + 1) * side]
        np.testing.assert_allclose(soft[row, column], block.mean(axis=(0, 1)), rtol=1e-5)


def test_a_still_image_does_not_move_and_a_brighter_one_moves_by_its_levels(rng: np.random.Generator):
    frame = rng.integers(0, 200, (64, 64, 3), dtype=np.uint8)
    np.testing.assert_allclose(measure_motion(map(soften, [frame, frame, frame + 7])), [0, 0, 7], rtol=1e-4)
