import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import dblquad, quad

from sliplens.errors import ContactError
from sliplens.mechanics import (
    contact_radius,
    indentation,
    normal_displacement,
    normal_slope,
    peak_pressure,
    radial_displacement,
    reduced_modulus,
)

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
    p0 = float(peak_pressure(a, sphere_radius_m=R, reduced_modulus_pa=MODULUS))
    carried, _ = quad(lambda r: float(2 * np.pi * r * p0 * np.sqrt(max(0, 1 - (r / a) ** 2))), 0, a)
    assert carried == pytest.approx(force, rel=1e-6)


def test_no_force_makes_no_contact_and_no_displacement():
    a = contact_radius(np.array([0.0]), sphere_radius_m=R, reduced_modulus_pa=MODULUS)
    assert np.array_equal(a, [0.0])
    r = np.array([0.0, 0.01])
    assert np.array_equal(normal_displacement(r, contact_radius_m=a, sphere_radius_m=R), [0, 0])
    assert np.array_equal(radial_displacement(r, contact_radius_m=a, sphere_radius_m=R, poisson_ratio=NU), [0, 0])


def test_inside_the_contact_the_surface_follows_the_flat():
    a = 0.008
    r = np.linspace(0, a, 9)
    u = normal_displacement(r, contact_radius_m=a, sphere_radius_m=R)
    np.testing.assert_allclose(u + r**2 / (2 * R), indentation(a, sphere_radius_m=R), rtol=1e-12)


@pytest.mark.parametrize("s", [1.3, 2.5])
def test_outside_the_displacement_is_boussinesqs_summed_over_the_disc(s):
    a = 0.008
    p0 = float(peak_pressure(a, sphere_radius_m=R, reduced_modulus_pa=MODULUS))
    summed = dblquad(
        lambda rho, phi: (
            rho * p0 * np.sqrt(max(0, 1 - (rho / a) ** 2)) / np.hypot(s * a - rho * np.cos(phi), rho * np.sin(phi))
        ),
        0, 2 * np.pi, 0, a,
    )[0]  # fmt: skip
    u = normal_displacement(s * a, contact_radius_m=a, sphere_radius_m=R)
    assert float(u) == pytest.approx(summed / (np.pi * MODULUS), rel=1e-4)


def test_far_away_the_load_is_a_point_force():
    a, force = 0.008, 4 * MODULUS * 0.008**3 / (3 * R)
    for s in (1e3, 1e6):
        u = normal_displacement(s * a, contact_radius_m=a, sphere_radius_m=R)
        assert float(u) == pytest.approx(force / (np.pi * MODULUS * s * a), rel=1e-4)


@FEW
@given(st.floats(0.9999, 1.0), st.floats(0.0, 0.5))
def test_displacements_are_continuous_at_the_edge(inside, nu):
    a = 0.008
    outside = 2 - inside
    for field in (
        lambda r: normal_displacement(r, contact_radius_m=a, sphere_radius_m=R),
        lambda r: radial_displacement(r, contact_radius_m=a, sphere_radius_m=R, poisson_ratio=nu),
    ):
        assert float(field(inside * a)) == pytest.approx(float(field(outside * a)), rel=1e-3, abs=1e-12)


def test_radial_displacement_is_inwards_and_vanishes_for_rubber():
    r = np.linspace(0, 0.02, 50)
    assert np.all(radial_displacement(r, contact_radius_m=0.008, sphere_radius_m=R, poisson_ratio=0.3) <= 0)
    np.testing.assert_array_equal(
        radial_displacement(r, contact_radius_m=0.008, sphere_radius_m=R, poisson_ratio=0.5), 0
    )


@FEW
@given(st.floats(0.0, 0.05), st.floats(0.001, 0.01))
def test_slope_is_the_derivative_of_the_displacement(r, a):
    step = 1e-6 * a
    ends = np.abs(np.array([r - step, r + step]))
    low, high = np.asarray(normal_displacement(ends, contact_radius_m=a, sphere_radius_m=R))
    slope = float(normal_slope(r, contact_radius_m=a, sphere_radius_m=R))
    # central differences err by rounding, 1e-16 / 1e-6, and at the kink of the curvature by the step
    assert slope == pytest.approx(-(high - low) / (2 * step) if r > step else r / R, abs=2e-3 * a / R)


def test_slope_falls_as_that_of_a_point_force_far_away():
    a = 0.008
    for s in (999.0, 1001.0, 1e5):
        slope = float(normal_slope(s * a, contact_radius_m=a, sphere_radius_m=R))
        assert slope == pytest.approx(a / R * 4 / (3 * np.pi * s**2), rel=1e-5)


def test_negative_force_is_refused():
    with pytest.raises(ContactError, match="normal force must not be negative, got -1 N; flip its sign on import"):
        contact_radius(np.array([1.0, -1.0]), sphere_radius_m=R, reduced_modulus_pa=MODULUS)


def test_impossible_gel_is_refused():
    with pytest.raises(ContactError, match=r"Poisson's ratio must lie in \[0, 0.5\], got 0.6"):
        reduced_modulus(youngs_modulus_pa=E, poisson_ratio=0.6)
    with pytest.raises(ContactError, match="Young's modulus must be positive and finite, got 0 Pa"):
        reduced_modulus(youngs_modulus_pa=0.0, poisson_ratio=0.5)
