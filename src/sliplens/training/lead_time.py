"""How early a falling margin warns of the slip, and how often it warns in vain."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

THRESHOLD = 0.2
"""A margin below it is an alarm: people hold 20 to 40 % above the least force."""
_FALSE_ABOVE = 2.0
"""An alarm that begins while the true margin is above so many thresholds is false, not early."""


@dataclass(frozen=True, kw_only=True)
class LeadTimes:
    """Warnings before the first gross slip of each trial."""

    trials: int
    """Trials that slip."""
    warned: int
    """Of these, trials with a true alarm before the slip."""
    median_ms: float | None
    """From the first true alarm to the slip, over the warned trials; None if there is none."""
    ideal_ms: float | None
    """The same for the true margin itself, over the trials that slip."""
    false_per_minute: float
    """Alarms that begin while the true margin is above twice the threshold, by the minute of labelled touch."""
    threshold: float = THRESHOLD


def lead_times(
    trial: Sequence[str],
    time_s: Float[np.ndarray, " frames"],
    labels: Float[np.ndarray, " frames"],
    predictions: Float[np.ndarray, " frames"],
    *,
    threshold: float = THRESHOLD,
) -> LeadTimes:
    """Measure warnings on the labelled frames of some trials.

    A slip is the first frame of a trial with margin 0; what comes after is left out.

    Parameters
    ----------
    trial
        Name of each frame's trial; the frames of a trial follow each other in time.
    time_s, labels, predictions
        Time, true and predicted margin of each frame.
    threshold
        A prediction below it is an alarm.
    """
    names = np.array(trial)
    leads, ideals, slips, false, minutes = [], [], 0, 0, 0.0
    for name in dict.fromkeys(trial):
        rows = np.flatnonzero(names == name)
        order = rows[np.argsort(time_s[rows], kind="stable")]
        slipped = labels[order] <= 0
        slips_at = int(np.argmax(slipped)) if slipped.any() else None
        before = order if slips_at is None else order[:slips_at]
        if not len(before):
            continue
        alarms = predictions[before] < threshold
        begins = np.flatnonzero(alarms & ~np.insert(alarms[:-1], 0, False))
        is_false = labels[before][begins] > _FALSE_ABOVE * threshold
        false += int(is_false.sum())
        minutes += float(time_s[before[-1]] - time_s[before[0]]) / 60
        if slips_at is None:
            continue
        slips += 1
        slip_s = float(time_s[order[slips_at]])
        # an alarm that began in vain and never ended is true from where the margin is low on
        due = alarms & (labels[before] <= _FALSE_ABOVE * threshold)
        if due.any():
            leads.append(1e3 * (slip_s - float(time_s[before[np.argmax(due)]])))
        low = labels[before] < threshold
        ideals.append(1e3 * (slip_s - float(time_s[before[np.argmax(low)]])) if low.any() else 0.0)
    return LeadTimes(
        trials=slips,
        warned=len(leads),
        median_ms=float(np.median(leads)) if leads else None,
        ideal_ms=float(np.median(ideals)) if ideals else None,
        false_per_minute=false / minutes if minutes > 0 else 0.0,
        threshold=threshold,
    )
