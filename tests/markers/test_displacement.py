import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplens.errors import InputError
from sliplens.markers import interpolate_field

AFFINE = st.tuples(*[st.floats(-0.2, 0.2) for _ in range(4)])


@given(gradient=AFFINE, shift=st.tuples(st.floats(-5, 5), st.floats(-5, 5)))
def test_an_even_deformation_comes_back_exactly(gradient, shift):
    matrix = np.array(gradient).reshape(2, 2)
    places = np.random.default_rng(1).uniform(0, 100, (40, 2))
    field = interpolate_field(places, places @ matrix.T + shift, size=(100, 100))
    x, y = np.meshgrid(field.x_px, field.y_px)
    np.testing.assert_allclose(field.displacement_px, np.stack([x, y], axis=-1) @ matrix.T + shift, atol=1e-4)
    np.testing.assert_allclose(field.divergence, matrix[0, 0] + matrix[1, 1], atol=1e-5)
    np.testing.assert_allclose(field.curl, matrix[1, 0] - matrix[0, 1], atol=1e-5)
    shear = np.hypot(matrix[0, 0] - matrix[1, 1], matrix[0, 1] + matrix[1, 0])
    np.testing.assert_allclose(field.shear, shear, atol=1e-5)


@given(angle=st.floats(0, np.pi))
def test_divergence_curl_and_shear_do_not_depend_on_the_axes(angle):
    rng = np.random.default_rng(2)
    matrix, places = rng.normal(0, 0.1, (2, 2)), rng.uniform(0, 100, (30, 2))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    plain = interpolate_field(places, places @ matrix.T, size=(100, 100))
    turned = interpolate_field(places @ turn.T, places @ matrix.T @ turn.T, size=(100, 100))
    for name in ("divergence", "curl", "shear"):
        np.testing.assert_allclose(getattr(plain, name)[5, 5], getattr(turned, name)[5, 5], atol=1e-5)


def test_confidence_is_that_of_a_mean_of_many_and_falls_to_none_far_away():
    angle = np.arange(9) * 2 * np.pi / 9
    places = np.stack([49.5 + 3 * np.cos(angle), 49.5 + 3 * np.sin(angle)], axis=-1)
    field = interpolate_field(places, np.ones((9, 2)), size=(100, 100), step_px=100.0, reach_px=1000.0)
    # nine values of one variance, averaged
    assert field.confidence[0, 0] == pytest.approx(1 / (1 + 1 / 9), abs=1e-3)
    far = interpolate_field(places, np.ones((9, 2)), size=(1000, 1000), step_px=900.0, reach_px=5.0)
    assert far.confidence[0, 0] < 0.01


def test_fields_that_cannot_be_are_refused(grid):
    places = grid()
    with pytest.raises(InputError, match="2 markers have a displacement"):
        interpolate_field(places[:2], places[:2], size=(50, 50))
    with pytest.raises(InputError, match="must be positive"):
        interpolate_field(places, places, size=(50, 50), step_px=0.0)
