"""Parallel gripper that lifts an object with two soft fingertips: forces, friction and motion, many at once.

Symbols: grip force F, the same on both fingers; tangential force f of a finger on the object, positive upwards; static
friction mu_s and kinetic mu_k; mass m. Heights run upwards, pulls downwards. Arrays hold one value an episode, or one
an episode and finger.
"""

import math
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from sliplens.errors import ContactError
from sliplens.mechanics import safety_margin

GRAVITY_M_S2 = 9.81
"""Acceleration of gravity, in metres a second squared."""
PERIOD_S = 1 / 60
"""Time between two images, and between two commands, in seconds."""

Episodes: TypeAlias = Float[np.ndarray, " episodes"]
Fingers: TypeAlias = Float[np.ndarray, "episodes 2"]


@dataclass(frozen=True, kw_only=True)
class GrippedObject:
    """Mass, stiffness and strength of an object."""

    mass_kg: tuple[float, float]
    """Smallest and largest mass."""
    stiffness_n_m: float
    """Stiffness of its sides under the fingertips: force grows slowly on a soft object."""
    crush_n: float
    """Grip force that breaks it."""
    grip_length_m: float
    """Slip after which it has left the fingers."""


OBJECTS = {
    # a paper cup with water, a raw egg, a berry box; typical values (assumed)
    "cup": GrippedObject(mass_kg=(0.02, 0.11), stiffness_n_m=3_000.0, crush_n=6.0, grip_length_m=0.03),
    "egg": GrippedObject(mass_kg=(0.045, 0.07), stiffness_n_m=50_000.0, crush_n=25.0, grip_length_m=0.02),
    "berries": GrippedObject(mass_kg=(0.03, 0.12), stiffness_n_m=1_500.0, crush_n=3.5, grip_length_m=0.03),
}
"""Objects by name."""


@dataclass(frozen=True, kw_only=True)
class GripperModel:
    """Fingers and force actuator of a gripper; a value that is not positive is a `ContactError`."""

    finger_stiffness_n_m: float = 4_000.0
    """Stiffness of one fingertip against the press."""
    shear_stiffness_n_m: float = 1_500.0
    """Stiffness of one fingertip against the pull; physics of the thesis's sensor (assumed)."""
    shear_damping_n_s_m: float = 3.0
    lag_s: float = 0.05
    """Time constant of the force actuator."""
    closing_speed_m_s: float = 0.02
    """Speed of the closing fingers; with the stiffness it limits the rate of the force."""
    resolution_n: float = 0.02
    """Step of the commanded forces."""
    ceiling_n: float = 4.0
    """Largest force, whatever the command."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise ContactError(f"{name} of the gripper must be positive, got {value:.3g}")

    def force_rate(self, gripped: GrippedObject) -> float:
        """Compute the largest rate of the force, in newtons a second: fingers and object are springs in a row."""
        return self.closing_speed_m_s / (2 / self.finger_stiffness_n_m + 1 / gripped.stiffness_n_m)


@dataclass(frozen=True, kw_only=True)
class World:
    """Loads on the gripped objects, and the motion of the hand, during one step."""

    mass_kg: Episodes
    friction: Fingers
    """Coefficient of static friction of each finger."""
    kinetic_ratio: Episodes
    """Kinetic over static friction."""
    pull_n: Episodes
    """Force on the object besides its weight, positive downwards."""
    hand_m: Episodes
    """Height of the hand as the step begins; the object stands on a table at 0."""
    hand_speed_m_s: Episodes
    """Speed of the hand upwards through the step."""


@dataclass(frozen=True, kw_only=True)
class PlantState:
    """Positions, forces and friction after a step."""

    time_s: float
    force_n: Episodes
    """Grip force on each finger."""
    height_m: Episodes
    speed_m_s: Episodes
    anchor_m: Fingers
    """Position on the object, against the hand, at which each fingertip's skin is at rest."""
    shear_n: Fingers
    """Tangential force of each finger on the object, positive upwards."""
    sliding: Bool[np.ndarray, "episodes 2"]
    slip_m: Fingers
    """Distance that each fingertip has slid on the object."""
    friction: Fingers
    """Static friction in the last step."""
    kinetic_ratio: Episodes
    held_s: Episodes
    """Time since the fingers touched."""
    dropped: Bool[np.ndarray, " episodes"]
    crushed: Bool[np.ndarray, " episodes"]

    @property
    def margin(self) -> Fingers:
        """True safety margin of each finger; 0 while it slides, NaN where nothing presses."""
        margin = safety_margin(self.force_n[:, None], np.abs(self.shear_n), self.friction)
        return np.where(self.sliding & (self.force_n[:, None] > 0), 0.0, margin)

    @property
    def holding_friction(self) -> Fingers:
        """Coefficient of friction in effect: kinetic where the finger slides."""
        return self.friction * np.where(self.sliding, self.kinetic_ratio[:, None], 1.0)

    @property
    def slipped_m(self) -> Episodes:
        """Slip of the finger that slid farther."""
        return self.slip_m.max(axis=1)

    @property
    def load_n(self) -> Episodes:
        """Force that both fingers carry together, as a force sensor at the wrist measures it."""
        return self.shear_n.sum(axis=1)


class Plant:
    """Grippers holding objects, one an episode, stepped together.

    The object moves as m a = f_1 + f_2 - m g - pull, with a table below. A finger's shear is a damped spring between
    object and hand as long as |f| <= mu_s F; beyond, it slides with mu_k F until it comes to rest against the object
    (an elasto-plastic slider). The grip force follows its command with a lag, no faster than the fingers close, in
    steps, and never above the ceiling.
    """

    def __init__(
        self, gripped: GrippedObject, *, episodes: int = 1, model: GripperModel | None = None, substeps: int = 16
    ) -> None:
        self.gripped, self.model, self.substeps = gripped, GripperModel() if model is None else model, substeps
        nothing, fingers = np.zeros(episodes), np.zeros((episodes, 2))
        no = np.zeros(episodes, dtype=bool)
        self.state = PlantState(
            time_s=0.0, force_n=nothing, height_m=nothing, speed_m_s=nothing, anchor_m=fingers, shear_n=fingers,
            sliding=np.zeros((episodes, 2), dtype=bool), slip_m=fingers, friction=np.ones((episodes, 2)),
            kinetic_ratio=np.ones(episodes), held_s=nothing, dropped=no, crushed=no,
        )  # fmt: skip

    def step(self, command_n: Episodes, world: World, *, duration_s: float = PERIOD_S) -> PlantState:
        """Step by one period under a commanded grip force and loads on the objects.

        The force stays between 0 and the ceiling, whatever the command; NaN holds. Dropped objects stay unchanged.
        """
        old, model = self.state, self.model
        stiffness, damping = model.shear_stiffness_n_m, model.shear_damping_n_s_m
        command_n = np.where(np.isnan(command_n), old.force_n, command_n)
        command_n = np.clip(np.round(command_n / model.resolution_n) * model.resolution_n, 0, model.ceiling_n)
        dt = duration_s / self.substeps
        share, most = 1 - math.exp(-dt / model.lag_s), model.force_rate(self.gripped) * dt
        static, kinetic = world.friction, world.friction * world.kinetic_ratio[:, None]
        weight, inverse = world.mass_kg * GRAVITY_M_S2 + world.pull_n, dt / world.mass_kg
        force, height, speed = old.force_n, old.height_m, old.speed_m_s
        anchor, sliding, slip, crushed = old.anchor_m, old.sliding, old.slip_m, old.crushed
        shear = old.shear_n
        for number in range(self.substeps):
            force = force + np.clip(share * (command_n - force), -most, most)
            hand = world.hand_m + world.hand_speed_m_s * (number * dt)
            apart = (hand - height)[:, None]
            trial = stiffness * (apart - anchor) + damping * (world.hand_speed_m_s - speed)[:, None]
            slides = np.abs(trial) > np.where(sliding, kinetic, static) * force[:, None]
            shear = np.where(slides, np.sign(trial) * kinetic * force[:, None], trial)
            slid = np.where(slides, apart - shear / stiffness - anchor, 0.0)
            anchor, slip, sliding = anchor + slid, slip + np.abs(slid), slides
            speed = speed + inverse * (shear.sum(axis=1) - weight)
            height = height + dt * speed
            # the table holds what would fall through it
            standing = height <= 0
            speed, height = np.where(standing, np.maximum(speed, 0), speed), np.maximum(height, 0)
            crushed = crushed | (force > self.gripped.crush_n)
        new = PlantState(
            time_s=old.time_s + duration_s, force_n=force, height_m=height, speed_m_s=speed, anchor_m=anchor,
            shear_n=shear, sliding=sliding, slip_m=slip, friction=static, kinetic_ratio=world.kinetic_ratio,
            held_s=np.where(force > 0, old.held_s + duration_s, 0.0),
            dropped=old.dropped | (slip.max(axis=1) > self.gripped.grip_length_m), crushed=crushed,
        )  # fmt: skip
        if old.dropped.any():
            fallen = {
                name: np.where(old.dropped if before.ndim == 1 else old.dropped[:, None], before, getattr(new, name))
                for name, before in vars(old).items()
                if name != "time_s"
            }
            new = replace(new, **fallen)
        self.state = new
        return new


def least_force(world: World, *, hand_acceleration_m_s2: float = 0.0) -> Episodes:
    """Compute the least grip force that holds, in newtons: (m (g + a) + pull) over the sum of both mu_s."""
    load = world.mass_kg * (GRAVITY_M_S2 + hand_acceleration_m_s2) + world.pull_n
    return np.maximum(load, 0) / world.friction.sum(axis=1)
