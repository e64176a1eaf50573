"""Contact of a sphere with an elastic half-space: how wide and how deep (Johnson 1985, chapters 3 and 4)."""

import numpy as np

from sliplens.mechanics.checks import Numbers, require_not_negative, require_poisson_ratio, require_positive


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
    require_positive(youngs_modulus_pa, name="Young's modulus", unit="Pa")
    require_poisson_ratio(poisson_ratio)
    return youngs_modulus_pa / (1 - poisson_ratio**2)


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
    force = require_not_negative(normal_force_n, name="normal force", unit="N")
    require_positive(sphere_radius_m, name="sphere radius", unit="m")
    require_positive(reduced_modulus_pa, name="reduced modulus", unit="Pa")
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
    require_positive(sphere_radius_m, name="sphere radius", unit="m")
    return require_not_negative(contact_radius_m, name="contact radius", unit="m") ** 2 / sphere_radius_m


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
    require_positive(sphere_radius_m, name="sphere radius", unit="m")
    a = np.asarray(require_not_negative(contact_radius_m, name="contact radius", unit="m"))
    r = require_not_negative(distance_m, name="distance from the contact's centre", unit="m")
    # infinitely many radii away where nothing touches, so that the slope vanishes there
    s = np.where(a > 0, r / np.where(a > 0, a, 1), np.inf)
    # far away the two terms cancel to 2 / (3 s^2)
    near = np.clip(s, 1, 1e3)
    outside = 2 / np.pi * (near * np.arcsin(1 / near) - np.sqrt(near**2 - 1) / near)
    shape = np.where(s <= 1, np.minimum(s, 1), np.where(s > 1e3, 4 / (3 * np.pi * np.maximum(s, 1) ** 2), outside))
    return a / sphere_radius_m * shape
