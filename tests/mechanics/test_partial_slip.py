import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.integrate import dblquad

from sliplens.errors import ContactError
from sliplens.mechanics import partial_slip_displacement, shear_displacement, stick_displacement, stick_radius

FEW = settings(max_examples=25, deadline=None)
A, R = 0.008, 0.020
positions = st.floats(-0.03, 0.03)


def slip(x, y, margin, nu=0.5):
    return partial_slip_displacement(
        x,
        y,
        contact_radius_m=A,
        sphere_radius_m=R,
        friction_coefficient=0.6,
        safety_margin=margin,
        poisson_ratio=nu,
    )


@pytest.mark.parametrize("nu", [0.3, 0.49])
@pytest.mark.parametrize(("x", "y"), [(1.2, 0.9), (0.4, -2.0), (3.0, 0.0)])
def test_outside_the_field_is_cerrutis_summed_over_the_disc(x, y, nu):
    def traction(rho):
        return rho * np.sqrt(max(0, 1 - rho**2)) / (2 * np.pi)

    def along(rho, phi):
        dx, dy = x - rho * np.cos(phi), y - rho * np.sin(phi)
        s = np.hypot(dx, dy)
        return traction(rho) * ((1 - nu) / s + nu * dx**2 / s**3)

    def across(rho, phi):
        dx, dy = x - rho * np.cos(phi), y - rho * np.sin(phi)
        return traction(rho) * nu * dx * dy / np.hypot(dx, dy) ** 3

    u_x, u_y = shear_displacement(x, y, contact_radius_m=1.0, peak_strain=1.0, poisson_ratio=nu)
    assert float(u_x) == pytest.approx(dblquad(along, 0, 2 * np.pi, 0, 1)[0], rel=2e-3)
    assert float(u_y) == pytest.approx(dblquad(across, 0, 2 * np.pi, 0, 1)[0], rel=2e-3, abs=1e-6)


@FEW
@given(st.floats(0, 2 * np.pi), st.floats(0.0, 0.5))
def test_field_is_continuous_at_the_edge(phi, nu):
    inner = shear_displacement(
        0.9999 * np.cos(phi), 0.9999 * np.sin(phi), contact_radius_m=1.0, peak_strain=1.0, poisson_ratio=nu
    )
    outer = shear_displacement(
        1.0001 * np.cos(phi), 1.0001 * np.sin(phi), contact_radius_m=1.0, peak_strain=1.0, poisson_ratio=nu
    )
    np.testing.assert_allclose(inner, outer, atol=2e-3)


@FEW
@given(st.floats(0, 2 * np.pi))
def test_expansion_takes_over_without_a_step(phi):
    near, far = (
        shear_displacement(s * np.cos(phi), s * np.sin(phi), contact_radius_m=1.0, peak_strain=1.0, poisson_ratio=0.5)
        for s in (99.99, 100.01)
    )
    np.testing.assert_allclose(near, far, rtol=1e-3, atol=1e-6)


@FEW
@example(0.0, 0.015625, 2.2e-311)  # a stick zone smaller than any length
@given(positions, positions, st.floats(0, 1))
def test_field_mirrors_in_the_plane_of_the_load(x, y, margin):
    (u_x, u_y), (v_x, v_y) = slip(x, y, margin), slip(x, -y, margin)
    assert (float(v_x), float(v_y)) == pytest.approx((float(u_x), -float(u_y)))


@FEW
@given(st.floats(0.05, 0.95), st.floats(0, 0.99), st.floats(0, 2 * np.pi))
def test_stick_zone_moves_as_one_piece(margin, share, phi):
    r = share * float(stick_radius(A, margin))
    u_x, u_y = slip(r * np.cos(phi), r * np.sin(phi), margin)
    rigid = stick_displacement(
        contact_radius_m=A, sphere_radius_m=R, friction_coefficient=0.6, safety_margin=margin, poisson_ratio=0.5
    )
    assert float(u_x) == pytest.approx(float(rigid), rel=1e-9)
    assert float(u_y) == pytest.approx(0, abs=1e-12)


def test_full_slip_of_rubber_begins_at_one_and_a_half_mu_times_the_indentation():
    full = stick_displacement(
        contact_radius_m=A, sphere_radius_m=R, friction_coefficient=0.6, safety_margin=0.0, poisson_ratio=0.5
    )
    assert float(full) == pytest.approx(1.5 * 0.6 * A**2 / R)


@FEW
@given(positions, positions)
def test_without_tangential_load_nothing_moves(x, y):
    np.testing.assert_array_equal(slip(x, y, 1.0), 0)


def test_margin_without_contact_is_refused():
    with pytest.raises(ContactError, match="leave out the frames without contact"):
        stick_radius(A, np.nan)
