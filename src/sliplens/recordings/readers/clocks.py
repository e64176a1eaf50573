"""Frames and forces of separate files: one clock for both, and the name of the trial."""

import re
from dataclasses import dataclass
from math import isfinite

import numpy as np
from jaxtyping import Float

from sliplens.errors import RecordingError
from sliplens.recordings.capture import Forces


@dataclass(frozen=True, kw_only=True)
class FrameClock:
    """Times of frames on the clock of the forces."""

    time_s: Float[np.ndarray, " frames"]
    notes: tuple[str, ...]


def place_on_clock(
    time_s: Float[np.ndarray, " frames"], *, forces: Forces | None, start_s: float | None, source: str
) -> FrameClock:
    """Put frames on the clock of forces that were recorded into another file.

    Parameters
    ----------
    time_s
        Times of the frames, as their file gives them.
    forces
        None where only images were recorded.
    start_s
        When the first frame was taken, on the clock of the forces; None where both count from the same zero.
    source
        Of the frames, for people.

    Raises
    ------
    RecordingError
        If frames and forces have no moment in common.
    """
    notes: tuple[str, ...] = ()
    if start_s is not None:
        if not isfinite(start_s):
            raise RecordingError(f"the first frame cannot start at {start_s} s; give the time of the force clock")
        time_s = time_s - time_s[0] + start_s
        notes = (f"{source}: the first frame was declared to be taken at {start_s:.6g} s of the force clock.",)
    elif forces is not None:
        notes = (f"{source}: the times of its frames and of the forces were taken to count from the same zero.",)
    if forces is not None and (time_s[-1] < forces.time_s[0] or time_s[0] > forces.time_s[-1]):
        raise RecordingError(
            f"the frames of {source} ({time_s[0]:.6g} to {time_s[-1]:.6g} s) and the forces of {forces.source} "
            f"({forces.time_s[0]:.6g} to {forces.time_s[-1]:.6g} s) have no moment in common; "
            "declare with start_s when the first frame was taken, on the clock of the forces"
        )
    return FrameClock(time_s=time_s, notes=notes)


def evenly_spaced(count: int, *, frame_rate: float) -> Float[np.ndarray, " frames"]:
    """Times of frames taken at a declared rate, in seconds from the first.

    Raises
    ------
    RecordingError
        If the rate is not a positive number.
    """
    if not (isfinite(frame_rate) and frame_rate > 0):
        raise RecordingError(f"a frame rate of {frame_rate} frames/s cannot be; declare a positive one")
    return np.arange(count) / frame_rate


def trial_name(text: str) -> str:
    """Name of a trial: letters, digits, dots, dashes and underscores."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", text).strip("-.") or "trial"
