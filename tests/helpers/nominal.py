"""Sensors without the differences between built ones."""

import numpy as np

from sliplens.simulation.nuisances import Unit


def nominal_unit(markers: int) -> Unit:
    """Sensor built exactly as drawn, with so many markers."""
    ones = np.ones(markers)
    return Unit(
        marker_jitter_px=np.zeros((markers, 2)),
        marker_depth=0.0,
        radius_factor=ones,
        contrast_factor=ones,
        texture_seed=0,
    )
