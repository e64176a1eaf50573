"""Events of an episode: mass, friction, pulls, jolts, a wet patch, water, a lamp that goes out."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from sliplens.codec import Columns
from sliplens.errors import InputError
from sliplens.extras import pick
from sliplens.friction import GRASP_SPREAD
from sliplens.grip.plant import GRAVITY_M_S2, GrippedObject, World, pick_object

EPISODE_S = 6.0
"""Length of an episode in seconds."""
LIFT_S = 0.5
"""Time at which the hand begins to rise."""
_RISE_S, _RISE_M = 1.5, 0.2
_NEVER = 1e9
_JOLT_S = 0.08
_POUR_S = 2.0
_FADE_S = 3.0
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


Draw: TypeAlias = Callable[[Scripts, GrippedObject, np.random.Generator], Scripts]
"""Function that changes dry episodes of an object into those of a condition."""


def _wet(scripts: Scripts, _: GrippedObject, rng: np.random.Generator) -> Scripts:
    count = len(scripts)
    return replace(scripts, friction=rng.uniform(0.15, 0.7, count), drift=rng.uniform(-0.15, 0.15, count))


def _unknown(scripts: Scripts, _: GrippedObject, rng: np.random.Generator) -> Scripts:
    return replace(scripts, friction=np.exp(rng.uniform(np.log(0.15), np.log(1.2), len(scripts))))


def _jolt(scripts: Scripts, _: GrippedObject, rng: np.random.Generator) -> Scripts:
    count, weight = len(scripts), scripts.mass_kg * GRAVITY_M_S2
    return replace(scripts, jolt_n=weight * rng.uniform(0.5, 1.5, count), jolt_at_s=rng.uniform(3, 5, count))


CONDITIONS: dict[str, Draw] = {
    "dry": lambda scripts, *_: scripts,
    "wet": _wet,
    "drifting": lambda scripts, _, rng: replace(scripts, drift=rng.uniform(-0.6, -0.2, len(scripts))),
    "unknown": _unknown,
    "patch": lambda scripts, _, rng: replace(
        scripts, patch_factor=rng.uniform(0.4, 0.75, len(scripts)), patch_at_s=np.full(len(scripts), 2.5)
    ),
    "jolt": _jolt,
    "poured": lambda scripts, gripped, rng: replace(
        scripts,
        mass_kg=np.full(len(scripts), gripped.mass_kg[0]),
        water_kg=rng.uniform(0, 1, len(scripts)) * (gripped.mass_kg[1] - gripped.mass_kg[0]),
        water_at_s=rng.uniform(2, 3, len(scripts)),
    ),
    "lamp": lambda scripts, _, rng: replace(scripts, lamp_at_s=rng.uniform(2, 4, len(scripts))),
}
"""Conditions by name: dry objects of different friction; wet ones; falling friction; friction from a wide range; a wet
patch at 2.5 s; a jolt; water poured in; a fingertip's lamp that goes out."""


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
        Columns of `Scripts`, in their units (kilograms, seconds, newtons, ratios), that are the same in all episodes
        rather than drawn, such as `mass_kg`.

    Examples
    --------
    >>> from sliplens.grip.scripts import draw_scripts
    >>> scripts = draw_scripts("cup", "patch", episodes=2, seed=0, script={"mass_kg": 0.06})
    >>> scripts.mass_kg, scripts.patch_at_s
    (array([0.06, 0.06]), array([2.5, 2.5]))
    """
    if isinstance(gripped, str):
        gripped = pick_object(gripped)
    if episodes < 1:
        raise InputError(f"{episodes} episodes cannot be run; ask for 1 or more")
    rng, condition_rng = np.random.default_rng(seed).spawn(2)

    def uniform(low: float, high: float) -> Values:
        return rng.uniform(low, high, episodes)

    mass = uniform(*gripped.mass_kg)
    nothing, never = np.zeros(episodes), np.full(episodes, _NEVER)
    scripts = Scripts(
        mass_kg=mass, friction=uniform(0.5, 1.2), friction_gap=uniform(-0.1, 0.1), kinetic_ratio=uniform(0.7, 0.9),
        drift=nothing, patch_factor=np.ones(episodes), patch_at_s=never,
        pull_n=mass * GRAVITY_M_S2 * uniform(0.0, 0.5), pull_at_s=uniform(2.0, 3.0), jolt_n=nothing, jolt_at_s=never,
        water_kg=nothing, water_at_s=never, lamp_at_s=never,
        fingertips=rng.integers(fingertips, size=episodes).astype(np.float64),
    )  # fmt: skip
    scripts = pick(CONDITIONS, condition, noun="condition")(scripts, gripped, condition_rng)
    names, fixed = {field.name for field in fields(Scripts)}, script or {}
    for name, value in fixed.items():
        if name not in names:
            raise InputError(f"an episode has no {name}; choose of {', '.join(sorted(names))}")
        if not _BOUNDS.get(name, -np.inf) < value < np.inf:
            bound = f"above {_BOUNDS[name]:g}" if name in _BOUNDS else "finite"
            raise InputError(f"{name} must be {bound}, got {value:g}")
    return replace(scripts, **{name: np.full(episodes, float(value)) for name, value in fixed.items()})


def next_grasp(scripts: Scripts, *, rng: np.random.Generator) -> Scripts:
    """Draw another grasp of the same objects with the same events.

    The friction differs from the object's by a random share (`GRASP_SPREAD`), and other fingertips hold it: the errors
    of a network differ from touch to touch.
    """
    share = 1 + GRASP_SPREAD * rng.standard_normal(len(scripts))
    pairs = rng.integers(int(scripts.fingertips.max(initial=0)) + 1, size=len(scripts))
    return replace(scripts, friction=scripts.friction * share, fingertips=pairs.astype(np.float64))


_BOUNDS = {"mass_kg": 0, "friction": 0, "kinetic_ratio": 0, "patch_factor": 0, "drift": -1, "water_kg": -1e-9}
