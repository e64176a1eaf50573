"""Drawing: how patches meet the frame, and what the noise is like."""

import numpy as np
import pytest
import torch

from sliplens.simulation import CHROMATOUCH, FLAT_GEL
from sliplens.simulation.filming import place
from sliplens.simulation.sensor import mix_noise, pick_noise

FRAMES, SIZE = 400, 64


@pytest.fixture
def patches():
    generator = torch.Generator().manual_seed(3)
    patch = torch.rand((3, 40, 5, 5), generator=generator)
    corner = torch.randint(0, 20 - 5 + 1, (40, 2), generator=generator)
    return patch, corner, np.repeat(np.arange(4), 10)


def test_a_processor_and_a_gpu_add_patches_to_the_same_places(patches):
    patch, corner, frame = patches
    naive = torch.zeros((3, 4, 20, 20))
    slow, fast = (
        place(patch, corner=corner, frame=frame, frames=4, size_px=20, at_once=at_once) for at_once in (True, False)
    )
    for item, (column, row) in enumerate(corner.tolist()):
        for y in range(5):
            for x in range(5):
                naive[:, frame[item], row + y, column + x] += patch[:, item, y, x]
    # ten patches a frame overlap: sums of a few numbers below 1 in another order
    torch.testing.assert_close(slow, naive, atol=1e-5, rtol=0)
    torch.testing.assert_close(fast, naive, atol=1e-5, rtol=0)


@pytest.fixture(scope="module", params=[CHROMATOUCH.noise, FLAT_GEL.noise], ids=["chromatouch", "flat-gel"])
def noise(request):
    return request.param


@pytest.fixture(scope="module")
def mixed(noise):
    picks = pick_noise(FRAMES, rng=np.random.default_rng(0))
    return mix_noise(picks, noise=noise, image_size_px=SIZE, device="cpu").numpy()


def test_neighbours_and_colours_share_the_noise_they_should(noise, mixed):
    def correlation(one, other):
        return float(np.mean(one * other))

    weight = noise.smoothness
    for axis in (2, 3):
        ahead, behind = (np.take(mixed, range(*ends), axis=axis) for ends in ((1, SIZE), (0, SIZE - 1)))
        # the moving average 1, w has this correlation at lag 1, and none beyond
        assert correlation(ahead[2], behind[2]) == pytest.approx(weight / (1 + weight**2), abs=0.01)
    assert correlation(mixed[2, :, 2:], mixed[2, :, :-2]) == pytest.approx(0, abs=0.01)
    assert correlation(mixed[0], mixed[1]) == pytest.approx(noise.red_in_green, abs=0.01)
    assert correlation(mixed[0], mixed[2]) == pytest.approx(0, abs=0.01)
