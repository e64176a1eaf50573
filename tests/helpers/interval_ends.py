"""Ends and widths of intervals that a test expects to exist."""

from sliplens.intervals import Difference


def ends_of(gap: Difference) -> tuple[float, float]:
    """Return the ends of an interval."""
    assert gap.low is not None
    assert gap.high is not None
    return gap.low, gap.high


def width_of(gap: Difference) -> float:
    """Return the width of an interval."""
    low, high = ends_of(gap)
    return high - low
