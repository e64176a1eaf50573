"""Frictionless contact of a sphere with an elastic half-space.

All formulas are Johnson, *Contact Mechanics* (Cambridge, 1985), chapters 3 and 4. Displacements are those of the
surface; numbers and arrays broadcast, so that frames can run down and markers across.
"""

import numpy as np

from sliplens.mechanics.checks import Numbers, require_not_negative, require_poisson_ratio, require_positive


def reduced_modulus(*, youngs_modulus_pa: float, poisson_ratio: float) -> float:
    """Plane-strain modulus E* = E / (1 - nu^2) of a gel against a rigid body, in pascals.

    Parameters
    ----------
    youngs_modulus_pa
        Young's modulus of the gel, in pascals.
    poisson_ratio
        Poisson's ratio of the gel, 0 to 0.5.

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

    Parameters
    ----------
    normal_force_n
        Normal force P in newtons, positive when pressing; 0 gives 0.
    sphere_radius_m
        Radius R of the sphere, in metres.
    reduced_modulus_pa
        E* in pascals; see `reduced_modulus`.

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

    Parameters
    ----------
    contact_radius_m
        Contact radius a, in metres.
    sphere_radius_m
        Radius R of the sphere, in metres.

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


def peak_pressure(contact_radius_m: Numbers, *, sphere_radius_m: float, reduced_modulus_pa: Numbers) -> Numbers:
    """Pressure at the centre, p0 = 2 E* a / (pi R) = 3 P / (2 pi a^2), in pascals.

    Written with the contact radius, it is also right where nothing touches (a = P = 0).

    Parameters
    ----------
    contact_radius_m
        Contact radius a, in metres.
    sphere_radius_m
        Radius R of the sphere, in metres.
    reduced_modulus_pa
        E* in pascals.

    Raises
    ------
    ContactError
        If the contact radius is negative, or the sphere's radius or the modulus is not positive.

    References
    ----------
    Johnson (1985), eq. 4.24.

    Examples
    --------
    >>> from sliplens.mechanics import peak_pressure
    >>> round(peak_pressure(0.005, sphere_radius_m=0.02, reduced_modulus_pa=60e3))  # 3 P / (2 pi a^2) with P = 0.5 N
    9549
    """
    require_positive(sphere_radius_m, name="sphere radius", unit="m")
    require_positive(reduced_modulus_pa, name="reduced modulus", unit="Pa")
    radius = require_not_negative(contact_radius_m, name="contact radius", unit="m")
    return 2 * reduced_modulus_pa * radius / (np.pi * sphere_radius_m)


def normal_displacement(distance_m: Numbers, *, contact_radius_m: Numbers, sphere_radius_m: float) -> Numbers:
    """Surface displacement u_z into the gel under Hertz's pressure, in metres.

    Inside the contact delta - r^2 / (2 R); outside (delta / pi) [(2 - r^2/a^2) asin(a/r) + sqrt(r^2/a^2 - 1)]. The load
    and the modulus enter through a alone.

    Parameters
    ----------
    distance_m
        Distance r from the contact's centre, along the surface, in metres.
    contact_radius_m
        Contact radius a, in metres; where it is 0 the displacement is 0.
    sphere_radius_m
        Radius R of the sphere, in metres.

    Raises
    ------
    ContactError
        If a distance or a contact radius is negative, or the sphere's radius is not positive.

    References
    ----------
    Johnson (1985), eqs. 3.41a and 3.42a with p0 of eq. 4.24.

    Examples
    --------
    At the contact's edge the surface has sunk by half as much as in its middle:

    >>> import numpy as np
    >>> from sliplens.mechanics import normal_displacement
    >>> u_z = normal_displacement(np.array([0.0, 0.004]), contact_radius_m=0.004, sphere_radius_m=0.02)
    >>> (1e3 * u_z).round(3)
    array([0.8, 0.4])
    """
    depth = indentation(contact_radius_m, sphere_radius_m=sphere_radius_m)
    s = _relative_distance(distance_m, contact_radius_m)
    beyond = np.maximum(s, 1)
    inside = 1 - np.minimum(s, 1) ** 2 / 2
    # asin and sqrt cancel to order s^-1; far away (s > 1e4) the leading term 4/(3 pi s) is the exact one
    near = np.minimum(beyond, 1e4)
    outside = ((2 - near**2) * np.arcsin(1 / near) + np.sqrt(near**2 - 1)) / np.pi
    shape = np.where(s <= 1, inside, np.where(beyond > 1e4, 4 / (3 * np.pi * beyond), outside))
    return depth * shape


def normal_slope(distance_m: Numbers, *, contact_radius_m: Numbers, sphere_radius_m: float) -> Numbers:
    """Slope -du_z/dr of the surface under Hertz's pressure, the ratio of its rise to the way from the dent's centre.

    Inside the contact r / R; outside (2 a / (pi R)) [s asin(1/s) - sqrt(s^2 - 1) / s] with s = r/a.

    Parameters
    ----------
    distance_m
        Distance r from the contact's centre, along the surface, in metres.
    contact_radius_m
        Contact radius a, in metres; where it is 0 the slope is 0.
    sphere_radius_m
        Radius R of the sphere, in metres.

    Raises
    ------
    ContactError
        If a distance or a contact radius is negative, or the sphere's radius is not positive.

    References
    ----------
    The derivative of Johnson (1985), eqs. 3.41a and 3.42a with p0 of eq. 4.24.
    """
    require_positive(sphere_radius_m, name="sphere radius", unit="m")
    a = require_not_negative(contact_radius_m, name="contact radius", unit="m")
    s = _relative_distance(distance_m, a)
    # far away the two terms cancel to 2 / (3 s^2)
    near = np.clip(s, 1, 1e3)
    outside = 2 / np.pi * (near * np.arcsin(1 / near) - np.sqrt(near**2 - 1) / near)
    shape = np.where(s <= 1, np.minimum(s, 1), np.where(s > 1e3, 4 / (3 * np.pi * np.maximum(s, 1) ** 2), outside))
    return a / sphere_radius_m * shape


def radial_displacement(
    distance_m: Numbers, *, contact_radius_m: Numbers, sphere_radius_m: float, poisson_ratio: float
) -> Numbers:
    """Surface displacement u_r away from the contact's centre under Hertz's pressure, in metres.

    -(1 - 2 nu) (1 + nu) p0 a^2 / (3 E r) [1 - (1 - r^2/a^2)^1.5], the bracket being 1 outside; negative, for the
    surface is drawn inwards, and 0 for an incompressible gel.

    Parameters
    ----------
    distance_m
        Distance r from the contact's centre, along the surface, in metres.
    contact_radius_m
        Contact radius a, in metres; where it is 0 the displacement is 0.
    sphere_radius_m
        Radius R of the sphere, in metres.
    poisson_ratio
        Poisson's ratio of the gel.

    Raises
    ------
    ContactError
        If a distance or a contact radius is negative, or the sphere's radius is not positive.

    References
    ----------
    Johnson (1985), eqs. 3.41b and 3.42b with p0 of eq. 4.24.
    """
    depth = indentation(contact_radius_m, sphere_radius_m=sphere_radius_m)
    s = _relative_distance(distance_m, contact_radius_m)
    bracket = 1 - np.maximum(1 - s**2, 0) ** 1.5
    # near the centre the bracket loses its digits; its series is exact to 6e-17 there
    centre = s < 1e-3
    profile = np.where(centre, 1.5 * s - 0.375 * np.where(centre, s, 0) ** 3, bracket / np.where(centre, 1, s))
    factor = -2 * (1 - 2 * poisson_ratio) / (3 * np.pi * (1 - poisson_ratio))
    return factor * depth * np.where(np.isinf(s), 0, profile)


def _relative_distance(distance_m: Numbers, contact_radius_m: Numbers) -> Numbers:
    """Give r / a; infinite where nothing touches, so that every field vanishes there."""
    r = np.asarray(require_not_negative(distance_m, name="distance from the contact's centre", unit="m"))
    a = np.asarray(contact_radius_m)
    return np.where(a > 0, r / np.where(a > 0, a, 1), np.inf)
