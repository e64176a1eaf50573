"""Does a network know when it does not know: coverage of its intervals, and dry told from wet by its uncertainty."""

import numpy as np
from jaxtyping import Bool, Float

from sliplens.models.checkpoints import Estimate


def coverage(
    low: Float[np.ndarray, " frames"], high: Float[np.ndarray, " frames"], labels: Float[np.ndarray, " frames"]
) -> float:
    """Share of the labels that lie in their intervals, ends included."""
    return float(np.mean((labels >= low) & (labels <= high)))


def coverages(
    estimate: Estimate, labels: Float[np.ndarray, " frames"], rows: Bool[np.ndarray, " frames"]
) -> dict[str, float]:
    """Coverage of the intervals of every calibrated level, on some of the frames; empty without a calibration."""
    if estimate.calibration is None:
        return {}
    found = {}
    for level in estimate.calibration.offsets:
        interval = estimate.interval(float(level))
        assert interval is not None
        found[level] = coverage(interval[0][rows], interval[1][rows], labels[rows])
    return found


def auroc(positive: Float[np.ndarray, " _"], negative: Float[np.ndarray, " _"]) -> float | None:
    """Area under the receiver operating characteristic: how often a positive scores above a negative; ties count half.

    Parameters
    ----------
    positive, negative
        Scores of the two classes.

    Returns
    -------
    float or None
        0.5 where the scores tell nothing apart; None where a class is empty.

    References
    ----------
    Hanley & McNeil, *Radiology* 143 (1982) 29: the area is the Mann-Whitney statistic over the number of pairs.
    """
    if not (len(positive) and len(negative)):
        return None
    ordered = np.sort(negative)
    below = np.searchsorted(ordered, positive, side="left")
    not_above = np.searchsorted(ordered, positive, side="right")
    return float((below + not_above).mean() / 2 / len(negative))
