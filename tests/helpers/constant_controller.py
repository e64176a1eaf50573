"""Controller that commands a constant force and records its observations."""

from dataclasses import dataclass, field

import numpy as np

from sliplens.grip.controllers import Observation


@dataclass
class Constant:
    """Controller that returns `force_n`, whatever it observes."""

    force_n: float = 2.0
    observations: list[Observation] = field(default_factory=list)

    def command(self, observation: Observation, /) -> np.ndarray:
        self.observations.append(observation)
        return np.array([self.force_n])
