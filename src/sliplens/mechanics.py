"""Contact mechanics: a sphere pressed on a gel and pulled along it, and how much of the friction is left.

Symbols, with SI units: normal force P or F_n, positive when pressing, and tangential force Q or F_t; coefficient of
friction mu; safety margin Gamma; radius R of the sphere, a of the contact and c of its part that sticks; of the gel
Young's modulus E, shear modulus G, Poisson's ratio nu and reduced modulus E*. Johnson (1985) is *Contact Mechanics*,
Cambridge University Press.

Depth z runs from the unloaded surface (0) into the gel, and so does u_z; the tangential load points along x, and places
are relative to the contact's centre. The fields are closed forms, right to 1e-11 of themselves at any depth and
distance, and 0 where nothing touches (a = 0). Numbers and arrays broadcast: frames can run down and markers across.
"""

from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from sliplens.errors import ContactError

Array: TypeAlias = Float[np.ndarray, "..."]
Numbers: TypeAlias = float | Array
SpatialField: TypeAlias = tuple[Array, Array, Array]

_POINT = 1e-30
"""Contacts no larger than this move next to nothing; fourth powers of distances over larger ones stay finite."""
_FAR = 50.0
"""From about this many contact radii on, 1 - p acot p is summed as a series: its terms would cancel."""


def reduced_modulus(*, youngs_modulus_pa: float, poisson_ratio: float) -> float:
    """Plane-strain modulus E* = E / (1 - nu^2) of a gel against a rigid body, in pascals.

    Raises
    ------
    ContactError
        If the modulus is not positive or Poisson's ratio lies outside [0, 0.5].

    References
    ----------
    Johnson (1985), section 4.2.

    Examples
    --------
    >>> from sliplens.mechanics import reduced_modulus
    >>> round(reduced_modulus(youngs_modulus_pa=300e3, poisson_ratio=0.5))
    400000
    """
    _require_positive(youngs_modulus_pa, name="Young's modulus", unit="Pa")
    return youngs_modulus_pa / (1 - _require_poisson_ratio(poisson_ratio) ** 2)


def contact_radius(normal_force_n: Numbers, *, sphere_radius_m: float, reduced_modulus_pa: Numbers) -> Numbers:
    """Radius a of the contact circle, a^3 = 3 P R / (4 E*), in metres.

    Raises
    ------
    ContactError
        If a force is negative, or the radius or the modulus is not positive.

    References
    ----------
    Johnson (1985), eq. 4.22.

    Examples
    --------
    Eight times the force doubles the radius:

    >>> import numpy as np
    >>> from sliplens.mechanics import contact_radius
    >>> force_n = np.array([0.5, 4.0])
    >>> 1e3 * contact_radius(force_n, sphere_radius_m=0.02, reduced_modulus_pa=60e3).round(6)
    array([ 5., 10.])
    """
    force = _require_not_negative(normal_force_n, name="normal force", unit="N")
    _require_positive(sphere_radius_m, name="sphere radius", unit="m")
    _require_positive(reduced_modulus_pa, name="reduced modulus", unit="Pa")
    return np.cbrt(0.75 * force * sphere_radius_m / reduced_modulus_pa)


def indentation(contact_radius_m: Numbers, *, sphere_radius_m: float) -> Numbers:
    """Approach delta = a^2 / R of the sphere and the flat, in metres.

    Raises
    ------
    ContactError
        If the contact radius is negative or the sphere's radius is not positive.

    References
    ----------
    Johnson (1985), eq. 4.23.

    Examples
    --------
    >>> from sliplens.mechanics import indentation
    >>> round(indentation(0.004, sphere_radius_m=0.02), 6)
    0.0008
    """
    _require_positive(sphere_radius_m, name="sphere radius", unit="m")
    return _require_not_negative(contact_radius_m, name="contact radius", unit="m") ** 2 / sphere_radius_m


def normal_slope(distance_m: Numbers, *, contact_radius_m: Numbers, sphere_radius_m: float) -> Numbers:
    """Slope -du_z/dr of the surface under Hertz's pressure, the ratio of its rise to the way from the dent's centre.

    Inside the contact r / R; outside (2 a / (pi R)) [s asin(1/s) - sqrt(s^2 - 1) / s] with s = r/a.

    Raises
    ------
    ContactError
        If a distance or a contact radius is negative, or the sphere's radius is not positive.

    References
    ----------
    The derivative of Johnson (1985), eqs. 3.41a and 3.42a with p0 of eq. 4.24.
    """
    _require_positive(sphere_radius_m, name="sphere radius", unit="m")
    a = np.asarray(_require_not_negative(contact_radius_m, name="contact radius", unit="m"))
    r = _require_not_negative(distance_m, name="distance from the contact's centre", unit="m")
    # infinitely many radii away where nothing touches, so that the slope vanishes there
    s = np.where(a > 0, r / np.where(a > 0, a, 1), np.inf)
    # far away the two terms cancel to 2 / (3 s^2)
    near = np.clip(s, 1, 1e3)
    outside = 2 / np.pi * (near * np.arcsin(1 / near) - np.sqrt(near**2 - 1) / near)
    shape = np.where(s <= 1, np.minimum(s, 1), np.where(s > 1e3, 4 / (3 * np.pi * np.maximum(s, 1) ** 2), outside))
    return a / sphere_radius_m * shape


def safety_margin(normal_force_n: Numbers, tangential_force_n: Numbers, friction_coefficient: Numbers) -> Array:
    """Safety margin Gamma = 1 - F_t / (mu F_n), clipped to [0, 1]; NaN where nothing presses.

    1 is a contact without tangential load, 0 the onset of full slip. It is not the share of the contact that sticks;
    see `stick_ratio`.

    Raises
    ------
    ContactError
        If a force is negative or a coefficient is not positive.

    References
    ----------
    Polak, *Explainable Neural Networks for Incipient Slip Sensing in Robot Tactile Learning*, eq. 1 (right-hand side).

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.mechanics import safety_margin
    >>> safety_margin(2.0, np.array([0.0, 0.8, 1.6]), 0.8)
    array([1. , 0.5, 0. ])
    """
    normal = np.asarray(_require_not_negative(normal_force_n, name="normal force", unit="N"))
    tangential = _require_not_negative(tangential_force_n, name="tangential force", unit="N")
    if not np.all(np.asarray(friction_coefficient) > 0):
        wrong = f"the coefficient of friction must be positive, got {np.min(friction_coefficient):.3g}"
        raise ContactError(f"{wrong}; measure it at the onset of slip")
    capacity = normal * friction_coefficient
    pressing = capacity > 0
    used = tangential / np.where(pressing, capacity, 1)
    return np.where(pressing, np.clip(1 - used, 0, 1), np.nan)


def stick_ratio(safety_margin: Numbers, *, profile_exponent: float = 2.0) -> Array:
    """Share of the contact area that sticks, Gamma^(2 / (n + 1)); Gamma^(2/3) for a sphere on a flat.

    Holds for a contact of revolution whose gap grows as r^n (the profile's exponent, 2 for a sphere), pressed first and
    pulled after, with the same law of friction everywhere (Cattaneo, Mindlin, Jaeger). A cone (n = 1) is the only
    profile for which the stick ratio is the safety margin itself. A grip that grows in proportion with its load sticks
    fully and does not obey this law.

    Raises
    ------
    ContactError
        If a margin lies outside [0, 1] or the exponent is not positive.

    References
    ----------
    Johnson (1985), section 7.2 (sphere: c/a = Gamma^(1/3)); Jaeger, *J. Tribol.* 120 (1998) 677 (other profiles).

    Examples
    --------
    Half of the margin is left where 63 % of the contact still sticks:

    >>> import numpy as np
    >>> from sliplens.mechanics import stick_ratio
    >>> stick_ratio(np.array([1.0, 0.5, 0.0])).round(2)
    array([1.  , 0.63, 0.  ])
    """
    _require_positive(profile_exponent, name="profile exponent", unit="(no unit)")
    margin = np.asarray(safety_margin, dtype=np.float64)
    if np.any((margin < 0) | (margin > 1)):
        span = f"{np.nanmin(margin):.3g} to {np.nanmax(margin):.3g}"
        raise ContactError(f"safety margins must lie in [0, 1], got {span}; give them as fractions, not in percent")
    return np.asarray(margin ** (2 / (profile_exponent + 1)))


def stick_radius(contact_radius_m: Numbers, safety_margin: Numbers) -> Numbers:
    """Radius c = a Gamma^(1/3) of the circle that still sticks, in metres.

    Raises
    ------
    ContactError
        If a margin lies outside [0, 1] or is NaN.

    References
    ----------
    Johnson (1985), eq. 7.30.

    Examples
    --------
    >>> from sliplens.mechanics import stick_radius
    >>> round(float(stick_radius(0.004, 0.125)), 6)
    0.002
    """
    margin = np.asarray(safety_margin)
    if not np.all((margin >= 0) & (margin <= 1)):
        raise ContactError("safety margins must lie in [0, 1]; leave out the frames without contact")
    return contact_radius_m * np.cbrt(margin)


def hertz_displacement(
    distance_m: Numbers, depth_m: Numbers, *, contact_radius_m: Numbers, sphere_radius_m: float, poisson_ratio: float
) -> tuple[Array, Array]:
    """Displacements inside the gel under Hertz's pressure, in metres: u_r away from the axis, and u_z into the gel.

    Unlike the surface, the inside of an incompressible gel is pushed outwards.

    Raises
    ------
    ContactError
        If a distance, a depth or a contact radius is negative, the sphere's radius is not positive, or Poisson's ratio
        lies outside [0, 0.5].

    References
    ----------
    Johnson (1985), eq. 3.18 summed over the contact; Hanson and Johnson, *J. Tribol.* 115 (1993) 327 (closed forms).

    Examples
    --------
    Under the contact's middle the gel gives way less, the deeper one looks:

    >>> import numpy as np
    >>> from sliplens.mechanics import hertz_displacement
    >>> sphere = {"contact_radius_m": 0.004, "sphere_radius_m": 0.02}
    >>> _, u_z = hertz_displacement(0.0, np.array([0.0, 0.02]), **sphere, poisson_ratio=0.5)
    >>> (1e3 * u_z).round(2)
    array([0.8 , 0.13])
    """
    nu = _require_poisson_ratio(poisson_ratio)
    _require_positive(sphere_radius_m, name="sphere radius", unit="m")
    r = np.asarray(_require_not_negative(distance_m, name="distance from the contact's axis", unit="m"))
    a, unit = _radius_and_unit(contact_radius_m)
    s = r / unit
    disc = _sum_over_disc(s**2, _require_not_negative(depth_m, name="depth", unit="m") / unit)
    # p0 a / (4 G), for p0 / G = 4 a / (pi (1 - nu) R)
    scale = a**2 / (np.pi * (1 - nu) * sphere_radius_m)
    u_r = scale * s * (disc.lean - (1 - 2 * nu) * disc.spread)
    u_z = scale * (2 * (1 - nu) * disc.newton + disc.sink)
    return np.asarray(u_r), np.asarray(u_z)


def shear_displacement(
    x_m: Numbers,
    y_m: Numbers,
    depth_m: Numbers,
    *,
    contact_radius_m: Numbers,
    peak_strain: Numbers,
    poisson_ratio: float,
) -> SpatialField:
    """Displacements (u_x, u_y, u_z) inside the gel under the traction q0 sqrt(1 - r^2/a^2) along x, in metres.

    `peak_strain` is the traction at the centre over the shear modulus, q0 / G; u_z is positive into the gel: ahead of
    the load it sinks, behind it rises.

    Raises
    ------
    ContactError
        If a depth or a contact radius is negative, or Poisson's ratio lies outside [0, 0.5].

    References
    ----------
    Johnson (1985), eq. 3.75 summed over the contact; Hanson and Johnson, *J. Tribol.* 115 (1993) 327 (closed forms).
    """
    nu = _require_poisson_ratio(poisson_ratio)
    a, unit = _radius_and_unit(contact_radius_m)
    x, y = x_m / unit, y_m / unit
    disc = _sum_over_disc(x**2 + y**2, _require_not_negative(depth_m, name="depth", unit="m") / unit)
    even = (2 - nu) * disc.newton - disc.sink / 2
    odd = disc.bend + nu * disc.splay
    scale = a * peak_strain / 4
    u_x = scale * (even + odd * (x**2 - y**2))
    u_y = scale * 2 * odd * x * y
    u_z = scale * x * (disc.lean + (1 - 2 * nu) * disc.spread)
    return np.asarray(u_x), np.asarray(u_y), np.asarray(u_z)


def partial_slip_displacement(
    x_m: Numbers,
    y_m: Numbers,
    depth_m: Numbers,
    *,
    contact_radius_m: Numbers,
    sphere_radius_m: float,
    friction_coefficient: Numbers,
    safety_margin: Numbers,
    poisson_ratio: float,
) -> SpatialField:
    """Displacements (u_x, u_y, u_z) inside the gel under a pressed sphere's growing tangential load, in metres.

    The full-slip traction mu p over the contact, less the same over the stick zone; the pressure's own displacement is
    `hertz_displacement`.

    Raises
    ------
    ContactError
        If a depth, a contact radius or a coefficient is negative, the sphere's radius is not positive, a margin lies
        outside [0, 1], or Poisson's ratio lies outside [0, 0.5].

    References
    ----------
    Johnson (1985), section 7.2.

    Examples
    --------
    At the surface the stick zone moves as one piece; the rim of the contact stays behind:

    >>> import numpy as np
    >>> from sliplens.mechanics import partial_slip_displacement
    >>> grip = {"friction_coefficient": 0.5, "safety_margin": 0.125, "poisson_ratio": 0.5}
    >>> x_m = np.array([0.0, 0.002, 0.004])
    >>> u_x, _, _ = partial_slip_displacement(x_m, 0.0, 0.0, contact_radius_m=0.004, sphere_radius_m=0.02, **grip)
    >>> (u_x[1:] / u_x[0]).round(2)
    array([1.  , 0.68])
    """
    nu = _require_poisson_ratio(poisson_ratio)
    _require_positive(sphere_radius_m, name="sphere radius", unit="m")
    friction = _require_not_negative(friction_coefficient, name="coefficient of friction", unit="(no unit)")
    stick_m = stick_radius(contact_radius_m, safety_margin)
    # the stick zone's traction is mu p0 c / a, and p0 / a does not depend on the load
    strain_per_metre = 4 * friction / (np.pi * (1 - nu) * sphere_radius_m)
    whole, stuck = (
        shear_displacement(
            x_m, y_m, depth_m, contact_radius_m=radius, peak_strain=strain_per_metre * radius, poisson_ratio=nu
        )
        for radius in (contact_radius_m, stick_m)
    )
    return np.asarray(whole[0] - stuck[0]), np.asarray(whole[1] - stuck[1]), np.asarray(whole[2] - stuck[2])


class _DiscSums(NamedTuple):
    """N of `_sum_over_disc` and derivatives of N, L and K, times factors that keep them finite on axis and surface."""

    newton: Numbers  # N
    sink: Numbers  # -z N_z
    lean: Numbers  # -z N_s / s
    spread: Numbers  # L_s / s
    bend: Numbers  # -z (L_ss - L_s / s) / (2 s^2)
    splay: Numbers  # (K_ss - K_s / s) / s^2


def _sum_over_disc(s_squared: Numbers, z: Numbers) -> _DiscSums:
    """Sum 1/R, log(R + z) and z log(R + z) - R over the unit disc, weighted by sqrt(1 - rho^2) / pi: N, L and K.

    R is the distance from a place on the disc. All three are harmonic, with K_z = L and L_z = N, and make up the point
    solutions of Boussinesq and Cerruti: for a force of 4 pi G into the gel u_r = -z N_r - (1 - 2 nu) L_r and
    u_z = 2 (1 - nu) N - z N_z; for one along x u_x = 2 N - z L_xx + 2 nu K_xx, u_y = -z L_xy + 2 nu K_xy and
    u_z = -z N_x + (1 - 2 nu) L_x. The weighted sum of such an h(s, z) is the real part of the integral of
    (1 - t^2) h(s, z - i t) over t from 0 to 1 (Green, Collins); it is elementary, and short in oblate spheroidal
    coordinates, z = p q and s^2 = (1 + p^2) (1 - q^2): p is 0 on the disc and q on the rest of the surface; far away p
    is the distance and q the cosine of its angle with the axis.
    """
    root = np.sqrt(s_squared + np.square(z) - 1 + 2j * z)
    p, q = np.real(root), np.imag(root)
    angle = np.arctan2(1, p)
    series = angle**2 * (1 / 3 + angle**2 * (1 / 45 + angle**2 * (2 / 945)))
    decay = np.where(p > _FAR, series, 1 - p * angle)
    tail = p * decay
    width = 1 + p**2
    return _DiscSums(
        newton=((1 + q**2) * angle - (3 * q**2 - 1) * tail) / 2,
        sink=2 * q**2 * tail,
        lean=z * (angle - tail) / width,
        spread=q * decay + (1 - q) * (2 + q) / (3 * (1 + q) * width),
        bend=z * (2 + q) / (3 * ((1 + q) * width) ** 2),
        splay=(angle - tail) / (4 * width) + p * (1 - q) * (3 + q) / (6 * ((1 + q) * width) ** 2),
    )


def _radius_and_unit(contact_radius_m: Numbers) -> tuple[Array, Array]:
    """Give the contact radius and the unit of length: the same, but 1 m where nothing touches and all fields are 0."""
    a = np.asarray(_require_not_negative(contact_radius_m, name="contact radius", unit="m"))
    return a, np.where(a > _POINT, a, 1)


def _require_positive(value: Numbers, *, name: str, unit: str) -> None:
    if not np.all((np.asarray(value) > 0) & np.isfinite(value)):
        raise ContactError(f"{name} must be positive and finite, got {np.min(value):.3g} {unit}; give it in {unit}")


def _require_not_negative(value: Numbers, *, name: str, unit: str) -> Numbers:
    """Return a quantity when it is nowhere negative or NaN."""
    if not np.all(np.asarray(value) >= 0):
        raise ContactError(f"{name} must not be negative, got {np.min(value):.3g} {unit}; flip its sign on import")
    return value


def _require_poisson_ratio(value: float) -> float:
    """Return Poisson's ratio when a gel can have it."""
    if not 0 <= value <= 0.5:
        raise ContactError(f"Poisson's ratio must lie in [0, 0.5], got {value:.3g}; rubber is near 0.5")
    return value
