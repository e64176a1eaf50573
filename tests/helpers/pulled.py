"""Simulated fingertips that are pulled in a direction of the image."""

from functools import lru_cache

import numpy as np
from jaxtyping import UInt8

from sliplens.grip.fingertip import Fingertip
from sliplens.simulation import CHROMATOUCH, Sensor
from sliplens.simulation.nuisances import Nuisances


@lru_cache(maxsize=64)
def pulled_frames(
    direction_deg: float, seed: int, *, margins: tuple[float, ...] = (0.05, 0.2), sensor: Sensor = CHROMATOUCH
) -> tuple[UInt8[np.ndarray, "height width 3"], UInt8[np.ndarray, "frames height width 3"]]:
    """Untouched sensor, and a frame at each margin, pressed with 1.5 N at a friction of 0.8."""
    nuisances = Nuisances(shear_direction_deg=(direction_deg, direction_deg))
    fingertip = Fingertip(seed=seed, sensor=sensor, nuisances=nuisances)
    force, friction = np.array([1.5]), np.array([0.8])
    films = [fingertip.film(force, friction=friction, margins=np.array([margin])) for margin in margins]
    return fingertip.reference, np.concatenate([film.draw_all() for film in films])
