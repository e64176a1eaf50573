"""Parallel gripper that lifts an object with two soft fingertips, and the events of an episode; many at once.

Symbols: grip force F, the same on both fingers; tangential force f of a finger on the object, positive upwards; static
friction mu_s and kinetic mu_k; mass m. Heights run upwards, pulls downwards. Arrays hold one value an episode, or one
an episode and finger.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from sliplens.codec import Columns
from sliplens.errors import InputError
from sliplens.extras import pick
from sliplens.mechanics import safety_margin

GRAVITY_M_S2 = 9.81
"""Acceleration of gravity, in metres a second squared."""
PERIOD_S = 1 / 60
"""Time between two images, and between two commands, in seconds."""
LATENCY_S = 0.02
"""Time from an image to the command by it, in seconds."""

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

FINGER_STIFFNESS_N_M = 4_000.0
"""Stiffness of one fingertip against the press."""
SHEAR_STIFFNESS_N_M, SHEAR_DAMPING_N_S_M = 1_500.0, 3.0
"""Stiffness and damping of one fingertip against the pull; physics of the thesis's sensor (assumed)."""
LAG_S = 0.05
"""Time constant of the force actuator."""
CLOSING_SPEED_M_S = 0.02
"""Speed of the closing fingers; with the stiffness it limits the rate of the force."""
_RESOLUTION_N = 0.02  # step of the commanded forces


@dataclass(frozen=True, kw_only=True)
class World:
    """Loads on the gripped objects during one step."""

    mass_kg: Episodes
    friction: Fingers
    """Coefficient of static friction of each finger."""
    kinetic_ratio: Episodes
    """Kinetic over static friction."""
    pull_n: Episodes
    """Force on the object besides its weight, positive downwards."""


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
        self, gripped: GrippedObject, *, episodes: int = 1, ceiling_n: float = 4.0, substeps: int = 16
    ) -> None:
        self.gripped, self.ceiling_n, self.substeps = gripped, ceiling_n, substeps
        # fingers and object are springs in a row
        self.most_n_s = CLOSING_SPEED_M_S / (2 / FINGER_STIFFNESS_N_M + 1 / gripped.stiffness_n_m)
        """Largest rate of the force."""
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
        old = self.state
        stiffness, damping = SHEAR_STIFFNESS_N_M, SHEAR_DAMPING_N_S_M
        command_n = np.where(np.isnan(command_n), old.force_n, command_n)
        command_n = np.clip(np.round(command_n / _RESOLUTION_N) * _RESOLUTION_N, 0, self.ceiling_n)
        dt = duration_s / self.substeps
        share, most = 1 - math.exp(-dt / LAG_S), self.most_n_s * dt
        hand_m, hand_m_s, _ = hand_motion(old.time_s)
        static, kinetic = world.friction, world.friction * world.kinetic_ratio[:, None]
        weight, inverse = world.mass_kg * GRAVITY_M_S2 + world.pull_n, dt / world.mass_kg
        force, height, speed = old.force_n, old.height_m, old.speed_m_s
        anchor, sliding, slip, crushed = old.anchor_m, old.sliding, old.slip_m, old.crushed
        shear = old.shear_n
        for number in range(self.substeps):
            force = force + np.clip(share * (command_n - force), -most, most)
            apart = (hand_m + hand_m_s * (number * dt) - height)[:, None]
            trial = stiffness * (apart - anchor) + damping * (hand_m_s - speed)[:, None]
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
        arrays = {name: before for name, before in vars(old).items() if name != "time_s"}
        dropped = {1: old.dropped, 2: old.dropped[:, None]}
        states = {name: np.where(dropped[before.ndim], before, getattr(new, name)) for name, before in arrays.items()}
        self.state = replace(new, **states)
        return self.state


def least_force(world: World, *, time_s: float) -> Episodes:
    """Compute the least grip force that holds in the moving hand: (m (g + a) + pull) over the sum of both mu_s."""
    load = world.mass_kg * (GRAVITY_M_S2 + hand_motion(time_s)[2]) + world.pull_n
    return np.maximum(load, 0) / world.friction.sum(axis=1)


EPISODE_S = 6.0
"""Length of an episode in seconds."""
LIFT_S, LIFTED_S = 0.5, 2.0
"""Time at which the hand begins to rise, and at which it stops."""
_RISE_S, _RISE_M = LIFTED_S - LIFT_S, 0.2
_NEVER = 1e9
_JOLT_S, _POUR_S, _FADE_S = 0.08, 2.0, 3.0
_PULL_S, _PULL_RAMP_S = 1.5, 0.15
_WOBBLE, _WOBBLE_HZ = 0.2, 2.0


@dataclass(frozen=True, kw_only=True)
class Scripts(Columns):
    """Events of some episodes, a row an episode; an event that never happens has a time beyond the end.

    Masses are in kilograms, times in seconds, forces in newtons, factors are ratios.
    """

    mass_kg: Episodes
    friction: Episodes
    """Static friction, mean of both fingers, at the beginning."""
    friction_gap: Episodes
    """Difference of the friction between the fingers, as a share of it."""
    kinetic_ratio: Episodes
    drift: Episodes
    """Relative change of the friction over three seconds from 2 s on."""
    patch_factor: Episodes
    """Friction on a wet patch over that before."""
    patch_at_s: Episodes
    pull_n: Episodes
    """Steady pull, which wobbles by a fifth at 2 Hz and lasts 1.5 s."""
    pull_at_s: Episodes
    jolt_n: Episodes
    """Height of a half-sine of 80 ms."""
    jolt_at_s: Episodes
    water_kg: Episodes
    """Poured in within 2 s."""
    water_at_s: Episodes
    lamp_at_s: Episodes
    """Time at which the lamp of one fingertip goes out; its margins are withheld from then on."""
    fingertips: Episodes
    """Pair of fingertips, counted from 0."""

    def world(self, time_s: float) -> World:
        """Return the loads on the objects from this time on for one period."""
        fade = np.clip((time_s - 2.0) / _FADE_S, 0, 1) * self.drift
        friction = self.friction * (1 + fade) * np.where(time_s >= self.patch_at_s, self.patch_factor, 1.0)
        gap = self.friction_gap[:, None] * np.array([-0.5, 0.5])
        since = time_s - self.pull_at_s
        ramp = np.clip(since / _PULL_RAMP_S, 0, 1) * np.clip((_PULL_S - since) / _PULL_RAMP_S, 0, 1)
        pull = self.pull_n * ramp * (1 + _WOBBLE * np.sin(2 * np.pi * _WOBBLE_HZ * since))
        jolted = np.clip((time_s - self.jolt_at_s) / _JOLT_S, 0, 1)
        return World(
            mass_kg=self.mass_kg + self.water_kg * np.clip((time_s - self.water_at_s) / _POUR_S, 0, 1),
            friction=friction[:, None] * (1 + gap),
            kinetic_ratio=self.kinetic_ratio,
            pull_n=pull + self.jolt_n * np.sin(np.pi * jolted),
        )


def hand_motion(time_s: float) -> tuple[float, float, float]:
    """Compute height in metres, speed and acceleration of the hand: a lift of least jerk.

    References
    ----------
    Flash and Hogan, *J. Neurosci.* 5 (1985) 1688, eq. 2.
    """
    part = min(max((time_s - LIFT_S) / _RISE_S, 0.0), 1.0)
    height = _RISE_M * part**3 * (10 - 15 * part + 6 * part**2)
    speed = _RISE_M / _RISE_S * 30 * part**2 * (1 - part) ** 2
    return height, speed, _RISE_M / _RISE_S**2 * 60 * part * (1 - part) * (1 - 2 * part)


Draw: TypeAlias = Callable[[Scripts, GrippedObject, Callable[[float, float], Episodes]], Mapping[str, Episodes | float]]
"""Function that draws the columns in which a condition differs from dry episodes of an object."""

CONDITIONS: dict[str, Draw] = {
    "dry": lambda *_: {},
    "wet": lambda _, __, uniform: {"friction": uniform(0.15, 0.7), "drift": uniform(-0.15, 0.15)},
    "drifting": lambda _, __, uniform: {"drift": uniform(-0.6, -0.2)},
    "unknown": lambda _, __, uniform: {"friction": np.exp(uniform(np.log(0.15), np.log(1.2)))},
    "patch": lambda _, __, uniform: {"patch_factor": uniform(0.4, 0.75), "patch_at_s": 2.5},
    "jolt": lambda scripts, _, uniform: {
        "jolt_n": scripts.mass_kg * GRAVITY_M_S2 * uniform(0.5, 1.5), "jolt_at_s": uniform(3, 5)
    },
    "poured": lambda _, gripped, uniform: {
        "mass_kg": gripped.mass_kg[0],
        "water_kg": uniform(0, 1) * (gripped.mass_kg[1] - gripped.mass_kg[0]),
        "water_at_s": uniform(2, 3),
    },
    "lamp": lambda _, __, uniform: {"lamp_at_s": uniform(2, 4)},
}  # fmt: skip
"""Conditions by name: dry objects of different friction; wet ones; falling friction; friction from a wide range; a wet
patch at 2.5 s; a jolt; water poured in; a fingertip's lamp that goes out."""


def draw_scripts(object: str, condition: str, *, episodes: int, seed: int, fingertips: int = 64) -> Scripts:
    """Draw the events of some episodes; the same seed gives the same events.

    Parameters
    ----------
    object, condition
        Rows of `OBJECTS` and `CONDITIONS`.
    fingertips
        Number of pairs of fingertips to choose from.

    Examples
    --------
    >>> from sliplens.grip.plant import draw_scripts
    >>> draw_scripts("cup", "patch", episodes=2, seed=0).patch_at_s
    array([2.5, 2.5])
    """
    gripped = pick(OBJECTS, object, noun="object")
    if episodes < 1:
        raise InputError(f"{episodes} episodes cannot be run; ask for 1 or more")
    rng, condition_rng = np.random.default_rng(seed).spawn(2)
    uniform, condition_uniform = (partial(source.uniform, size=episodes) for source in (rng, condition_rng))
    mass = uniform(*gripped.mass_kg)
    nothing, never = np.zeros(episodes), np.full(episodes, _NEVER)
    scripts = Scripts(
        mass_kg=mass, friction=uniform(0.5, 1.2), friction_gap=uniform(-0.1, 0.1), kinetic_ratio=uniform(0.7, 0.9),
        drift=nothing, patch_factor=np.ones(episodes), patch_at_s=never,
        pull_n=mass * GRAVITY_M_S2 * uniform(0.0, 0.5), pull_at_s=uniform(2.0, 3.0), jolt_n=nothing, jolt_at_s=never,
        water_kg=nothing, water_at_s=never, lamp_at_s=never,
        fingertips=rng.integers(fingertips, size=episodes).astype(np.float64),
    )  # fmt: skip
    columns = pick(CONDITIONS, condition, noun="condition")(scripts, gripped, condition_uniform)
    return replace(scripts, **{name: np.full(episodes, value, dtype=np.float64) for name, value in columns.items()})
