"""Contact mechanics: a sphere pressed on a flat, partial slip, and the friction cone."""

from sliplens.mechanics.friction import safety_margin, stick_ratio
from sliplens.mechanics.hertz import (
    contact_radius,
    indentation,
    normal_displacement,
    peak_pressure,
    radial_displacement,
    reduced_modulus,
)
from sliplens.mechanics.partial_slip import (
    partial_slip_displacement,
    shear_displacement,
    stick_displacement,
    stick_radius,
)

__all__ = [
    "contact_radius",
    "indentation",
    "normal_displacement",
    "partial_slip_displacement",
    "peak_pressure",
    "radial_displacement",
    "reduced_modulus",
    "safety_margin",
    "shear_displacement",
    "stick_displacement",
    "stick_radius",
    "stick_ratio",
]
