"""Safety margins that a network reads, over time, with the forces below."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sliplens.errors import InputError
from sliplens.plots.errors import MARGIN_LABEL
from sliplens.plots.layout import require_picture_path, save_page
from sliplens.plots.style import BLACK, BLUE, GREEN, GREY, ORANGE, drawing_style

MOST_TRIALS = 6
"""Trials on one page."""
_FORCES = (("normal_force_n", "normal", GREEN), ("tangential_force_n", "tangential", ORANGE))


def draw_margins(rows: pa.Table, path: Path, *, title: str) -> int:
    """Save a page of predictions as .png, .pdf or .svg: a trial a row, at most `MOST_TRIALS`; gives how many.

    `rows` are those of `sliplens.predict`. Where labels or forces are known they are drawn too.
    """
    require_picture_path(path, example="margins.png")
    names = rows["trial"].unique().to_pylist()
    if not names:
        raise InputError("there is no frame to draw; predict one or more")
    shown = names[:MOST_TRIALS]
    forced = any(np.isfinite(column(rows, name)).any() for name, _, _ in _FORCES if name in rows.column_names)
    heights = [2.4, 1.2] if forced else [2.4]
    with drawing_style():
        figure = Figure(figsize=(9.0, 0.5 + (sum(heights) + 0.5) * len(shown)), layout="constrained")
        more = "" if len(names) == len(shown) else f", the first {len(shown)} of {len(names)} trials"
        figure.suptitle(f"{title}{more}", x=0.01, ha="left", fontsize=12, fontweight="bold", parse_math=False)
        axes = figure.subplots(len(heights) * len(shown), 1, squeeze=False, height_ratios=heights * len(shown))[:, 0]
        for number, name in enumerate(shown):
            own = rows.filter(pc.field("trial") == name)
            chart = axes[len(heights) * number]
            plot_margins(own, ax=chart)
            if forced:
                below = axes[len(heights) * number + 1]
                below.sharex(chart)
                _plot_forces(own, ax=below)
                chart.set_xlabel("")
                chart.tick_params(labelbottom=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_page(figure, path)
    return len(shown)


def plot_margins(rows: pa.Table, *, ax: Axes) -> Axes:
    """Draw the margin of one trial with its 90 % interval over time or frames, and the label where it is known."""
    across, label = _across(rows)
    if "low_90" in rows.column_names:
        low, high = 100 * column(rows, "low_90"), 100 * column(rows, "high_90")
        if np.isfinite(low).any():  # a network that was never calibrated tells none
            ax.fill_between(across, low, high, color=BLUE, alpha=0.18, linewidth=0, label="90 % interval")
    # few frames have a dot each: one alone makes no line
    dot = "o" if len(across) <= 40 else ""
    ax.plot(across, 100 * column(rows, "prediction"), color=BLUE, marker=dot, markersize=3, label="read")
    if "safety_margin" in rows.column_names and np.isfinite(true := column(rows, "safety_margin")).any():
        ax.plot(across, 100 * true, color=BLACK, linestyle="--", label="true")
    ax.axhline(0, color=GREY, linewidth=0.8)
    ax.set(xlabel=label, ylabel=MARGIN_LABEL)
    if label == "Frame":
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    low, high = ax.get_ylim()
    ax.set_ylim(min(low, -4), max(high, 104))
    ax.set_title(rows["trial"][0].as_py(), parse_math=False)
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 0.99), ncols=3, borderaxespad=0.2)
    return ax


def _plot_forces(rows: pa.Table, *, ax: Axes) -> None:
    across, label = _across(rows)
    for name, words, colour in _FORCES:
        ax.plot(across, column(rows, name), color=colour, label=words, linestyle="-" if words == "normal" else "--")
    ax.set(xlabel=label, ylabel="Force (N)")
    ax.legend(loc="upper left", ncols=2)


def _across(rows: pa.Table) -> tuple[Float[np.ndarray, " frames"], str]:
    timed = "time_s" in rows.column_names and rows["time_s"].null_count == 0
    return (column(rows, "time_s"), "Time (s)") if timed else (column(rows, "frame"), "Frame")


def column(rows: pa.Table, name: str) -> Float[np.ndarray, " frames"]:
    """Numbers of a column; NaN where one is not known."""
    return rows[name].to_numpy().astype(np.float64)
