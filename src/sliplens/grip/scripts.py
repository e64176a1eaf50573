"""Events of an episode: mass, friction, pulls, jolts, a wet patch, water, a lamp that goes out."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from sliplens.codec import Columns
from sliplens.errors import InputError
from sliplens.extras import pick
from sliplens.grip.plant import GRAVITY_M_S2, OBJECTS, GrippedObject, World

EPISODE_S = 6.0
"""Length of an episode in seconds."""
LIFT_S = 0.5
"""Time at which the hand begins to rise."""
_RISE_S, _RISE_M = 1.5, 0.2
_NEVER = 1e9
_JOLT_S, _POUR_S, _FADE_S = 0.08, 2.0, 3.0
_PULL_S, _PULL_RAMP_S = 1.5, 0.15
_WOBBLE, _WOBBLE_HZ = 0.2, 2.0

Values: TypeAlias = Float[np.ndarray, " episodes"]


@dataclass(frozen=True, kw_only=True)
class Scripts(Columns):
    """Events of some episodes, a row an episode; an event that never happens has a time beyond the end.

    Masses are in kilograms, times in seconds, forces in newtons, factors are ratios.
    """

    mass_kg: Values
    friction: Values
    """Static friction, mean of both fingers, at the beginning."""
    friction_gap: Values
    """Difference of the friction between the fingers, as a share of it."""
    kinetic_ratio: Values
    drift: Values
    """Relative change of the friction over three seconds from 2 s on."""
    patch_factor: Values
    """Friction on a wet patch over that before."""
    patch_at_s: Values
    pull_n: Values
    """Steady pull, which wobbles by a fifth at 2 Hz and lasts 1.5 s."""
    pull_at_s: Values
    jolt_n: Values
    """Height of a half-sine of 80 ms."""
    jolt_at_s: Values
    water_kg: Values
    """Poured in within 2 s."""
    water_at_s: Values
    lamp_at_s: Values
    """Time at which the lamp of one fingertip goes out; its margins are withheld from then on."""
    fingertips: Values
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
        hand, speed, _ = hand_motion(time_s)
        return World(
            mass_kg=self.mass_kg + self.water_kg * np.clip((time_s - self.water_at_s) / _POUR_S, 0, 1),
            friction=friction[:, None] * (1 + gap),
            kinetic_ratio=self.kinetic_ratio,
            pull_n=pull + self.jolt_n * np.sin(np.pi * jolted),
            hand_m=np.full(len(self), hand),
            hand_speed_m_s=np.full(len(self), speed),
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


Draw: TypeAlias = Callable[[Scripts, GrippedObject, Callable[[float, float], Values]], Mapping[str, Values | float]]
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
_BOUNDS = {"mass_kg": 0, "friction": 0, "kinetic_ratio": 0, "patch_factor": 0, "drift": -1, "water_kg": -1e-9}


def draw_scripts(
    gripped: GrippedObject | str,
    condition: str,
    *,
    episodes: int,
    seed: int,
    fingertips: int = 64,
    script: Mapping[str, float] | None = None,
) -> Scripts:
    """Draw the events of some episodes; the same seed gives the same events.

    Parameters
    ----------
    gripped
        Object, or row of `OBJECTS`.
    condition
        Row of `CONDITIONS`.
    episodes, seed
        Number of episodes, and the seed they are drawn from.
    fingertips
        Number of pairs of fingertips to choose from.
    script
        Columns of `Scripts` to set rather than to draw, such as `mass_kg`.

    Examples
    --------
    >>> from sliplens.grip.scripts import draw_scripts
    >>> scripts = draw_scripts("cup", "patch", episodes=2, seed=0, script={"mass_kg": 0.06})
    >>> scripts.mass_kg, scripts.patch_at_s
    (array([0.06, 0.06]), array([2.5, 2.5]))
    """
    if isinstance(gripped, str):
        gripped = pick(OBJECTS, gripped, noun="object")
    if episodes < 1:
        raise InputError(f"{episodes} episodes cannot be run; ask for 1 or more")
    names, script = {field.name for field in fields(Scripts)}, script or {}
    for name, value in script.items():
        if name not in names:
            raise InputError(f"an episode has no {name}; choose of {', '.join(sorted(names))}")
        if not _BOUNDS.get(name, -np.inf) < value < np.inf:
            bound = f"above {_BOUNDS[name]:g}" if name in _BOUNDS else "finite"
            raise InputError(f"{name} must be {bound}, got {value:g}")
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
    columns = {**pick(CONDITIONS, condition, noun="condition")(scripts, gripped, condition_uniform), **script}
    return replace(scripts, **{name: np.full(episodes, value, dtype=np.float64) for name, value in columns.items()})
