"""What enters the contact mechanics: numbers and arrays, and what they may be."""

from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from sliplens.errors import ContactError

Numbers: TypeAlias = float | Float[np.ndarray, "..."]


def require_positive(value: Numbers, *, name: str, unit: str) -> None:
    """Check that a parameter is finite and positive."""
    if not np.all((np.asarray(value) > 0) & np.isfinite(value)):
        raise ContactError(f"{name} must be positive and finite, got {np.min(value):.3g} {unit}; give it in {unit}")


def require_not_negative(value: Numbers, *, name: str, unit: str) -> Numbers:
    """Return a quantity unchanged when it is nowhere negative or NaN."""
    if not np.all(np.asarray(value) >= 0):
        raise ContactError(f"{name} must not be negative, got {np.min(value):.3g} {unit}; flip its sign on import")
    return value


def require_poisson_ratio(value: float) -> float:
    """Return Poisson's ratio when a gel can have it."""
    if not 0 <= value <= 0.5:
        raise ContactError(f"Poisson's ratio must lie in [0, 0.5], got {value:.3g}; rubber is near 0.5")
    return value
