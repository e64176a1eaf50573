"""Safety margins over time: predictions, a grip from stick to slip, an episode of a grip."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sliplens.errors import InputError
from sliplens.plots.errors import MARGIN_LABEL
from sliplens.plots.saliency import SIGN_COLOURS, full_colour, overlay_relevance
from sliplens.plots.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    INPUT_NAMES,
    ORANGE,
    SOURCE_NAMES,
    VERMILLION,
    drawing_style,
    method_name,
    place_axes,
    place_text,
    require_picture_path,
    save_page,
    shade_withheld,
)
from sliplens.results.explanation import Strip

MOST_TRIALS = 6
"""Trials on one page."""
_FORCES = (("normal_force_n", "normal", GREEN), ("tangential_force_n", "tangential", ORANGE))


def draw_margins(rows: pa.Table, path: Path, *, title: str) -> int:
    """Save a page of predictions as .png, .pdf or .svg: a trial a row, at most `MOST_TRIALS`; gives how many.

    `rows` are those of `sliplens.predict`. Labels and forces are drawn where they are in the table.
    """
    require_picture_path(path, example="margins.png")
    names = rows["trial"].unique().to_pylist()
    if not names:
        raise InputError("there is no frame to draw; predict at least one")
    drawn = names[:MOST_TRIALS]
    forced = any(np.isfinite(column(rows, name)).any() for name, _, _ in _FORCES if name in rows.column_names)
    heights = [2.4, 1.2] if forced else [2.4]
    with drawing_style():
        figure = Figure(figsize=(9.0, 0.5 + (sum(heights) + 0.5) * len(drawn)), layout="constrained")
        more = "" if len(names) == len(drawn) else f", the first {len(drawn)} of {len(names)} trials"
        figure.suptitle(f"{title}{more}", x=0.01, ha="left", fontsize=12, fontweight="bold", parse_math=False)
        axes = figure.subplots(len(heights) * len(drawn), 1, squeeze=False, height_ratios=heights * len(drawn))[:, 0]
        for number, name in enumerate(drawn):
            trial = rows.filter(pc.field("trial") == name)
            chart = axes[len(heights) * number]
            plot_margins(trial, ax=chart)
            if forced:
                below = axes[len(heights) * number + 1]
                below.sharex(chart)
                _plot_forces(trial, ax=below)
                chart.set_xlabel("")
                chart.tick_params(labelbottom=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_page(figure, path)
    return len(drawn)


def plot_margins(rows: pa.Table, *, ax: Axes) -> Axes:
    """Draw the margin of one trial with its 90 % interval over time or frames, and the label where there is one.

    Frames whose margin is withheld are grey, and the legend says why.
    """
    across, label = _across(rows)
    shade_withheld(across, rows["withheld"].to_pylist(), ax=ax)
    if "low_90" in rows.column_names:
        low, high = 100 * column(rows, "low_90"), 100 * column(rows, "high_90")
        if np.isfinite(low).any():  # a network that was never calibrated has none
            ax.fill_between(across, low, high, color=BLUE, alpha=0.18, linewidth=0, label="90 % interval")
    # few frames have a dot each: one alone makes no line
    dot = "o" if len(across) <= 40 else ""
    if np.isfinite(read := 100 * column(rows, "prediction")).any():
        ax.plot(across, read, color=BLUE, marker=dot, markersize=3, label="predicted")
    if "safety_margin" in rows.column_names and np.isfinite(true := column(rows, "safety_margin")).any():
        ax.plot(across, 100 * true, color=BLACK, linestyle="--", label="true")
    ax.axhline(0, color=GREY, linewidth=0.8)
    ax.set(xlabel=label, ylabel=MARGIN_LABEL)
    if label == "Frame":
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    low, high = ax.get_ylim()
    ax.set_ylim(min(low, -4), max(high, 104))
    ax.legend(loc="lower left", bbox_to_anchor=(0.0, 0.99), ncols=2, borderaxespad=0.2)
    lines = -(-len(ax.get_legend_handles_labels()[0]) // 2)
    ax.set_title(rows["trial"][0].as_py(), parse_math=False, pad=6 + 15 * lines)
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
    """Return the numbers of a column; NaN for null."""
    return rows[name].to_numpy().astype(np.float64)


_WIDTH_IN, _MARGIN_IN, _GAP_IN, _CHART_IN = 10.0, 0.75, 0.08, 2.2


def draw_strip(strip: Strip) -> Figure:
    """Draw a trial from stick to slip.

    Above, camera frames at a few moments under their maps, on one scale: blue where a pixel raises the predicted
    margin, orange where it lowers it. Below, the true and the predicted margin over time, with the 90 % interval.
    """
    count = len(strip.shown)
    cell = (_WIDTH_IN - _MARGIN_IN - 1.0 - _GAP_IN * (count - 1)) / count
    height = 1.05 + cell + 0.45 + _CHART_IN + 0.6
    # the map's own units are too small to read: points of the margin for every hundredth of the picture
    points = strip.relevance * strip.relevance[0].size
    limit = full_colour(points)
    with drawing_style():
        figure = Figure(figsize=(_WIDTH_IN, height))
        head = f"A {strip.condition} grip from stick to slip ({SOURCE_NAMES[strip.source]})"
        place_text(figure, 0.1, 0.1, head, fontsize=13, fontweight="bold")
        place_text(figure, 0.1, 0.36, _subtitle(strip), fontsize=9.5, color="#4B5563")
        for number, (frame, picture, relevance) in enumerate(zip(strip.shown, strip.pictures, points, strict=True)):
            ax = place_axes(figure, _MARGIN_IN + number * (cell + _GAP_IN), 1.05, cell, cell)
            ax.imshow(overlay_relevance(picture, relevance / limit))
            ax.set_axis_off()
            readings = strip.readings
            read, true = _percent(readings.prediction[frame]), _percent(readings.safety_margin[frame])
            words = f"{number + 1}: {'withheld' if readings.withheld[frame] else f'{read} predicted'}\n{true} true"
            ax.set_title(words, fontsize=9.5, loc="center", fontweight="normal")
        bar = place_axes(figure, _WIDTH_IN - 0.9, 1.05, 0.13, cell)
        figure.colorbar(ScalarMappable(Normalize(-limit, limit), SIGN_COLOURS), cax=bar)
        bar.set_ylabel("points of margin\nper 1 % of the image", fontsize=8)
        bar.tick_params(labelsize=8)
        chart = place_axes(figure, _MARGIN_IN, 1.05 + cell + 0.4, _WIDTH_IN - _MARGIN_IN - 1.0, _CHART_IN)
        plot_readings(strip, ax=chart)
    return figure


def plot_readings(strip: Strip, *, ax: Axes) -> Axes:
    """Draw the true and the predicted margin over time, with the interval and the moments of the pictures."""
    readings = strip.readings
    touched = np.isfinite(readings.safety_margin)
    time_s = readings.time_s
    read, low, high = (
        np.where(touched, 100 * value, np.nan) for value in (readings.prediction, readings.low, readings.high)
    )
    shade_withheld(time_s, readings.withheld.tolist(), ax=ax)
    if np.isfinite(low).any():  # a network that was never calibrated has none
        ax.fill_between(time_s, low, high, color=BLUE, alpha=0.18, linewidth=0, label="90 % interval")
    ax.plot(time_s, read, color=BLUE, label="predicted")
    ax.plot(time_s, 100 * readings.safety_margin, color=BLACK, linestyle="--", label="true")
    for number, frame in enumerate(strip.shown, start=1):
        ax.axvline(time_s[frame], color="#9CA3AF", linewidth=0.8, zorder=0)
        ax.annotate(str(number), (time_s[frame], 106), ha="center", fontsize=9, annotation_clip=False)
    slipping = readings.contact_state == "full slip"
    if slipping.any():
        ends = float(time_s[slipping][0]), float(time_s[-1])
        ax.axvspan(*ends, color=VERMILLION, alpha=0.15, linewidth=0, label="from the first full slip")
    ax.set(xlabel="Time (s)", ylabel="Safety margin (%)", ylim=(-4, 104), xlim=(time_s[0], time_s[-1]))
    ax.legend(loc="lower left")
    return ax


def _subtitle(strip: Strip) -> str:
    network = INPUT_NAMES.get(strip.input, strip.input).lower()
    return (
        f"Frames under the map of {method_name(strip.method)}, network on {network}: "
        "orange lowers its margin, blue raises it"
    )


def _percent(value: float) -> str:
    return f"{100 * value:.0f} %" if np.isfinite(value) else "-"


def plot_grip_force(trace: pa.Table, *, ax: Axes) -> Axes:
    """Draw the grip force over the least force that holds, and detected slips."""
    time_s, force_n, least_n = (column(trace, name) for name in ("time_s", "force_n", "least_force_n"))
    ax.plot(time_s, force_n, color=BLUE, label="grip force")
    ax.plot(time_s, least_n, color=BLACK, linestyle="--", label="least that holds")
    ax.fill_between(time_s, least_n, force_n, color=BLUE, alpha=0.12, linewidth=0)
    for number, slip_s in enumerate(time_s[column(trace, "slip_seen") > 0]):
        ax.axvline(slip_s, color=VERMILLION, linewidth=1, linestyle=":", label="slip detected" if number == 0 else None)
    # room for the legend above the lines
    ax.set(xlabel="Time (s)", ylabel="Force (N)", ylim=(0, 1.4 * float(force_n.max()) or 1.0))
    ax.legend(loc="upper right", ncols=2)
    return ax


def plot_hold(steps: pa.Table, *, ax: Axes) -> Axes:
    """Draw the commanded and the measured grip force, slips, and faults of the gripper."""
    time_s, command_n = column(steps, "time_s"), column(steps, "command_n")
    ax.plot(time_s, command_n, color=BLACK, linestyle="--", label="commanded")
    ax.plot(time_s, column(steps, "force_n"), color=BLUE, label="measured")
    for name, colour, label in (("slip", VERMILLION, "slip detected"), ("failed", GREY, "gripper failed")):
        marked = column(steps, name) > 0
        ax.plot(time_s[marked], command_n[marked], color=colour, marker="x", linestyle="", label=label)
    ax.set(xlabel="Time (s)", ylabel="Grip force (N)", ylim=(0, 1.4 * float(command_n.max(initial=0.0)) or 1.0))
    ax.legend(loc="upper right", ncols=2)
    return ax


def plot_grip(trace: pa.Table, *, axes: Sequence[Axes]) -> None:
    """Draw force, margin and slip on three axes."""
    force, margin, slip = axes
    plot_grip_force(trace, ax=force).set_title("Force")
    time_s, slip_m = column(trace, "time_s"), column(trace, "slip_m")
    predicted, low, high, true = (100 * column(trace, name) for name in ("margin", "low", "high", "true_margin"))
    margin.fill_between(time_s, low, high, color=ORANGE, alpha=0.2, linewidth=0)
    margin.plot(time_s, predicted, color=ORANGE, linewidth=1, label="predicted, with 90 % interval")
    margin.plot(time_s, true, color=BLACK, linestyle="--", label="true")
    margin.set(xlabel="Time (s)", ylabel="Safety margin Γ (%)", ylim=(-3, 103), title="Margin")
    margin.legend(loc="lower right")
    slip.plot(time_s, 1e3 * slip_m, color=GREY)
    slip.set(xlabel="Time (s)", ylabel="Slip (mm)", ylim=(0, max(1.0, 1.05e3 * float(slip_m.max()))), title="Slip")
