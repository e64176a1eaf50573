"""The load on the fingertip through a trial: touch, press, hold, pull until it slips, slide on."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sliplens.errors import ContactError
from sliplens.mechanics import safety_margin, stick_ratio
from sliplens.recordings import ContactState
from sliplens.simulation.nuisances import Grasp

TRIAL_S = 8.0
"""Length of a trial in seconds."""

_PHASES = (0.06, 0.07, 0.07, 0.72, 0.08)
"""Shares of a trial: no contact, press, hold, pull, slide; the pull gets most, for its margins are what is learnt."""

MINIMUM_FRAMES = 20
"""Fewer frames leave a phase empty."""


@dataclass(frozen=True, kw_only=True)
class Loading:
    """Forces and labels of every frame of a trial.

    The friction coefficient is the one that holds: static until the contact slips, kinetic after, so that the margin
    of a sliding contact is 0 and every margin is 1 - F_t / (mu F_n). Without contact the margin is NaN.
    """

    time_s: Float[np.ndarray, " frames"]
    normal_force_n: Float[np.ndarray, " frames"]
    tangential_force_n: Float[np.ndarray, " frames"]
    friction_coefficient: Float[np.ndarray, " frames"]
    safety_margin: Float[np.ndarray, " frames"]
    stick_ratio: Float[np.ndarray, " frames"]
    held_s: Float[np.ndarray, " frames"]
    """Time since the object was touched; 0 before."""
    contact_state: tuple[ContactState, ...]


def load_grasp(grasp: Grasp, *, frames: int, rng: np.random.Generator) -> Loading:
    """Load a grasp: press to its force, hold, pull with an evenly falling margin, then slide.

    Parameters
    ----------
    grasp
        The trial's draws.
    frames
        Frames in the trial.
    rng
        Source of the pull's small unevenness.

    Raises
    ------
    ContactError
        If the frames are too few for every phase to have one.
    """
    if frames < MINIMUM_FRAMES:
        raise ContactError(f"a trial of {frames} frames cannot hold all phases; ask for {MINIMUM_FRAMES} or more")
    touch, pressed, pull, slide = _phase_ends(frames, rng)
    index = np.arange(frames)
    progress = index / (frames - 1)
    time_s = index * (TRIAL_S / frames)

    ramp = np.clip((index - touch + 1) / (pressed - touch), 0, 1)
    # a smooth start and stop of the press, as a servo makes it
    normal = grasp.normal_force_n * ramp**2 * (3 - 2 * ramp) * (1 + grasp.normal_force_drift * (progress - 0.5) * 2)
    normal[index < touch] = 0
    friction = grasp.friction * (1 + grasp.friction_drift * (progress - 0.5) * 2)
    friction[index >= slide] *= grasp.kinetic_ratio

    pulled = np.clip((index - pull) / (slide - pull), 0, 1)
    # a slow swing of the puller, small enough that the margin never rises
    swing = rng.uniform(-0.5, 0.5) * np.sin(2 * np.pi * pulled) / (2 * np.pi)
    tangential = np.clip(pulled + swing, 0, 1) * friction * normal
    return _label(
        time_s,
        normal=normal,
        # while sliding, rounding alone would leave a margin of 1e-16
        tangential=np.where(index >= slide, np.nextafter(tangential, np.inf), tangential),
        friction=friction,
        held_s=np.where(index < touch, 0, time_s - time_s[touch]),
    )


def load_at_margins(margins: Float[np.ndarray, " frames"], *, grasp: Grasp) -> Loading:
    """Load a grasp so that its frames have given margins, at its full normal force; NaN is no contact.

    Parameters
    ----------
    margins
        Gamma, 0 to 1.
    grasp
        Force and friction; drift, creep and the kinetic ratio are left out.

    Raises
    ------
    ContactError
        If a margin lies outside [0, 1].
    """
    if np.any((margins < 0) | (margins > 1)):
        raise ContactError("safety margins must lie in [0, 1]; give them as fractions, not in percent")
    normal = np.where(np.isnan(margins), 0.0, grasp.normal_force_n)
    friction = np.full(len(margins), grasp.friction)
    tangential = (1 - np.nan_to_num(margins, nan=1.0)) * friction * normal
    seconds = np.arange(len(margins), dtype=np.float64)
    return _label(seconds, normal=normal, tangential=tangential, friction=friction, held_s=np.zeros(len(margins)))


def _label(
    time_s: Float[np.ndarray, " frames"],
    *,
    normal: Float[np.ndarray, " frames"],
    tangential: Float[np.ndarray, " frames"],
    friction: Float[np.ndarray, " frames"],
    held_s: Float[np.ndarray, " frames"],
) -> Loading:
    margin = safety_margin(normal, tangential, friction)
    return Loading(
        time_s=time_s,
        normal_force_n=normal,
        tangential_force_n=tangential,
        friction_coefficient=friction,
        safety_margin=margin,
        stick_ratio=stick_ratio(margin),
        held_s=held_s,
        contact_state=tuple(_state(value) for value in margin),
    )


def _phase_ends(frames: int, rng: np.random.Generator) -> tuple[int, int, int, int]:
    """First frame after each phase but the last, the lengths varied by a fifth; the pull takes what is left."""
    shares = np.asarray(_PHASES)
    lengths = np.maximum(1, np.round(frames * shares * rng.uniform(0.8, 1.2, len(shares)))).astype(int)
    lengths[3] = frames - lengths[:3].sum() - lengths[4]
    ends = np.cumsum(lengths)
    return int(ends[0]), int(ends[1]), int(ends[2]), int(ends[3])


def _state(margin: float) -> ContactState:
    if np.isnan(margin):
        return ContactState.NO_CONTACT
    if margin >= 1:
        return ContactState.CONTACT
    return ContactState.INCIPIENT_SLIP if margin > 0 else ContactState.FULL_SLIP
