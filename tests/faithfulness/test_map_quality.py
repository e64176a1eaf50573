import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sliplens.faithfulness.controls import infidelity, max_sensitivity, relevance_mass, resolution, total_variation


def test_total_variation_has_its_closed_forms(rng: np.random.Generator):
    assert total_variation(np.ones((5, 5))) == 0
    ramp = np.tile(np.arange(11.0), (11, 1))
    assert total_variation(ramp) == pytest.approx((0.1 + 0) / 2)  # a tenth of the range across, nothing down
    # two independent even numbers differ by 1/3 on average, with a standard deviation of 1/sqrt(18); neighbours share
    # numbers, so four standard errors are doubled
    noise = total_variation(rng.uniform(size=(100, 100)))
    assert noise == pytest.approx(1 / 3, abs=8 / np.sqrt(18 * 2 * 9900) + 0.001)
    assert total_variation(7 * ramp - 3) == pytest.approx(total_variation(ramp))


@pytest.mark.parametrize("spread", [2.0, 5.0, 40.0])
def test_blobs_are_told_apart_as_far_as_they_are_narrow(spread: float):
    rows, columns = np.indices((60, 80))
    markers = np.array([[30.0, 30.0], [46.0, 30.0]])
    square = [(columns - x) ** 2 + (rows - y) ** 2 for x, y in markers]
    saliency = np.exp(-np.stack(square) / (2 * spread**2)).sum(axis=0)
    # two Gaussians 16 px apart: in the middle 2 exp(-32 / s^2), at a centre 1 + exp(-128 / s^2)
    expected = 1 - 2 * np.exp(-32 / spread**2) / (1 + np.exp(-128 / spread**2))
    # the highest of a third of the way is the centre itself, or a little beside it for wide blobs
    assert resolution(saliency, markers) == pytest.approx(max(expected, 0), abs=0.02)


def test_resolution_needs_relevance():
    assert np.isnan(resolution(np.zeros((9, 9)), np.array([[1.0, 1.0], [5.0, 5.0]])))
    assert resolution(np.ones((9, 9)), np.array([[1.0, 1.0], [5.0, 5.0]])) == 0


@pytest.mark.parametrize("colours", [3, 6])
def test_infidelity_has_its_closed_forms(colours: int):
    generator = torch.Generator().manual_seed(0)
    images, references = torch.rand(2, 2, colours, 5, 5, generator=generator)
    references[:, 3:] = images[:, 3:]  # the reference beside the frame stays
    weights = torch.rand(colours, 5, 5, generator=generator)
    exact = (weights * (images - references)).sum(dim=1)

    def infidelities(relevance: torch.Tensor) -> np.ndarray:
        return infidelity(
            lambda values: (weights * values).sum(dim=(1, 2, 3)), images, references, relevance, samples=4000
        )

    np.testing.assert_allclose(infidelities(exact), 0, atol=1e-5)  # the map of a linear network is exact
    # each pixel is gone with probability 1/2: mean square of a sum of coins, whose standard error is below 4 %
    expected = (exact.sum(dim=(1, 2)) ** 2 + (exact**2).sum(dim=(1, 2))) / 4
    np.testing.assert_allclose(infidelities(torch.zeros_like(exact)) ** 2, expected, rtol=0.15)


def test_max_sensitivity_has_its_closed_forms():
    images = torch.full((2, 3, 4, 4), 0.5)
    assert not max_sensitivity(lambda values: torch.ones(len(values), 4, 4), images).any()
    largest = max_sensitivity(lambda values: values.mean(dim=1), images, radius=0.02, samples=20)
    assert (largest > 0).all()
    assert (largest <= 0.02 / 0.5).all()


@pytest.fixture
def truth() -> np.ndarray:
    inside = np.zeros((8, 10), dtype=bool)
    inside[2:5, 3:7] = True
    return inside


def test_a_map_of_the_truth_has_all_its_mass_inside(truth: np.ndarray):
    assert relevance_mass(truth.astype(float), truth) == 1
    assert relevance_mass((~truth).astype(float), truth) == 0


@given(st.integers(0, 1000))
def test_a_map_that_knows_nothing_has_the_share_of_the_truth(seed: int):
    rng = np.random.default_rng(seed)
    truth = rng.uniform(size=(30, 30)) < 0.3
    flat = np.ones((30, 30))
    assert relevance_mass(flat, truth) == pytest.approx(truth.mean())


def test_a_map_of_zeros_has_no_mass(truth: np.ndarray):
    assert np.isnan(relevance_mass(np.zeros((8, 10)), truth))
