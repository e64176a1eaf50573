"""Displacements of the gel, at its surface and below, where markers lie: under pressure, and in partial slip.

Depth z runs from the unloaded surface (0) into the gel, and so does u_z; the tangential load points along x, and places
are relative to the contact's centre. The fields are closed forms, right to 1e-11 of themselves at any depth and
distance, and 0 where nothing touches (a = 0). Numbers and arrays broadcast: frames can run down and markers across.
"""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from sliplens.mechanics.checks import Numbers, require_not_negative, require_poisson_ratio, require_positive
from sliplens.mechanics.friction import stick_radius

Field: TypeAlias = tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]
SpatialField: TypeAlias = tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."], Float[np.ndarray, "..."]]

_POINT = 1e-30
"""Contacts no larger than this move next to nothing; fourth powers of distances over larger ones stay finite."""
_FAR = 50.0
"""From about this many contact radii on, 1 - p acot p is summed as a series: its terms would cancel."""


def hertz_displacement(
    distance_m: Numbers, depth_m: Numbers, *, contact_radius_m: Numbers, sphere_radius_m: float, poisson_ratio: float
) -> Field:
    """Displacements (u_r, u_z) inside the gel under Hertz's pressure, in metres.

    Unlike the surface, the inside of an incompressible gel is pushed outwards.

    Returns
    -------
    tuple of arrays
        u_r, positive away from the axis, and u_z, positive into the gel.

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
    nu = require_poisson_ratio(poisson_ratio)
    require_positive(sphere_radius_m, name="sphere radius", unit="m")
    r = np.asarray(require_not_negative(distance_m, name="distance from the contact's axis", unit="m"))
    a, unit = _radius_and_unit(contact_radius_m)
    s = r / unit
    disc = _sum_over_disc(s**2, require_not_negative(depth_m, name="depth", unit="m") / unit)
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

    Parameters
    ----------
    peak_strain
        Traction at the centre over the shear modulus, q0 / G.

    Returns
    -------
    tuple of arrays
        u_x, u_y, and u_z, positive into the gel: ahead of the load the gel sinks, behind it rises.

    Raises
    ------
    ContactError
        If a depth or a contact radius is negative, or Poisson's ratio lies outside [0, 0.5].

    References
    ----------
    Johnson (1985), eq. 3.75 summed over the contact; Hanson and Johnson, *J. Tribol.* 115 (1993) 327 (closed forms).
    """
    nu = require_poisson_ratio(poisson_ratio)
    a, unit = _radius_and_unit(contact_radius_m)
    x, y = x_m / unit, y_m / unit
    disc = _sum_over_disc(x**2 + y**2, require_not_negative(depth_m, name="depth", unit="m") / unit)
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
    nu = require_poisson_ratio(poisson_ratio)
    require_positive(sphere_radius_m, name="sphere radius", unit="m")
    friction = require_not_negative(friction_coefficient, name="coefficient of friction", unit="(no unit)")
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


@dataclass(frozen=True, kw_only=True)
class _DiscSums:
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


def _radius_and_unit(contact_radius_m: Numbers) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]:
    """Give the contact radius and the unit of length: the same, but 1 m where nothing touches and all fields are 0."""
    a = np.asarray(require_not_negative(contact_radius_m, name="contact radius", unit="m"))
    return a, np.where(a > _POINT, a, 1)
