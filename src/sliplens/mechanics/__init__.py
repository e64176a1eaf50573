"""Contact mechanics: a sphere pressed on a flat, partial slip, and the friction cone."""

from sliplens.mechanics.friction import safety_margin, stick_ratio
from sliplens.mechanics.hertz import (
    contact_radius,
    indentation,
    normal_displacement,
    normal_slope,
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
from sliplens.mechanics.subsurface import (
    buried_hertz_displacement,
    buried_partial_slip_displacement,
    buried_shear_displacement,
)

__all__ = [
    "buried_hertz_displacement",
    "buried_partial_slip_displacement",
    "buried_shear_displacement",
    "contact_radius",
    "indentation",
    "normal_displacement",
    "normal_slope",
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
