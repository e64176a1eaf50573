import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sliplens.mechanics import hertz_displacement, partial_slip_displacement, shear_displacement, stick_radius

FEW = settings(max_examples=25, deadline=None)
A, R = 0.008, 0.020
positions = st.floats(-0.03, 0.03)
depths = st.floats(0, 0.03)
ratios = st.floats(0, 0.5)
gels = pytest.mark.parametrize("nu", [0.0, 0.3, 0.5])


def pressed(points, nu):
    """Displacement vectors (last axis) at points (last axis) under the pressure G sqrt(1 - r^2) on the unit disc."""
    x, y, z = np.moveaxis(points, -1, 0)
    r = np.hypot(x, y)
    # p0 / G = 4 a / (pi (1 - nu) R) is 1 for this sphere
    u_r, u_z = hertz_displacement(r, z, contact_radius_m=1.0, sphere_radius_m=4 / (np.pi * (1 - nu)), poisson_ratio=nu)
    away = u_r / np.where(r > 0, r, 1)
    return np.stack([away * x, away * y, u_z], axis=-1)


def sheared(points, nu):
    """The same under the traction G sqrt(1 - r^2) along x."""
    return np.stack(
        shear_displacement(*np.moveaxis(points, -1, 0), contact_radius_m=1.0, peak_strain=1.0, poisson_ratio=nu),
        axis=-1,
    )


def boussinesq(x, y, z, nu):
    """Johnson (1985), eq. 3.18, for a force 4 pi G."""
    d = np.sqrt(x**2 + y**2 + z**2)
    away = z / d**3 - (1 - 2 * nu) / (d * (d + z))
    return np.stack([away * x, away * y, z**2 / d**3 + 2 * (1 - nu) / d])


def cerruti(x, y, z, nu):
    """Johnson (1985), eq. 3.75, for a force 4 pi G."""
    d = np.sqrt(x**2 + y**2 + z**2)
    k = 1 - 2 * nu
    u_x = 1 / d + x**2 / d**3 + k * (1 / (d + z) - x**2 / (d * (d + z) ** 2))
    u_y = x * y / d**3 - k * x * y / (d * (d + z) ** 2)
    return np.stack([u_x, u_y, x * z / d**3 + k * x / (d * (d + z))])


LOADS = pytest.mark.parametrize(("field", "point_force"), [(pressed, boussinesq), (sheared, cerruti)])
FIELDS = pytest.mark.parametrize("field", [pressed, sheared])


def slip(x, y, z, margin, nu):
    contact = {"contact_radius_m": A, "sphere_radius_m": R, "friction_coefficient": 0.6, "poisson_ratio": nu}
    return partial_slip_displacement(x, y, z, **contact, safety_margin=margin)


# on the axis, under the contact, just under its edge, beside it, far beside it
@pytest.mark.parametrize("point", [(0, 0, 0.4), (0.3, -0.5, 0.7), (0.6, 0.8, 0.1), (-1.4, 0.3, 0.2), (6.0, 8.0, 2.5)])
@gels
@LOADS
def test_field_is_the_point_solution_summed_over_the_disc(field, point_force, nu, point):
    # rho = sin(theta) makes the load smooth; both rules then converge at least as 1.1^(-400) at these depths
    theta, weight = np.polynomial.legendre.leggauss(200)
    theta, weight = np.pi / 4 * (theta[:, None] + 1), np.pi / 4 * weight[:, None]
    phi = 2 * np.pi * np.arange(500) / 500
    load = weight * np.sin(theta) * np.cos(theta) ** 2 * (2 * np.pi / 500)
    x, y, z = point
    kernel = point_force(x - np.sin(theta) * np.cos(phi), y - np.sin(theta) * np.sin(phi), z, nu)
    summed = np.sum(load * kernel, axis=(1, 2)) / (4 * np.pi)
    np.testing.assert_allclose(field(np.array(point, float), nu), summed, rtol=0, atol=1e-12)


@gels
@FIELDS
def test_field_obeys_naviers_equation(field, nu, rng):
    # central differences err by h^2 / 3 times a fourth derivative, which at these depths is below 4! / 0.5^4
    h = 1e-3
    step = h * np.eye(3)
    points = rng.uniform([-2, -2, 0.5], [2, 2, 2], (50, 3))
    corners = [(a, b) for a in (1, -1) for b in (1, -1)]
    mixed = [[sum(a * b * field(points + a * i + b * j, nu) for a, b in corners) for j in step] for i in step]
    second = np.array(mixed) / (4 * h**2)
    laplacian = np.einsum("iink->nk", second)
    divergence_slope = np.einsum("kjnj->nk", second)
    np.testing.assert_allclose((1 - 2 * nu) * laplacian + divergence_slope, 0, atol=4e-4)
    assert np.max(np.abs(laplacian)) > 500 * 4e-4  # nor is the law kept for want of curvature


@FIELDS
def test_surface_carries_the_load_and_nothing_else(field, rng):
    nu, h = 0.3, 1e-4
    angle, r = rng.uniform(0, 2 * np.pi, 60), np.concatenate([rng.uniform(0, 0.9, 30), rng.uniform(1.1, 3, 30)])
    points = np.stack([r * np.cos(angle), r * np.sin(angle), np.zeros(60)], axis=-1)
    slope = np.empty((3, 60, 3))
    for axis, step in enumerate(h * np.eye(3)):
        # one-sided of second order: there is no gel above the surface
        slope[axis] = (4 * field(points + step, nu) - field(points + 2 * step, nu) - 3 * field(points, nu)) / (2 * h)
    dilation = np.einsum("jnj->n", slope)
    stress = slope[2] + np.moveaxis(slope[:, :, 2], 0, 1)  # sigma_xz, sigma_yz and sigma_zz over G
    stress[:, 2] += 2 * nu / (1 - 2 * nu) * dilation
    expected = np.zeros((60, 3))
    expected[:, 2 if field is pressed else 0] = -np.sqrt(np.maximum(1 - r**2, 0))
    # second-order differences err by h^2 / 3 times a third derivative, at most about 0.1^(-2.5) near the edge
    np.testing.assert_allclose(stress, expected, atol=1e-5)


@FEW
@given(st.floats(0, 50), st.floats(0, 2 * np.pi), ratios)
def test_at_depth_zero_the_field_is_the_surfaces(s, phi, nu):
    """Johnson (1985), eqs. 3.41 and 3.42 (pressure), 3.91 and 3.92 (traction), for p0 = q0 = G and a = 1."""
    inside, rest = min(s, 1), max(s, 1)
    angle, root = np.arcsin(1 / rest), np.sqrt(rest**2 - 1)
    sunk = np.pi * (2 - inside**2) if s <= 1 else 2 * ((2 - s**2) * angle + root)
    drawn_in = -np.expm1(1.5 * np.log1p(-(inside**2))) / s if 0 < inside < 1 else inside / rest
    cos, sin = np.cos(phi), np.sin(phi)
    odd = angle + (2 / s**2 - 1) * root / s**2 if s > 1 else np.pi / 2
    if s <= 1:
        along = np.pi / 32 * (4 * (2 - nu) - ((4 - 3 * nu) * cos**2 + (4 - nu) * sin**2) * s**2)
    else:
        along = ((2 - nu) * ((2 - s**2) * angle + root) + nu / 2 * odd * s**2 * np.cos(2 * phi)) / 8
    point = np.array([s * cos, s * sin, 0])
    u_r = -(1 - 2 * nu) / 6 * drawn_in
    # what lies outside cancels by up to 50^2 rounding errors
    np.testing.assert_allclose(pressed(point, nu), [u_r * cos, u_r * sin, (1 - nu) / 8 * sunk], atol=1e-12)
    np.testing.assert_allclose(sheared(point, nu)[:2], [along, nu / 8 * odd * s**2 * cos * sin], atol=1e-12)


@FEW
@given(st.floats(0, 20), st.floats(0, 2 * np.pi), ratios)
def test_shear_sinks_the_surface_ahead_as_far_as_pressure_draws_it_in(s, phi, nu):
    # Betti: a force into the gel at A moves B along x as a force along x at B moves A into the gel, and seen from B
    # the place A lies the other way
    point = np.array([s * np.cos(phi), s * np.sin(phi), 0])
    assert sheared(point, nu)[2] == pytest.approx(-pressed(point, nu)[0], abs=1e-12)


@pytest.mark.parametrize("distance", [1e2, 1e4, 1e8])
@gels
@LOADS
def test_far_away_the_load_is_a_point_force(field, point_force, distance, nu, rng):
    direction = rng.normal(size=(50, 3)) * [1, 1, 0.5]
    direction[:, 2] = np.abs(direction[:, 2])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    force = 2 * np.pi / 3  # of sqrt(1 - r^2) over the unit disc
    expected = np.moveaxis(point_force(*direction.T, nu), 0, -1) * force / (4 * np.pi)
    # the load's second moment, 1/5, adds (1/10) (u_xx + u_yy), of the order of u / distance^2
    np.testing.assert_allclose(distance * field(distance * direction, nu), expected, atol=1 / distance**2 + 1e-12)


@FEW
@given(st.floats(0, 1), st.floats(0, 2 * np.pi), ratios)
def test_series_takes_over_without_a_step(q, phi, nu):
    # it does at p = 50, where fields are below 0.05; as they fall with 1 / p, they change by 1e-14 over this gap
    p = 50 * np.array([1 - 1e-13, 1 + 1e-13])
    s = np.sqrt((1 + p**2) * (1 - q**2))
    points = np.stack([s * np.cos(phi), s * np.sin(phi), p * q], axis=-1)
    for field in (pressed, sheared):
        inner, outer = field(points, nu)
        np.testing.assert_allclose(inner, outer, rtol=0, atol=1e-13)


@FEW
@example(0.0, 0.015625, 0.0, 2.2e-311, 0.5)  # a stick zone smaller than any length
@given(positions, positions, depths, st.floats(0, 1), ratios)
def test_field_mirrors_in_the_plane_of_the_load_and_across_it(x, y, z, margin, nu):
    u_x, u_y, u_z = slip(x, y, z, margin, nu)
    np.testing.assert_array_equal(slip(x, -y, z, margin, nu), (u_x, -u_y, u_z))
    # seen from behind the load points backwards: what it moved along it still does, what rose now sinks
    np.testing.assert_array_equal(slip(-x, y, z, margin, nu), (u_x, -u_y, -u_z))


@FEW
@given(st.floats(0.05, 0.95), st.floats(0, 0.99), st.floats(0, 2 * np.pi), ratios)
def test_stick_zone_moves_as_one_piece_along_the_surface(margin, share, phi, nu):
    r = share * float(stick_radius(A, margin))
    u_x, u_y, _ = slip(r * np.cos(phi), r * np.sin(phi), 0.0, margin, nu)
    # Johnson (1985), eq. 7.42a: for rubber 1.5 mu times the indentation at full slip
    rigid = (2 - nu) / (2 * (1 - nu)) * 0.6 * A**2 / R * (1 - margin ** (2 / 3))
    assert float(u_x) == pytest.approx(rigid, rel=1e-9)
    assert float(u_y) == pytest.approx(0, abs=1e-12)


@FEW
@given(positions, positions, depths, ratios)
def test_margin_spans_no_motion_to_full_slip(x, y, z, nu):
    np.testing.assert_array_equal(slip(x, y, z, 1.0, nu), 0)
    strain = 0.6 * 4 * A / (np.pi * (1 - nu) * R)
    full = shear_displacement(x, y, z, contact_radius_m=A, peak_strain=strain, poisson_ratio=nu)
    np.testing.assert_allclose(slip(x, y, z, 0.0, nu), full, rtol=1e-12)


def test_frames_run_down_and_markers_across():
    radius, depth = np.array([[0.0], [0.5 * A], [A]]), np.linspace(0, 0.002, 4)
    x, y = np.linspace(-0.01, 0.01, 4), np.full(4, 0.003)
    contact = {"contact_radius_m": radius, "sphere_radius_m": R, "poisson_ratio": 0.4}
    fields = (
        *hertz_displacement(np.hypot(x, y), depth, **contact),
        *partial_slip_displacement(
            x, y, depth, **contact, friction_coefficient=0.6, safety_margin=np.array([[1.0], [0.7], [0.2]])
        ),
    )
    for field in fields:
        assert field.shape == (3, 4)
        np.testing.assert_array_equal(field[0], 0)  # the first frame has no contact
        assert np.all(field[1:] != 0)
