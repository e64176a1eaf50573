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
from sliplens.plots.saliency import SIGN_COLOURS, full_colour, overlay_relevance
from sliplens.plots.style import (
    BLACK,
    BLUE,
    GREY,
    VERMILLION,
    drawing_style,
    input_name,
    method_name,
    percent,
    reading_words,
    require_picture_path,
    save_page,
    shade_withheld,
    source_name,
)
from sliplens.results.explanation import BASELINES, Strip

MARGIN_LABEL = "Safety margin Γ (%)"
MOST_TRIALS = 6
"""Trials on one page."""


def draw_margins(rows: pa.Table, path: Path, *, title: str) -> int:
    """Save a page of predictions as .png, .pdf or .svg: a trial a row, at most `MOST_TRIALS`; gives how many.

    `rows` are those of `sliplens.predict`; labels are drawn where they are in the table.
    """
    require_picture_path(path, example="margins.png")
    names = rows["trial"].unique().to_pylist()
    if not names:
        raise InputError("there is no frame to draw; predict at least one")
    drawn = names[:MOST_TRIALS]
    with drawing_style():
        figure = Figure(figsize=(9.0, 0.5 + 2.9 * len(drawn)), layout="constrained")
        more = "" if len(names) == len(drawn) else f", the first {len(drawn)} of {len(names)} trials"
        figure.suptitle(f"{title}{more}", x=0.01, ha="left", fontsize=12, fontweight="bold", parse_math=False)
        for name, ax in zip(drawn, figure.subplots(len(drawn), 1, squeeze=False)[:, 0], strict=True):
            plot_margins(rows.filter(pc.field("trial") == name), ax=ax)
    save_page(figure, path)
    return len(drawn)


def plot_margins(rows: pa.Table, *, ax: Axes) -> Axes:
    """Draw the margin of one trial with its 90 % interval over time or frames, and the label where there is one.

    Frames whose margin is withheld are grey, and the legend says why.
    """
    timed = "time_s" in rows.column_names and rows["time_s"].null_count == 0
    across = column(rows, "time_s" if timed else "frame")
    shade_withheld(across, rows["withheld"].to_pylist(), ax=ax)
    nothing = np.full(len(rows), np.nan)
    prediction, low, high, true = (
        column(rows, name) if name in rows.column_names else nothing
        for name in ("prediction", "low_90", "high_90", "safety_margin")
    )
    _plot_prediction(across, prediction, low, high, true, ax=ax)
    ax.axhline(0, color=GREY, linewidth=0.8)
    ax.set(xlabel="Time (s)" if timed else "Frame", ylabel=MARGIN_LABEL)
    if not timed:
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    low, high = ax.get_ylim()
    ax.set_ylim(min(low, -4), max(high, 104))
    ax.legend(loc="lower left", bbox_to_anchor=(0.0, 0.99), ncols=2, borderaxespad=0.2)
    lines = -(-len(ax.get_legend_handles_labels()[0]) // 2)
    ax.set_title(rows["trial"][0].as_py(), parse_math=False, pad=6 + 15 * lines)
    return ax


def column(rows: pa.Table, name: str) -> Float[np.ndarray, " frames"]:
    """Return the numbers of a column; NaN for null."""
    return rows[name].to_numpy().astype(np.float64)


def draw_strip(strip: Strip) -> Figure:
    """Draw a trial from stick to slip.

    Above, camera frames at a few moments under their maps, on one scale: blue where a pixel raises the predicted
    margin, orange where it lowers it. Below, the true and the predicted margin over time, with the 90 % interval.
    """
    # the map's own units are too small to read: points of the margin for every hundredth of the picture
    points, readings = strip.relevance * strip.relevance[0].size, strip.readings
    limit, count = full_colour(points), len(strip.shown)
    with drawing_style():
        figure = Figure(figsize=(10, 4.6 + 8.2 / count), layout="constrained")
        network = input_name(strip.input).lower()
        figure.suptitle(
            f"A {strip.condition} grip from stick to slip ({source_name(strip.source)})\nFrames under the map of "
            f"{method_name(strip.method)}, network on {network}: orange lowers its margin, blue raises it,\nagainst "
            f"{BASELINES[strip.baseline]}",
            x=0.01, ha="left", fontsize=11,
        )  # fmt: skip
        grid = figure.add_gridspec(2, count, height_ratios=(8.2 / count, 2.6))
        axes = [figure.add_subplot(grid[0, number]) for number in range(count)]
        for number, (frame, picture, relevance) in enumerate(zip(strip.shown, strip.pictures, points, strict=True)):
            axes[number].imshow(overlay_relevance(picture, relevance / limit))
            axes[number].set_axis_off()
            read = reading_words(float(readings.prediction[frame]), readings.withheld[frame])
            words = f"{number + 1}: {read}\ntrue {percent(float(readings.safety_margin[frame]))}"
            axes[number].set_title(words, fontsize=9.5, loc="center", fontweight="normal")
        bar = figure.colorbar(ScalarMappable(Normalize(-limit, limit), SIGN_COLOURS), ax=axes, aspect=15)
        bar.set_label("points of margin\nper 1 % of image", fontsize=8)
        plot_readings(strip, ax=figure.add_subplot(grid[1, :]))
    return figure


def plot_readings(strip: Strip, *, ax: Axes) -> Axes:
    """Draw the true and the predicted margin over time, with the interval and the moments of the pictures."""
    readings, time_s = strip.readings, strip.readings.time_s
    touched = np.isfinite(readings.safety_margin)
    shade_withheld(time_s, readings.withheld.tolist(), ax=ax)
    prediction, low, high = (
        np.where(touched, value, np.nan) for value in (readings.prediction, readings.low, readings.high)
    )
    _plot_prediction(time_s, prediction, low, high, readings.safety_margin, ax=ax)
    for number, frame in enumerate(strip.shown, start=1):
        ax.axvline(time_s[frame], color="#9CA3AF", linewidth=0.8, zorder=0)
        ax.annotate(str(number), (time_s[frame], 106), ha="center", fontsize=9, annotation_clip=False)
    slipping = readings.contact_state == "full slip"
    if slipping.any():
        ends = float(time_s[slipping][0]), float(time_s[-1])
        ax.axvspan(*ends, color=VERMILLION, alpha=0.15, linewidth=0, label="from the first full slip")
    ax.set(xlabel="Time (s)", ylabel=MARGIN_LABEL, ylim=(-4, 104), xlim=(time_s[0], time_s[-1]))
    ax.legend(loc="lower left")
    return ax


def _plot_prediction(
    across: np.ndarray, prediction: np.ndarray, low: np.ndarray, high: np.ndarray, true: np.ndarray, *, ax: Axes
) -> None:
    """Draw shares in percent: a prediction with its interval, and the label; each where it has any number."""
    if np.isfinite(low).any():  # a network that was never calibrated has none
        ax.fill_between(across, 100 * low, 100 * high, color=BLUE, alpha=0.18, linewidth=0, label="90 % interval")
    # few frames have a dot each: one alone makes no line
    dot = "o" if len(across) <= 40 else ""
    if np.isfinite(prediction).any():
        ax.plot(across, 100 * prediction, color=BLUE, marker=dot, markersize=3, label="predicted")
    if np.isfinite(true).any():
        ax.plot(across, 100 * true, color=BLACK, linestyle="--", label="true")


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
    predicted, low, high, true = (column(trace, name) for name in ("margin", "low", "high", "true_margin"))
    _plot_prediction(time_s, predicted, low, high, true, ax=margin)
    margin.set(xlabel="Time (s)", ylabel=MARGIN_LABEL, ylim=(-3, 103), title="Margin")
    margin.legend(loc="lower right")
    slip.plot(time_s, 1e3 * slip_m, color=GREY)
    slip.set(xlabel="Time (s)", ylabel="Slip (mm)", ylim=(0, max(1.0, 1.05e3 * float(slip_m.max()))), title="Slip")
