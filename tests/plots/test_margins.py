"""The chart of predicted margins: what the table withholds is grey, and drawn nowhere."""

import numpy as np
import pyarrow as pa
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import FillBetweenPolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from sliplens.plots.margins import plot_margins

TIME_S = np.arange(6) / 10


def rows(*reasons: str | None) -> pa.Table:
    margin = [None if reason else 0.6 for reason in reasons]
    ends = {"low_90": [m and m - 0.2 for m in margin], "high_90": [m and m + 0.2 for m in margin]}
    times = {"frame": range(len(reasons)), "time_s": TIME_S[: len(reasons)]}
    columns = {"trial": ["t"] * len(reasons), **times, "prediction": margin, **ends, "withheld": list(reasons)}
    kinds = {"prediction": pa.float64(), "low_90": pa.float64(), "high_90": pa.float64(), "withheld": pa.string()}
    return pa.table({name: pa.array(values, kinds.get(name)) for name, values in columns.items()})


def drawn(*reasons: str | None) -> tuple[Axes, list[tuple[float, float]], list[str]]:
    """The chart, its grey spans from left to right, and the words of its legend."""
    ax = plot_margins(rows(*reasons), ax=Figure().subplots())
    spans = [(patch.get_x(), patch.get_x() + patch.get_width()) for patch in ax.patches if isinstance(patch, Rectangle)]
    legend = ax.get_legend()
    return ax, spans, [] if legend is None else [text.get_text() for text in legend.get_texts()]


def test_withheld_frames_are_grey_up_to_half_way_to_their_neighbours():
    _, spans, words = drawn(None, "a; cure", "a; cure", None, "b; cure", None)
    assert np.array(spans) == pytest.approx(np.array([(0.05, 0.25), (0.35, 0.45)]))
    assert {"withheld: a", "withheld: b"} < set(words)


def test_a_reason_stands_once_in_the_legend():
    _, spans, words = drawn("a; cure", None, "a; cure", None)
    assert len(spans) == 2
    assert words.count("withheld: a") == 1


def test_where_all_is_withheld_neither_margin_nor_interval_is_drawn():
    ax, [(left, right)], words = drawn("a; cure", "a; cure")
    assert (left, right) == pytest.approx((0, 0.1))
    assert words == ["withheld: a"]
    assert not any(isinstance(drawing, FillBetweenPolyCollection) for drawing in ax.collections)


def test_one_frame_alone_has_a_width():
    [(left, right)] = drawn("a; cure")[1]
    assert left < 0 < right


def test_the_interval_has_a_gap_where_it_is_withheld():
    ax, _, _ = drawn(None, None, "a; cure", None, None)
    [band] = [drawing for drawing in ax.collections if isinstance(drawing, FillBetweenPolyCollection)]
    assert all(TIME_S[2] not in np.asarray(path.vertices)[:, 0] for path in band.get_paths())
    assert np.isnan(np.asarray(ax.lines[0].get_ydata())[2])
