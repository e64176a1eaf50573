"""Neutral judge of maps: groups of markers moved to another margin of their trial, which no map is made to predict."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Float64, Int, Int64

GROUPS, GROUP_MARKERS = 24, 5
"""Groups of a frame, and markers of a group."""
MOVED_TO, MOVED_FAR, HIGH = 0.85, 0.3, 0.8
"""Margin to which markers are moved; margin for frames above the third one, which lie too near to the first."""


def neutral_frame(margins: Float[np.ndarray, " frames"], frame: int) -> int:
    """Find the frame of a trial to whose places the markers of a frame are moved; it lies before the first slip."""
    slips = np.flatnonzero(margins <= 0)
    before = margins[: slips[0]] if len(slips) and np.isfinite(margins[: slips[0]]).any() else margins
    wanted = MOVED_FAR if margins[frame] > HIGH else MOVED_TO
    return int(np.nanargmin(np.abs(before - wanted)))


def draw_groups(markers: int, *, rng: np.random.Generator) -> Int64[np.ndarray, "groups members"]:
    """Draw random groups of a frame's markers."""
    size = min(GROUP_MARKERS, markers)
    return np.stack([rng.choice(markers, size, replace=False) for _ in range(GROUPS)])


def marker_sums(
    relevance: Float[np.ndarray, "size size"], regions: Int[np.ndarray, "size size"], *, markers: int
) -> Float64[np.ndarray, " markers"]:
    """Sum a map over the region of each marker (`marker_regions`)."""
    return np.bincount(regions.ravel(), relevance.astype(np.float64).ravel(), minlength=markers + 1)[:markers]


def correlate_groups(
    values: Float[np.ndarray, " markers"],
    groups: Int[np.ndarray, "groups members"],
    effects: Float[np.ndarray, " groups"],
) -> float:
    """Pearson's correlation of the sums of marker values over groups with the effects of these.

    NaN where the effects do not vary, so that nothing can be judged; 0 where the sums do not.
    """
    sums = values[groups].sum(axis=1)
    if len(effects) < 2 or np.ptp(effects) == 0:
        return float("nan")
    return 0.0 if np.ptp(sums) == 0 else float(np.corrcoef(sums, effects)[0, 1])


def split_half_reliability(
    values: Mapping[str, Sequence[Float[np.ndarray, " markers"]]],
    groups: Sequence[Int[np.ndarray, "groups members"]],
    effects: Sequence[Float[np.ndarray, " groups"]],
) -> float | None:
    """Expected correlation of the scores of maps and frames with those by as many other groups; None if undefined.

    Scores by every second group are correlated with those by the others; Spearman and Brown's formula gives that of
    all groups.
    """
    halves = np.array(
        [
            [correlate_groups(of_frame, some[half::2], changes[half::2]) for half in (0, 1)]
            for of_map in values.values()
            for of_frame, some, changes in zip(of_map, groups, effects, strict=True)
        ]
    ).reshape(-1, 2)
    first, second = halves[np.isfinite(halves).all(axis=1)].T
    if len(first) < 3 or np.ptp(first) == 0 or np.ptp(second) == 0:
        return None
    half = max(0.0, float(np.corrcoef(first, second)[0, 1]))
    return 2 * half / (1 + half)
