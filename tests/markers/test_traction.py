"""Traction of synthetic domes whose fields obey the law that the model assumes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplens.errors import InputError
from sliplens.markers import calibrate_traction

PLACES = np.stack(np.meshgrid(np.arange(-2, 3) * 20.0, np.arange(-2, 3) * 20.0), axis=-1).reshape(-1, 2)
BELL = np.exp(-((np.linalg.norm(PLACES, axis=1) / 60) ** 2))[:, None]
FIVE = np.array([[0.0, 0, 10], [0.4, 0, 1], [-0.4, 0, 1], [0, 0.4, 1], [0, -0.4, 1]])


def fields(force_n: np.ndarray) -> np.ndarray:
    """Displacements: a bell of shear along turned axes, and a spread by Hertz's law."""
    turned = force_n[:, :2] @ np.array([[0.8, 0.6], [-0.6, 0.8]])
    return turned[:, None] * BELL + 0.01 * force_n[:, 2, None, None] ** (2 / 3) * PLACES


@given(x=st.floats(-0.6, 0.6), y=st.floats(-0.6, 0.6), load_n=st.floats(0.5, 30))
def test_five_known_loads_calibrate_the_traction_of_any_other(x, y, load_n):
    force = np.array([[x * load_n, y * load_n, load_n]])
    model = calibrate_traction(fields(FIVE), FIVE)
    for measured in (model.measure(fields(force)), model.measure(fields(force), force[:, 2])):
        np.testing.assert_allclose(measured.vector, [[x, y]], atol=1e-3)
        np.testing.assert_allclose(measured.normal_n, load_n, rtol=2e-3)
        np.testing.assert_allclose(measured.ratio, np.hypot(x, y), atol=1e-3)
    if np.hypot(x, y) > 0.1:
        assert abs((measured.direction_deg[0] - np.degrees(np.arctan2(y, x)) + 180) % 360 - 180) < 1


def test_markers_that_are_lost_change_little_and_too_few_give_no_traction(rng: np.random.Generator):
    model = calibrate_traction(fields(FIVE) + rng.normal(0, 0.01, (5, 25, 2)), FIVE)
    moved = np.repeat(fields(np.array([[1.5, 0.5, 5.0]])), 2, axis=0)
    moved[0, ::3], moved[1, 4:] = np.nan, np.nan
    vector = model.measure(moved).vector
    np.testing.assert_allclose(vector[0], [0.3, 0.1], atol=0.03)
    assert np.isnan(vector[1]).all()


def test_no_load_is_so_small_that_the_contact_could_not_carry_its_shear():
    model = calibrate_traction(fields(FIVE), FIVE)
    assert model.measure(fields(np.array([[2.0, 0, 0.01]]))).ratio == pytest.approx([1.0])


@pytest.mark.parametrize(
    ("moved", "force", "words"),
    [
        (fields(FIVE), FIVE[:3], "5 fields but 3 forces"),
        (fields(FIVE)[:2], FIVE[:2], "2 states of 25 markers"),
        (fields(FIVE), FIVE * [1, 1, 0], "above 0 N"),
        (fields(FIVE), FIVE * [1, 0, 1], "do not shear in two directions"),
    ],
)
def test_states_that_cannot_be_calibrated_are_refused(moved, force, words):
    with pytest.raises(InputError, match=words):
        calibrate_traction(moved, force)


def test_fields_of_other_markers_and_loads_without_contact_are_refused():
    model = calibrate_traction(fields(FIVE), FIVE)
    with pytest.raises(InputError, match="has 9 markers, the calibration 25"):
        model.measure(fields(FIVE)[:, :9])
    with pytest.raises(InputError, match="must be positive"):
        model.measure(fields(FIVE), np.zeros(5))
