"""A trial made by hand, of which everything is known."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from sliplens.recordings.capture import Forces
from sliplens.recordings.labelling import ForceAxes
from sliplens.recordings.labels.axes import ContactForces, apply_axes
from sliplens.recordings.labels.margin import FoundLabels, label_trial
from sliplens.recordings.options import LabelSettings

FORCE_HZ, FRAME_HZ = 500, 30
TOUCH_S, PULL_S, SLIP_S, END_S = 0.6, 1.5, 4.5, 5.5
NORMAL_N, STATIC, KINETIC, FALL_S = 1.5, 0.6, 0.48, 0.03


def normal_force(time_s: np.ndarray) -> np.ndarray:
    """Pressed within half a second from the touch on, then held."""
    return NORMAL_N * np.clip((time_s - TOUCH_S) / 0.5, 0, 1)


def ratio(time_s: np.ndarray) -> np.ndarray:
    """F_t / F_n: even rise to static friction, a sudden fall to kinetic."""
    rising = STATIC * np.clip((time_s - PULL_S) / (SLIP_S - PULL_S), 0, 1)
    return rising - (STATIC - KINETIC) * np.clip((time_s - SLIP_S) / FALL_S, 0, 1)


@dataclass(frozen=True, kw_only=True)
class Trial:
    """Times of frames and samples, and what the force sensor would record."""

    time_s: np.ndarray
    contact_n: np.ndarray
    """Normal, then two tangential components."""
    frame_time_s: np.ndarray
    motion: np.ndarray
    """In proportion to the change of the force from frame to frame."""

    def forces(
        self,
        *,
        noise_n: float = 0.0,
        rng: np.random.Generator | None = None,
        tare_n: tuple[float, float, float] = (0.0, 0.0, 0.0),
        order: tuple[int, int, int] = (0, 1, 2),
        sign: int = 1,
    ) -> Forces:
        """As recorded: the normal force is in the column where `order` has its 0."""
        force = (self.contact_n * np.array([sign, 1, 1]))[:, list(order)] + np.array(tare_n)
        return self.record(force if rng is None else force + rng.normal(0, noise_n, force.shape))

    def record(self, force_n: np.ndarray) -> Forces:
        """Other forces at the same times."""
        return Forces(time_s=self.time_s, force_n=force_n, source="sensor")

    @property
    def truth(self) -> np.ndarray:
        """Safety margin of the frames, up to the slip."""
        return 1 - ratio(self.frame_time_s) / STATIC

    def label(self, forces: Forces, **settings: Any) -> FoundLabels:
        """Label the frames."""
        rng = np.random.default_rng(2)
        return label_trial(self.frame_time_s, self.motion, forces, settings=LabelSettings(**settings), rng=rng)

    def contact(self, *, noise_n: float = 0.0, rng: np.random.Generator | None = None) -> ContactForces:
        """In the axes of the contact, with the right axes and no tare."""
        axes = ForceAxes(
            normal="x",
            sign=1,
            tare_n=(0.0, 0.0, 0.0),
            noise_n=(noise_n, noise_n, noise_n),
            tare_sigma_n=(0.0, 0.0, 0.0),
            still_until_s=TOUCH_S,
        )
        return apply_axes(self.forces(noise_n=noise_n, rng=rng), axes)


def make_trial(*, slips: bool = True) -> Trial:
    time = np.arange(0, END_S, 1 / FORCE_HZ)
    pulled = ratio(time if slips else np.minimum(time, SLIP_S - 0.5))
    normal = normal_force(time)
    contact = np.stack((normal, 0.6 * pulled * normal, -0.8 * pulled * normal), axis=1)
    frame_time = np.arange(0.01, END_S - 0.01, 1 / FRAME_HZ)
    at_frames = np.stack([np.interp(frame_time, time, column) for column in contact.T], axis=1)
    motion = 0.7 + np.append(0, 3 * np.linalg.norm(np.diff(at_frames, axis=0), axis=1))
    return Trial(time_s=time, contact_n=contact, frame_time_s=frame_time, motion=motion)


@pytest.fixture
def trial() -> Trial:
    return make_trial()


@pytest.fixture
def trial_without_slip() -> Trial:
    return make_trial(slips=False)
