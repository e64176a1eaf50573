"""The friction cone: how much of the available friction is left."""

import numpy as np
from jaxtyping import Float

from sliplens.errors import ContactError
from sliplens.mechanics.checks import Numbers, require_not_negative, require_positive


def safety_margin(
    normal_force_n: Numbers, tangential_force_n: Numbers, friction_coefficient: Numbers
) -> Float[np.ndarray, "..."]:
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
    normal = np.asarray(require_not_negative(normal_force_n, name="normal force", unit="N"))
    tangential = require_not_negative(tangential_force_n, name="tangential force", unit="N")
    if not np.all(np.asarray(friction_coefficient) > 0):
        raise ContactError(
            f"the coefficient of friction must be positive, got {np.min(friction_coefficient):.3g}; "
            "measure it at the onset of slip"
        )
    capacity = normal * friction_coefficient
    pressing = capacity > 0
    used = tangential / np.where(pressing, capacity, 1)
    return np.where(pressing, np.clip(1 - used, 0, 1), np.nan)


def stick_ratio(safety_margin: Numbers, *, profile_exponent: float = 2.0) -> Float[np.ndarray, "..."]:
    """Share of the contact area that sticks, Gamma^(2 / (n + 1)); Gamma^(2/3) for a sphere on a flat.

    Holds for a contact of revolution whose gap grows as r^n, pressed first and pulled after, with the same law of
    friction everywhere (Cattaneo, Mindlin, Jaeger). A cone (n = 1) is the only profile for which the stick ratio is the
    safety margin itself. A grip that grows in proportion with its load sticks fully and does not obey this law.

    Parameters
    ----------
    profile_exponent
        Exponent n of the gap; 2 for a sphere.

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
    require_positive(profile_exponent, name="profile exponent", unit="(no unit)")
    margin = np.asarray(safety_margin, dtype=np.float64)
    if np.any((margin < 0) | (margin > 1)):
        raise ContactError(
            f"safety margins must lie in [0, 1], got {np.nanmin(margin):.3g} to {np.nanmax(margin):.3g}; "
            "give them as fractions, not in percent"
        )
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
