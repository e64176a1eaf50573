"""Intervals that are there."""

from sliplens.intervals import Difference


def ends_of(gap: Difference) -> tuple[float, float]:
    """Ends of an interval, which has some."""
    assert gap.low is not None
    assert gap.high is not None
    return gap.low, gap.high


def width_of(gap: Difference) -> float:
    """How wide it is."""
    low, high = ends_of(gap)
    return high - low
