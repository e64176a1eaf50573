import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplens.errors import ContactError
from sliplens.mechanics import safety_margin, stick_radius, stick_ratio

FEW = settings(max_examples=25, deadline=None)
margins = st.floats(0, 1)


@FEW
@given(margins, st.floats(0.1, 5), st.floats(0.05, 2))
def test_safety_margin_is_what_friction_has_left(margin, normal, mu):
    assert float(safety_margin(normal, (1 - margin) * mu * normal, mu)) == pytest.approx(margin, abs=1e-9)


def test_margin_ends_at_zero_and_has_no_meaning_without_contact():
    margin = safety_margin(np.array([1.0, 1.0, 0.0]), np.array([0.0, 9.0, 0.0]), 0.5)
    np.testing.assert_array_equal(margin, [1, 0, np.nan])


def test_stick_ratio_of_a_sphere_has_the_values_of_the_closed_form():
    # Gamma^(2/3) by hand: 0.125 -> 0.25, 0.216 -> 0.36, 0.512 -> 0.64
    np.testing.assert_allclose(stick_ratio(np.array([0, 0.125, 0.216, 0.512, 1])), [0, 0.25, 0.36, 0.64, 1])


@FEW
@given(margins)
def test_stick_ratio_of_a_cone_is_the_margin(margin):
    assert float(stick_ratio(margin, profile_exponent=1.0)) == pytest.approx(margin)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: safety_margin(-1.0, 0.0, 0.5), "normal force must not be negative, got -1 N"),
        (lambda: safety_margin(1.0, -0.2, 0.5), "tangential force must not be negative, got -0.2 N"),
        (lambda: safety_margin(1.0, 0.2, 0.0), "the coefficient of friction must be positive, got 0;"),
        (lambda: stick_ratio(np.array([0.2, 80.0])), "give them as fractions, not in percent"),
        (lambda: stick_ratio(0.5, profile_exponent=0.0), "profile exponent must be positive"),
    ],
)
def test_impossible_loads_are_refused(call, message):
    with pytest.raises(ContactError, match=message):
        call()


def test_a_margin_without_contact_has_no_stick_radius():
    with pytest.raises(ContactError, match="leave out the frames without contact"):
        stick_radius(0.008, np.nan)
