from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplens.errors import ContactError
from sliplens.mechanics import (
    hertz_displacement,
    partial_slip_displacement,
    reduced_modulus,
    safety_margin,
    stick_radius,
    stick_ratio,
)

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


HERTZ = partial(
    hertz_displacement, distance_m=0.001, depth_m=0.001, contact_radius_m=0.008, sphere_radius_m=0.02, poisson_ratio=0.5
)
SLIP = partial(
    partial_slip_displacement, x_m=0.001, y_m=0.001, depth_m=0.001, contact_radius_m=0.008, sphere_radius_m=0.02,
    friction_coefficient=0.6, safety_margin=0.5, poisson_ratio=0.5,
)  # fmt: skip


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (partial(safety_margin, -1.0, 0.0, 0.5), "normal force must not be negative, got -1 N"),
        (partial(safety_margin, 1.0, -0.2, 0.5), "tangential force must not be negative, got -0.2 N"),
        (partial(safety_margin, 1.0, 0.2, 0.0), "the coefficient of friction must be positive, got 0;"),
        (partial(stick_ratio, np.array([0.2, 80.0])), "give them as fractions, not in percent"),
        (partial(stick_ratio, 0.5, profile_exponent=0.0), "profile exponent must be positive"),
        (partial(stick_radius, 0.008, np.nan), "leave out the frames without contact"),
        (partial(reduced_modulus, youngs_modulus_pa=3e4, poisson_ratio=0.6), r"must lie in \[0, 0.5\], got 0.6"),
        (
            partial(reduced_modulus, youngs_modulus_pa=0.0, poisson_ratio=0.5),
            "modulus must be positive and finite, got",
        ),
        (partial(HERTZ, distance_m=-0.1), "distance from the contact's axis must not be negative"),
        (partial(HERTZ, depth_m=-0.1), "depth must not be negative, got -0.1 m; flip its sign"),
        (partial(HERTZ, sphere_radius_m=0.0), "sphere radius must be positive and finite"),
        (partial(HERTZ, poisson_ratio=0.6), r"must lie in \[0, 0.5\], got 0.6; rubber is near 0.5"),
        (partial(SLIP, contact_radius_m=-0.1), "contact radius must not be negative"),
        (partial(SLIP, friction_coefficient=-0.6), "friction must not be negative, got -0.6"),
        (partial(SLIP, safety_margin=1.5), r"safety margins must lie in \[0, 1\]"),
    ],
)
def test_impossible_loads_and_gels_are_refused(call, message):
    with pytest.raises(ContactError, match=message):
        call()
