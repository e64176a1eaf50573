"""Tangential load on a Hertz contact: a stick zone inside an annulus that slips (Cattaneo and Mindlin).

Displacements are those of the gel's surface, in metres, for a load along +x; numbers and arrays broadcast.
"""

from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from sliplens.errors import ContactError
from sliplens.mechanics.checks import Numbers, require_not_negative

Field: TypeAlias = tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]

_POINT = 1e-30
"""Contacts no larger than this move nothing, and squares and cubes of distances over them stay finite."""
_FAR = 100.0
"""Beyond this many contact radii the closed form loses digits to cancellation and its expansion is used."""


def shear_displacement(
    x_m: Numbers, y_m: Numbers, *, contact_radius_m: Numbers, peak_strain: Numbers, poisson_ratio: float
) -> Field:
    """Surface displacements (u_x, u_y) under the traction q0 sqrt(1 - r^2/a^2) along x, in metres.

    Parameters
    ----------
    x_m, y_m
        Position from the contact's centre, in metres; the load points along x.
    contact_radius_m
        Radius a of the loaded circle, in metres; where it is 0 the displacement is 0.
    peak_strain
        Traction at the centre over the shear modulus, q0 / G.
    poisson_ratio
        Poisson's ratio of the gel.

    Raises
    ------
    ContactError
        If a contact radius is negative.

    References
    ----------
    Johnson (1985), eqs. 3.91a, 3.91b (inside) and 3.92 (outside, rearranged).
    """
    nu = poisson_ratio
    a = np.asarray(require_not_negative(contact_radius_m, name="contact radius", unit="m"))
    loaded = a > _POINT
    unit = np.where(loaded, a, 1)
    x, y = x_m / unit, y_m / unit
    s = np.hypot(x, y)

    inside_x = np.pi / 32 * (4 * (2 - nu) - (4 - 3 * nu) * x**2 - (4 - nu) * y**2)
    inside_y = np.pi / 16 * nu * x * y

    beyond = np.clip(s, 1, _FAR)
    root, angle = np.sqrt(beyond**2 - 1), np.arcsin(1 / beyond)
    even = np.where(s > _FAR, 4 / (3 * np.maximum(s, 1)), (2 - beyond**2) * angle + root)
    odd = angle + (2 / beyond**2 - 1) * root / beyond**2
    odd = np.where(s > _FAR, 8 / (3 * np.maximum(s, 1) ** 3), odd)
    outside_x = ((2 - nu) * even + nu / 2 * odd * (x**2 - y**2)) / 8
    outside_y = nu / 8 * odd * x * y

    scale = np.where(loaded, a * peak_strain, 0)
    u_x, u_y = scale * np.where(s <= 1, inside_x, outside_x), scale * np.where(s <= 1, inside_y, outside_y)
    return np.asarray(u_x), np.asarray(u_y)


def stick_radius(contact_radius_m: Numbers, safety_margin: Numbers) -> Numbers:
    """Radius c = a Gamma^(1/3) of the circle that still sticks, in metres.

    Parameters
    ----------
    contact_radius_m
        Contact radius a, in metres.
    safety_margin
        Gamma, 0 to 1.

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


def partial_slip_displacement(
    x_m: Numbers,
    y_m: Numbers,
    *,
    contact_radius_m: Numbers,
    sphere_radius_m: float,
    friction_coefficient: Numbers,
    safety_margin: Numbers,
    poisson_ratio: float,
) -> Field:
    """Surface displacements (u_x, u_y) of a pressed sphere under a growing tangential load along x, in metres.

    The full-slip traction mu p over the contact, less the same over the stick zone. The stick zone moves as one piece.

    Parameters
    ----------
    x_m, y_m
        Position from the contact's centre, in metres.
    contact_radius_m
        Contact radius a, in metres.
    sphere_radius_m
        Radius R of the sphere, in metres.
    friction_coefficient
        Coefficient of friction mu.
    safety_margin
        Gamma = 1 - Q / (mu P), 0 to 1.
    poisson_ratio
        Poisson's ratio of the gel.

    Raises
    ------
    ContactError
        If a contact radius is negative or a margin lies outside [0, 1].

    References
    ----------
    Johnson (1985), section 7.2.

    Examples
    --------
    The stick zone moves as one piece; the rim of the contact stays behind:

    >>> import numpy as np
    >>> from sliplens.mechanics import partial_slip_displacement
    >>> grip = {"friction_coefficient": 0.5, "safety_margin": 0.125, "poisson_ratio": 0.5}
    >>> x_m = np.array([0.0, 0.002, 0.004])
    >>> u_x, _ = partial_slip_displacement(x_m, 0.0, contact_radius_m=0.004, sphere_radius_m=0.02, **grip)
    >>> (u_x[1:] / u_x[0]).round(2)
    array([1.  , 0.68])
    """
    stick_m = stick_radius(contact_radius_m, safety_margin)
    strain_per_metre = _peak_strain(1.0, friction_coefficient, sphere_radius_m, poisson_ratio)
    whole_x, whole_y = shear_displacement(
        x_m,
        y_m,
        contact_radius_m=contact_radius_m,
        peak_strain=strain_per_metre * contact_radius_m,
        poisson_ratio=poisson_ratio,
    )
    # the stick zone's traction is mu p0 c / a, and p0 / a does not depend on the load
    stuck_x, stuck_y = shear_displacement(
        x_m, y_m, contact_radius_m=stick_m, peak_strain=strain_per_metre * stick_m, poisson_ratio=poisson_ratio
    )
    return np.asarray(whole_x - stuck_x), np.asarray(whole_y - stuck_y)


def stick_displacement(
    *,
    contact_radius_m: Numbers,
    sphere_radius_m: float,
    friction_coefficient: Numbers,
    safety_margin: Numbers,
    poisson_ratio: float,
) -> Numbers:
    """Displacement of the stick zone along the load, 3 mu P (2 - nu) / (16 G a) (1 - c^2/a^2), in metres.

    Parameters
    ----------
    contact_radius_m
        Contact radius a, in metres.
    sphere_radius_m
        Radius R of the sphere, in metres.
    friction_coefficient
        Coefficient of friction mu.
    safety_margin
        Gamma, 0 to 1; at 0 the value is the displacement at which full slip begins.
    poisson_ratio
        Poisson's ratio of the gel.

    References
    ----------
    Johnson (1985), eq. 7.42a for one elastic body.
    """
    strain = _peak_strain(contact_radius_m, friction_coefficient, sphere_radius_m, poisson_ratio)
    full = np.pi * (2 - poisson_ratio) / 8 * strain * contact_radius_m
    return full * (1 - np.cbrt(np.asarray(safety_margin)) ** 2)


def _peak_strain(
    contact_radius_m: Numbers, friction_coefficient: Numbers, sphere_radius_m: float, poisson_ratio: float
) -> Numbers:
    """Give mu p0 / G, with p0 / G = 4 a / (pi (1 - nu) R)."""
    return 4 * friction_coefficient * contact_radius_m / (np.pi * (1 - poisson_ratio) * sphere_radius_m)
