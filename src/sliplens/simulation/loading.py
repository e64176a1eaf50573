"""The load on the fingertip through a trial: touch, press, hold, pull until it slips, slide on, let go."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool

from sliplens.errors import ContactError
from sliplens.mechanics import safety_margin, stick_ratio
from sliplens.recordings.trial import ContactState, contact_states
from sliplens.simulation.geometry import Frames
from sliplens.simulation.nuisances import Grasp

_FALL_S = 0.06
"""Time in which friction falls from static to kinetic once the contact slips (assumed)."""
_SLIP_SHARE = 0.2
"""Share of a stick-slip cycle in which the contact slips (assumed)."""


@dataclass(frozen=True, kw_only=True)
class Friction:
    """Friction of a contact and how much of it is used, frame by frame."""

    coefficient: Frames
    """The one that holds: static, kinetic in slip, then what the contact has regained where it sticks."""
    used: Frames
    """Tangential force over what this friction can hold."""
    carried: Frames
    """Tangential over normal force at which the contact last slipped."""
    slips: Bool[np.ndarray, " frames"]


def slide(since_slip_s: Frames, *, static_friction: Frames, grasp: Grasp, stuck_until: int) -> Friction:
    """Friction of a sliding contact: a fall from static to kinetic, then stick-slip of a spring-slider.

    The spring reloads the stuck contact at a steady rate from kinetic friction to what the contact regained in that
    short time (a share of static less kinetic: friction ages), then the contact slips back. With a share of 0 it slides
    on evenly. Frames before the first slip mean nothing. From `stuck_until` frames after it on the contact is let go:
    it slips for good, at the level it then has.

    Persson, *Sliding Friction* (2000), chapter 3 (spring-slider, stick-slip).
    """
    time_s = np.maximum(since_slip_s, 0)
    kinetic = grasp.kinetic_ratio * static_friction
    gap = static_friction - kinetic
    falling = time_s < _FALL_S
    cycle = np.maximum(time_s - _FALL_S, 0) * grasp.stick_slip_hz % 1.0
    stuck = ~falling & (cycle < 1 - _SLIP_SHARE) & (grasp.stick_slip_share > 0)

    regained = grasp.stick_slip_share * gap
    height = np.where(stuck, cycle / (1 - _SLIP_SHARE), (1 - cycle) / _SLIP_SHARE)
    level = kinetic + np.where(falling, gap * (1 - time_s / _FALL_S), regained * height)
    friction = np.where(stuck, kinetic + regained, level)
    carried = np.where(stuck, kinetic, level)

    first = int(np.searchsorted(since_slip_s, 0.0)) + stuck_until
    if first < len(time_s):
        # pulled no further, the contact holds at its last level and slips as the normal force falls
        level[first:] = friction[first:] = carried[first:] = (
            level[first - 1] / static_friction[first - 1] * (static_friction[first:])
        )
        stuck[first:] = False
    return Friction(coefficient=friction, used=level / friction, carried=carried, slips=~stuck)


TRIAL_S = 8.0
"""Length of a trial in seconds."""

_PHASES = (0.06, 0.07, 0.07, 0.72, 0.08)
"""Shares of a trial: no contact, press, hold, pull, slide; the pull gets most, for its margins are what is learnt."""
_RELEASE = (0.05, 0.04)
"""Shares taken from the pull in a trial that ends with a release: letting go, and no contact after."""

MINIMUM_FRAMES = 20
"""Fewer frames leave a phase empty."""


@dataclass(frozen=True, kw_only=True)
class Loading:
    """Forces and labels of every frame of a trial.

    The friction coefficient is the one that holds: static until the contact slips, kinetic while it slides, and what
    the contact has regained where it sticks again. So the margin of a sliding contact is 0 and every margin is
    1 - F_t / (mu F_n). Without contact the margin is NaN.

    The traction is that of `carried_friction` times the pressure everywhere, from sliding, and on top of it that of a
    Cattaneo-Mindlin contact with the friction that is left and `stick_margin` (Ciavarella and Jaeger's superposition).
    Before the first slip nothing is carried, and the stick margin is the safety margin.
    """

    time_s: Frames
    normal_force_n: Frames
    tangential_force_n: Frames
    friction_coefficient: Frames
    static_friction: Frames
    safety_margin: Frames
    stick_ratio: Frames
    carried_friction: Frames
    stick_margin: Frames
    """NaN without contact, as the safety margin."""
    held_s: Frames
    """Time since the object was touched; 0 before."""
    contact_state: tuple[ContactState, ...]


def load_grasp(grasp: Grasp, *, frames: int, rng: np.random.Generator, release: bool = False) -> Loading:
    """Load a grasp: press to its force, hold, pull with an evenly falling margin, then slide (`slide`).

    `release`: let go at the end: the normal force falls to nothing while the object slides, and the last frames have no
    contact.
    """
    if frames < MINIMUM_FRAMES:
        raise ContactError(f"a trial of {frames} frames cannot hold all phases; ask for {MINIMUM_FRAMES} or more")
    touch, pressed, pull, slip, let_go, gone = _phase_ends(frames, rng, release=release)
    index = np.arange(frames)
    progress = index / (frames - 1)
    time_s = index * (TRIAL_S / frames)

    # the camera knows nothing of the touch: the first frame of contact comes anywhere within its period, and where
    # frames are few, some trials show the lightest touch and some do not
    since_touch = index - touch + 1 - rng.uniform()
    normal = grasp.normal_force_n * _smooth(since_touch / (pressed - touch))
    normal *= 1 + grasp.normal_force_drift * (progress - 0.5) * 2
    if release:
        normal *= 1 - _smooth((index - let_go + 1) / (gone - let_go))
    normal[(index < touch) | (index >= gone)] = 0
    static = grasp.friction * (1 + grasp.friction_drift * (progress - 0.5) * 2)

    pulled = np.clip((index - pull) / (slip - pull), 0, 1)
    # a slow swing of the puller, small enough that the margin never rises
    swing = rng.uniform(-0.5, 0.5) * np.sin(2 * np.pi * pulled) / (2 * np.pi)
    used = np.clip(pulled + swing, 0, 1)
    sliding = slide(time_s - time_s[slip], static_friction=static, grasp=grasp, stuck_until=let_go - slip)
    friction = Friction(
        coefficient=np.where(index < slip, static, sliding.coefficient),
        used=np.where(index < slip, used, sliding.used),
        carried=np.where(index < slip, 0.0, sliding.carried),
        slips=(index >= slip) & sliding.slips,
    )
    held_s = np.where(index < touch, 0, time_s - time_s[touch])
    return _label(time_s, normal=normal, static=static, friction=friction, held_s=held_s)


def load_at_margins(margins: Frames, *, grasp: Grasp) -> Loading:
    """Load a grasp so that its frames have given margins, at its full normal force; NaN is no contact.

    `grasp`: force and friction; drift, creep and the kinetic ratio are left out.
    """
    return load_at_states(
        np.where(np.isnan(margins), 0.0, grasp.normal_force_n),
        friction=np.full(len(margins), grasp.friction),
        margins=margins,
    )


def load_at_states(
    normal_force_n: Frames, *, friction: Frames, margins: Frames, held_s: Frames | None = None
) -> Loading:
    """Load a contact so that its frames have given normal forces, frictions and margins; nothing of before is told.

    A margin of 0 slips, one of NaN is no contact; `held_s` is the time since the touch, which creep grows with.
    """
    if np.any((margins < 0) | (margins > 1)):
        raise ContactError("safety margins must lie in [0, 1]; give them as fractions, not in percent")
    nothing = np.zeros(len(margins))
    used = 1 - np.nan_to_num(margins, nan=1.0)
    states = Friction(coefficient=friction, used=used, carried=nothing, slips=margins == 0)
    normal = np.where(np.isnan(margins), 0.0, normal_force_n)
    time_s = np.arange(len(margins), dtype=np.float64)
    return _label(time_s, normal=normal, static=friction, friction=states, held_s=nothing if held_s is None else held_s)


def _label(time_s: Frames, *, normal: Frames, static: Frames, friction: Friction, held_s: Frames) -> Loading:
    """Label frames of which is known how much of the friction they use."""
    coefficient, carried, slips = friction.coefficient, friction.carried, friction.slips
    tangential = friction.used * coefficient * normal
    # rounding alone would leave a sliding contact a margin of 1e-16
    margin = np.where(slips & (normal > 0), 0.0, safety_margin(normal, tangential, coefficient))
    left = coefficient - carried
    on_top = np.clip((friction.used * coefficient - carried) / np.where(left > 0, left, 1), 0, 1)
    again = ~np.isnan(margin) & ~slips & (carried > 0)
    stick_margin = np.where(again, 1 - on_top, margin)
    return Loading(
        time_s=time_s,
        normal_force_n=normal,
        tangential_force_n=tangential,
        friction_coefficient=coefficient,
        static_friction=static,
        safety_margin=margin,
        stick_ratio=stick_ratio(stick_margin),
        carried_friction=carried,
        stick_margin=stick_margin,
        held_s=held_s,
        contact_state=contact_states(margin, without=ContactState.NO_CONTACT),
    )


def with_friction(loading: Loading, friction: Frames) -> Loading:
    """Press and pull with the same forces on an object of another friction, one value a frame.

    A frame whose friction stays is as it was. Of the others the margin is NaN where that friction cannot hold the pull,
    and after the first slip: what slipping leaves behind would have been another.
    """
    same = friction == loading.friction_coefficient
    normal, tangential = loading.normal_force_n, loading.tangential_force_n
    known = ((loading.safety_margin > 0) & (loading.carried_friction == 0) & (tangential < friction * normal)) | same
    margin = np.where(same, loading.safety_margin, safety_margin(normal, tangential, friction))
    margin = np.where(known, margin, np.nan)
    stick_margin = np.where(same, loading.stick_margin, margin)
    return replace(
        loading,
        friction_coefficient=friction,
        static_friction=np.where(same, loading.static_friction, friction),
        safety_margin=margin,
        stick_ratio=stick_ratio(stick_margin),
        carried_friction=np.where(same, loading.carried_friction, 0.0),
        stick_margin=stick_margin,
        contact_state=contact_states(margin, without=ContactState.NO_CONTACT),
    )


def _phase_ends(frames: int, rng: np.random.Generator, *, release: bool) -> tuple[int, int, int, int, int, int]:
    """First frame after each phase, the lengths varied by a fifth; the pull takes what is left."""
    shares = np.array((*_PHASES, *(_RELEASE if release else (0.0, 0.0))))
    lengths = np.round(frames * shares * rng.uniform(0.8, 1.2, len(shares))).astype(int)
    lengths[shares > 0] = np.maximum(1, lengths[shares > 0])
    lengths[3] += frames - lengths.sum()
    touch, pressed, pull, slip, let_go, gone, _ = np.cumsum(lengths).tolist()
    return touch, pressed, pull, slip, let_go, gone


def _smooth(progress: Frames) -> Frames:
    """Rise from 0 to 1 with a soft start and stop, as a servo makes it."""
    inside = np.clip(progress, 0, 1)
    return inside**2 * (3 - 2 * inside)
