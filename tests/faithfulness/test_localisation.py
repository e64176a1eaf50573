import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplens.errors import InputError, SaliencyError
from sliplens.faithfulness.controls import relevance_mass


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


def test_what_cannot_be_localised_is_refused(truth: np.ndarray):
    with pytest.raises(InputError, match="the truth is nowhere"):
        relevance_mass(np.ones((8, 10)), np.zeros((8, 10), dtype=bool))
    with pytest.raises(InputError, match="without negative values"):
        relevance_mass(-np.ones((8, 10)), truth)
    with pytest.raises(SaliencyError, match=r"the map has shape \(3, 3\) but its image is 8 x 10"):
        relevance_mass(np.ones((3, 3)), truth)
    assert np.isnan(relevance_mass(np.zeros((8, 10)), truth))
