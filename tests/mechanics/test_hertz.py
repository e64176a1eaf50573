import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from sliplens.mechanics import contact_radius, hertz_displacement, normal_slope, reduced_modulus

FEW = settings(max_examples=25, deadline=None)
R, E, NU = 0.020, 29e3, 0.3
MODULUS = reduced_modulus(youngs_modulus_pa=E, poisson_ratio=NU)
forces = st.floats(0.01, 5.0)


@FEW
@given(forces, st.floats(0.1, 10))
def test_contact_radius_grows_with_cube_root_of_force(force, factor):
    small = contact_radius(force, sphere_radius_m=R, reduced_modulus_pa=MODULUS)
    large = contact_radius(force * factor**3, sphere_radius_m=R, reduced_modulus_pa=MODULUS)
    assert large == pytest.approx(factor * small)


@FEW
@given(forces)
def test_pressure_carries_the_force(force):
    a = float(contact_radius(force, sphere_radius_m=R, reduced_modulus_pa=MODULUS))
    p0 = 2 * MODULUS * a / (np.pi * R)  # Johnson (1985), eq. 4.24
    carried, _ = quad(lambda r: float(2 * np.pi * r * p0 * np.sqrt(max(0, 1 - (r / a) ** 2))), 0, a)
    assert carried == pytest.approx(force, rel=1e-6)


def test_no_force_makes_no_contact_and_no_displacement():
    a = contact_radius(np.array([0.0]), sphere_radius_m=R, reduced_modulus_pa=MODULUS)
    assert np.array_equal(a, [0.0])
    for field in hertz_displacement(
        np.array([0.0, 0.01]), 0.0, contact_radius_m=a, sphere_radius_m=R, poisson_ratio=NU
    ):
        assert np.array_equal(field, [0, 0])


@FEW
@given(st.floats(0.0, 0.05), st.floats(0.001, 0.01))
def test_slope_is_the_derivative_of_the_displacement(r, a):
    step = 1e-6 * a
    ends = np.abs(np.array([r - step, r + step]))
    _, (low, high) = hertz_displacement(ends, 0.0, contact_radius_m=a, sphere_radius_m=R, poisson_ratio=NU)
    slope = float(normal_slope(r, contact_radius_m=a, sphere_radius_m=R))
    # central differences err by rounding, 1e-16 / 1e-6, and at the kink of the curvature by the step
    assert slope == pytest.approx(-(high - low) / (2 * step) if r > step else r / R, abs=2e-3 * a / R)


def test_slope_falls_as_that_of_a_point_force_far_away():
    a = 0.008
    for s in (999.0, 1001.0, 1e5):
        slope = float(normal_slope(s * a, contact_radius_m=a, sphere_radius_m=R))
        assert slope == pytest.approx(a / R * 4 / (3 * np.pi * s**2), rel=1e-5)
