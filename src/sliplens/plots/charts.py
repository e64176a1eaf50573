"""Charts: margins over time, errors of a network, removal curves, grips."""

from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sliplens.explainers.table import EXPLAINERS
from sliplens.plots import style
from sliplens.plots.saliency import SIGN_COLOURS
from sliplens.results.evaluation import BinScore, ScoredFrames, Training
from sliplens.results.explanation import BASELINES, Strip, full_colour, overlay_relevance
from sliplens.results.faithfulness import CHANCE, DeletionCurve, RemovalCurve

MARGIN_LABEL = "Safety margin Γ (%)"


def plot_margins(rows: pa.Table, *, ax: Axes, unit: str = "margin") -> Axes:
    """Draw the margin of one trial with its 90 % interval over time or frames, and the label where there is one.

    Frames whose margin is withheld are grey, and the legend says why. Predictions of another `unit` are drawn in it.
    """
    timed = "time_s" in rows.column_names and rows["time_s"].null_count == 0
    across = column(rows, "time_s" if timed else "frame")
    _shade_withheld(across, rows["withheld"].to_pylist(), ax=ax)
    of_margin = unit == "margin"
    scale, drawn = (100, {*rows.column_names}) if of_margin else (1, {"prediction"})
    prediction, low, high, true = (
        scale * column(rows, name) if name in drawn else np.full(len(rows), np.nan)
        for name in ("prediction", "low_90", "high_90", "safety_margin")
    )
    if np.isfinite(low).any():  # a network that was never calibrated has none
        ax.fill_between(across, low, high, color=style.BLUE, alpha=0.18, linewidth=0, label="90 % interval")
    # few frames have a dot each: one alone makes no line
    dot = "o" if len(across) <= 40 else ""
    if np.isfinite(prediction).any():
        ax.plot(across, prediction, color=style.BLUE, marker=dot, markersize=3, label="predicted")
    if np.isfinite(true).any():
        ax.plot(across, true, color=style.BLACK, linestyle="--", label="true")
    ax.axhline(0, color=style.GREY, linewidth=0.8)
    ax.set(
        xlabel="Time (s)" if timed else "Frame", ylabel=MARGIN_LABEL if of_margin else f"Output ({unit or 'its unit'})"
    )
    if not timed:
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    low, high = ax.get_ylim()
    if of_margin:
        ax.set_ylim(min(low, -4), max(high, 104))
    if ax.get_legend_handles_labels()[0]:
        ax.legend(loc="lower left", bbox_to_anchor=(0.0, 0.99), ncols=2, borderaxespad=0.2)
    if "trial" in rows.column_names:
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
    with style.drawing_style():
        figure = Figure(figsize=(10, 4.6 + 8.2 / count), layout="constrained")
        network = style.input_name(strip.input).lower()
        figure.suptitle(
            f"A {strip.condition} grip from stick to slip ({strip.source} touch)\nFrames under the map of "
            f"{style.method_name(strip.method)}, network on {network}: orange lowers its margin, blue raises it,\n"
            f"against {BASELINES[strip.baseline]}",
            x=0.01, ha="left", fontsize=11,
        )  # fmt: skip
        grid = figure.add_gridspec(2, count, height_ratios=(8.2 / count, 2.6))
        axes = [figure.add_subplot(grid[0, number]) for number in range(count)]
        for number, (frame, picture, relevance) in enumerate(zip(strip.shown, strip.pictures, points, strict=True)):
            axes[number].imshow(overlay_relevance(picture, relevance / limit))
            axes[number].set_axis_off()
            read = style.reading_words(float(readings.prediction[frame]), readings.withheld[frame])
            words = f"{number + 1}: {read}\ntrue {style.percent(float(readings.safety_margin[frame]))}"
            axes[number].set_title(words, fontsize=9.5, loc="center", fontweight="normal")
        bar = figure.colorbar(ScalarMappable(Normalize(-limit, limit), SIGN_COLOURS), ax=axes, aspect=15)
        bar.set_label("points of margin\nper 1 % of image", fontsize=8)
        plot_readings(strip, ax=figure.add_subplot(grid[1, :]))
    return figure


def plot_readings(strip: Strip, *, ax: Axes) -> Axes:
    """Draw the true and the predicted margin over time, with the interval and the moments of the pictures."""
    readings, time_s = strip.readings, strip.readings.time_s
    plot_margins(readings.where(np.isfinite(readings.safety_margin)).to_arrow(), ax=ax)
    for number, frame in enumerate(strip.shown, start=1):
        ax.axvline(time_s[frame], color="#9CA3AF", linewidth=0.8, zorder=0)
        ax.annotate(str(number), (time_s[frame], 106), ha="center", fontsize=9, annotation_clip=False)
    slipping = readings.contact_state == "full slip"
    if slipping.any():
        ends = float(time_s[slipping][0]), float(time_s[-1])
        ax.axvspan(*ends, color=style.VERMILLION, alpha=0.15, linewidth=0, label="from the first full slip")
    ax.set(ylim=(-4, 104), xlim=(time_s[0], time_s[-1]))
    ax.legend(loc="lower left")
    return ax


def _shade_withheld(across: Float[np.ndarray, " frames"], reasons: Sequence[str | None], *, ax: Axes) -> None:
    """Shade the frames with a withheld margin, at their places `across`, with the reasons in the legend."""
    edges = np.concatenate([across[:1], (across[1:] + across[:-1]) / 2, across[-1:]])
    labels: set[str] = set()
    for reason, frames in groupby(range(len(reasons)), key=lambda at: reasons[at]):
        if not reason:
            continue
        first, *others = frames
        start, end = edges[first], edges[[first, *others][-1] + 1]
        if start == end:  # a single frame
            start, end = start - 0.5, end + 0.5
        label = f"withheld: {reason.partition(';')[0]}"
        ax.axvspan(start, end, color=style.GREY, alpha=0.3, linewidth=0, label=None if label in labels else label)
        labels.add(label)


def plot_grip_force(rows: pa.Table, *, ax: Axes) -> Axes:
    """Draw the grip force over the least that holds or beside its command, slips, and faults of the gripper."""
    time_s, force_n, command_n = (column(rows, name) for name in ("time_s", "force_n", "command_n"))
    simulated = "least_force_n" in rows.column_names
    line_n = column(rows, "least_force_n") if simulated else command_n
    ax.plot(time_s, line_n, color=style.BLACK, linestyle="--", label="least that holds" if simulated else "commanded")
    ax.plot(time_s, force_n, color=style.BLUE, label="grip force")
    level_n = np.where(np.isnan(force_n), command_n, force_n)  # a gripper that failed measures nothing
    for name, colour, label in _EVENTS:
        if name in rows.column_names and (marked := column(rows, name) > 0).any():
            ax.plot(time_s[marked], level_n[marked], color=colour, marker="x", linestyle="", label=label)
    # room for the legend above the lines
    top = 1.4 * float(np.fmax(level_n, line_n).max(initial=0.0)) or 1.0
    ax.set(xlabel="Time (s)", ylabel="Grip force (N)", ylim=(0, top))
    ax.legend(loc="upper right", ncols=2)
    return ax


_EVENTS = (
    ("slip_seen", style.VERMILLION, "slip detected"),
    ("slip", style.VERMILLION, "slip detected"),
    ("failed", style.GREY, "gripper failed"),
)
_MSE_LABEL, _EPOCH_LABEL = "MSE (Γ as a fraction, squared)", "Epoch (passes over the training frames)"


def plot_bins(bins: Mapping[str, Sequence[BinScore]], *, ax: Axes) -> Axes:
    """Draw the MSE in each bin of the safety margin as bars, a colour an input or condition (thesis, Fig. 7)."""
    width, names = 0.8 / max(1, len(bins)), style.in_order(bins, (*style.INPUT_COLOURS, *style.CONDITION_COLOURS))
    edges = next(iter(bins.values()), ())
    for index, name in enumerate(names):
        at = np.arange(len(edges)) + (index - (len(names) - 1) / 2) * width
        heights = [np.nan if score.mse is None else score.mse for score in bins[name]]
        colour = (style.INPUT_COLOURS | style.CONDITION_COLOURS).get(name, style.PURPLE)
        label = style.short_input_name(name) if name in style.INPUT_COLOURS else name
        ax.bar(at, heights, width=width, color=colour, label=label)
    ends = [f"{100 * edge:.0f}" for edge in [*(row.low for row in edges), 1.0]]
    ax.set_xticks(np.arange(len(edges) + 1) - 0.5, ends[: len(edges) + 1])
    ax.grid(visible=False, axis="x")
    ax.set(xlabel=MARGIN_LABEL, ylabel=_MSE_LABEL, xlim=(-0.6, len(edges) - 0.4))
    # right of the title, where it can hide no data
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 0.99), ncols=3, borderaxespad=0.2, columnspacing=1.2)
    return ax


def plot_predictions(predictions: ScoredFrames, *, ax: Axes) -> Axes:
    """Draw prediction against label of every frame, in percent, a colour a condition."""
    ax.plot([0, 100], [0, 100], color=style.BLACK, linestyle="--", linewidth=1, label="perfect")
    for name in style.conditions_in_order(predictions.condition):
        frames = predictions.where(predictions.condition == name)
        some = frames.where(np.arange(0, len(frames), max(1, len(frames) // _MOST_DOTS)))
        size = np.clip(3000 / max(len(some), 1), 5, 30)  # few dots are seen as well as many
        dots: Any = {"s": size, "alpha": 0.45, "color": style.CONDITION_COLOURS.get(name, style.GREEN), "label": name}
        # thousands of dots as vectors would swell the page
        ax.scatter(100 * some.safety_margin, 100 * some.prediction, linewidths=0, rasterized=True, **dots)
    # predictions are not clipped to 0-100 %: show all of them
    ends = 100 * predictions.prediction.min(initial=0.0) - 5, 100 * predictions.prediction.max(initial=1.0) + 5
    ax.set(xlabel="True Γ (%)", ylabel="Predicted Γ (%)", xlim=(-3, 103), ylim=ends)
    ax.legend(loc="best")
    return ax


def plot_learning_curves(trainings: Mapping[str, Training], *, ax: Axes) -> Axes:
    """Draw the error on the training and validation frames by epoch, one colour an input; a ring is at the best."""
    for name in style.inputs_in_order(trainings):
        curve, label = trainings[name].curve, style.short_input_name(name)
        colour = style.INPUT_COLOURS.get(name, style.PURPLE)
        dot = "." if len(curve.epoch) <= 40 else ""  # one epoch alone makes no line
        ax.plot(curve.epoch, curve.train_mse, color=colour, linestyle=":", marker=dot, label=f"{label}, training")
        ax.plot(curve.epoch, curve.validation_mse, color=colour, marker=dot, label=f"{label}, validation")
        best = int(np.argmin(curve.validation_mse))
        points = 100 * np.sqrt(curve.validation_mse[best])
        words = f"kept: epoch {curve.epoch[best]:.4g}, error {points:.1f} points"
        ax.plot(curve.epoch[best], curve.validation_mse[best], "o", ms=10, mfc="none", mec=colour, label=words)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.yaxis.set_major_formatter("{x:g}")
    ax.set(xlabel=_EPOCH_LABEL, ylabel=_MSE_LABEL, yscale="log")
    ax.legend()
    return ax


def plot_faithfulness(curves: Mapping[str, DeletionCurve], *, ax: Axes) -> Axes:
    """Draw the mean deletion score D while pixels go, most salient first (thesis, Fig. 9).

    The band holds the middle half of the frames.
    """
    pixels = max(int(curve.pixels_removed.max()) for curve in curves.values())
    for name in style.methods_in_order(curves):
        curve, row = curves[name], EXPLAINERS.get(name)
        colour = row.colour if row else style.BLACK if name == CHANCE else style.PURPLE
        share = 100 * curve.pixels_removed / pixels
        low, high = np.quantile(curve.scores, [0.25, 0.75], axis=0)
        ax.fill_between(share, low, high, color=colour, alpha=0.12, linewidth=0)
        line = row.line if row else ":" if name == CHANCE else "-"
        ax.plot(share, curve.scores.mean(axis=0), color=colour, label=style.method_name(name), linestyle=line)
    ax.set(xlabel="Pixels removed (%)", ylabel="Deletion score D (no unit)", xlim=(0, 100), ylim=(0, 1.03))
    ax.legend()
    return ax


def plot_removal(curve: RemovalCurve, *, colour: str, ax: Axes) -> Axes:
    """Draw the evidence lost while parts go: most supporting first, least supporting first, and at random.

    The band holds the middle half of the frames.
    """
    share = 100 * curve.areas
    low, high = np.quantile(curve.most_first, [0.25, 0.75], axis=0)
    ax.fill_between(share, low, high, color=colour, alpha=0.15, linewidth=0)
    ax.plot(share, curve.most_first.mean(axis=0), color=colour, label="most supporting first")
    ax.plot(share, curve.least_first.mean(axis=0), color=colour, linestyle="--", label="least supporting first")
    ax.plot(share, curve.random.mean(axis=0), color=style.BLACK, linestyle=":", label="random orders")
    return ax


_MOST_DOTS = 4000
