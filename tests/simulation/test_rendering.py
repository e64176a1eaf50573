"""Laws of the noise of frames."""

import numpy as np
import pytest

from sliplens.simulation import CHROMATOUCH, FLAT_GEL
from sliplens.simulation.sensor import mix_noise, pick_noise

FRAMES, SIZE = 400, 64


@pytest.fixture(scope="module", params=[CHROMATOUCH.noise, FLAT_GEL.noise], ids=["chromatouch", "flat-gel"])
def noise(request):
    return request.param


@pytest.fixture(scope="module")
def mixed(noise):
    picks = pick_noise(FRAMES, rng=np.random.default_rng(0))
    return mix_noise(picks, noise=noise, image_size_px=SIZE).numpy()


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
