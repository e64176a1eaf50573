"""Gross slip: kinetic friction, and the stick-slip of a contact pulled through a spring."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from sliplens.simulation.nuisances import Grasp

_FALL_S = 0.06
"""Time in which friction falls from static to kinetic once the contact slips (assumed)."""
_SLIP_SHARE = 0.2
"""Share of a stick-slip cycle in which the contact slips (assumed)."""


@dataclass(frozen=True, kw_only=True)
class Sliding:
    """Friction of a contact after its first full slip, frame by frame; times before that mean nothing."""

    friction: Float[np.ndarray, " frames"]
    """The coefficient that holds: kinetic in slip, what the contact has regained where it sticks."""
    used: Float[np.ndarray, " frames"]
    """Tangential force over what this friction can hold."""
    carried: Float[np.ndarray, " frames"]
    """Tangential over normal force at which the contact last slipped."""
    slips: Bool[np.ndarray, " frames"]


def slide(
    since_slip_s: Float[np.ndarray, " frames"],
    *,
    static_friction: Float[np.ndarray, " frames"],
    grasp: Grasp,
    stuck_until: int,
) -> Sliding:
    """Friction of a sliding contact: a fall from static to kinetic, then stick-slip of a spring-slider.

    The spring reloads the stuck contact at a steady rate from kinetic friction to what the contact regained in that
    short time (a share of static less kinetic: friction ages), then the contact slips back. With a share of 0 it slides
    on evenly.

    Parameters
    ----------
    since_slip_s
        Time since the first full slip, in seconds.
    static_friction
        Static coefficient of friction.
    grasp
        Kinetic ratio, and strength and rate of the stick-slip.
    stuck_until
        Frames after the first slip from which on the contact slips for good, at the level it then has: it is let go.

    References
    ----------
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
    return Sliding(friction=friction, used=level / friction, carried=carried, slips=~stuck)
