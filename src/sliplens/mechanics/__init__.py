"""Contact mechanics: a sphere pressed on a gel and pulled along it, and how much of the friction is left.

Symbols, with SI units: normal force P or F_n, positive when pressing, and tangential force Q or F_t; coefficient of
friction mu; safety margin Gamma; radius R of the sphere, a of the contact and c of its part that sticks; of the gel
Young's modulus E, shear modulus G, Poisson's ratio nu and reduced modulus E*. Johnson (1985) is *Contact Mechanics*,
Cambridge University Press.
"""

from sliplens.mechanics.displacement import hertz_displacement, partial_slip_displacement, shear_displacement
from sliplens.mechanics.friction import safety_margin, stick_radius, stick_ratio
from sliplens.mechanics.hertz import contact_radius, indentation, normal_slope, reduced_modulus

__all__ = [
    "contact_radius",
    "hertz_displacement",
    "indentation",
    "normal_slope",
    "partial_slip_displacement",
    "reduced_modulus",
    "safety_margin",
    "shear_displacement",
    "stick_radius",
    "stick_ratio",
]
