"""Errors of a network: by margin, frame, trial and epoch."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sliplens.plots.margins import MARGIN_LABEL, plot_margins
from sliplens.plots.style import (
    BLACK,
    BLUE,
    CONDITION_COLOURS,
    GREEN,
    GREY,
    INPUT_COLOURS,
    PURPLE,
    conditions_in_order,
    drawing_style,
    in_order,
    inputs_in_order,
    method_colour,
    method_line,
    method_name,
    methods_in_order,
    require_picture_path,
    save_page,
    short_input_name,
    write_over,
)
from sliplens.results.evaluation import (
    BinScore,
    Evaluation,
    RiskCoverage,
    ScoredFrames,
    Training,
)
from sliplens.results.faithfulness import DeletionCurve, RemovalCurve

_MSE_LABEL, _EPOCH_LABEL = "MSE (Γ as a fraction, squared)", "Epoch (passes over the training frames)"


def plot_bins(bins: Mapping[str, Sequence[BinScore]], *, ax: Axes) -> Axes:
    """Draw the MSE in each bin of the safety margin as bars, a colour an input or condition (thesis, Fig. 7)."""
    width, names = 0.8 / max(1, len(bins)), in_order(bins, (*INPUT_COLOURS, *CONDITION_COLOURS))
    edges = next(iter(bins.values()), ())
    for index, name in enumerate(names):
        at = np.arange(len(edges)) + (index - (len(names) - 1) / 2) * width
        heights = [np.nan if score.mse is None else score.mse for score in bins[name]]
        colour = (INPUT_COLOURS | CONDITION_COLOURS).get(name, PURPLE)
        label = short_input_name(name) if name in INPUT_COLOURS else name
        ax.bar(at, heights, width=width, color=colour, label=label)
    ends = [f"{100 * edge:.0f}" for edge in [*(row.low for row in edges), 1.0]]
    ax.set_xticks(np.arange(len(edges) + 1) - 0.5, ends[: len(edges) + 1])
    ax.grid(visible=False, axis="x")
    ax.set(xlabel=MARGIN_LABEL, ylabel=_MSE_LABEL, xlim=(-0.6, len(edges) - 0.4))
    # right of the title, where it can hide no data
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 0.99), ncols=3, borderaxespad=0.2, columnspacing=1.2)
    return ax


def plot_predictions(predictions: ScoredFrames, *, ax: Axes, colour: str | None = None) -> Axes:
    """Draw prediction against label of every frame, in percent, in one colour, or in one a condition."""
    conditions = [] if colour else conditions_in_order(predictions.condition)
    groups = {name: predictions.where(predictions.condition == name) for name in conditions}
    ax.plot([0, 100], [0, 100], color=BLACK, linestyle="--", linewidth=1, label="perfect")
    for name, frames in (groups or {"one frame": predictions}).items():
        some = frames.where(np.arange(0, len(frames), max(1, len(frames) // _MOST_DOTS)))
        size = np.clip(3000 / max(len(some), 1), 5, 30)  # few dots are seen as well as many
        dots: Any = {"s": size, "alpha": 0.45, "color": colour or CONDITION_COLOURS.get(name, GREEN), "label": name}
        # thousands of dots as vectors would swell the page
        ax.scatter(100 * some.safety_margin, 100 * some.prediction, linewidths=0, rasterized=True, **dots)
    ax.set(xlabel="True Γ (%)", ylabel="Predicted Γ (%)", xlim=(-3, 103))
    # predictions are not clipped to 0-100 %: show all of them
    ends = 100 * predictions.prediction.min(initial=0.0), 100 * predictions.prediction.max(initial=1.0)
    ax.set_ylim(ends[0] - 5, ends[1] + 5)
    ax.legend(loc="best")
    return ax


def plot_learning_curves(trainings: Mapping[str, Training], *, ax: Axes) -> Axes:
    """Draw the error on the training and validation frames by epoch, one colour an input; a ring is at the best."""
    for name in inputs_in_order(trainings):
        curve, colour, label = trainings[name].curve, INPUT_COLOURS.get(name, PURPLE), short_input_name(name)
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
    for name in methods_in_order(curves):
        curve, colour = curves[name], method_colour(name)
        share = 100 * curve.pixels_removed / pixels
        low, high = np.quantile(curve.scores, [0.25, 0.75], axis=0)
        ax.fill_between(share, low, high, color=colour, alpha=0.12, linewidth=0)
        ax.plot(share, curve.scores.mean(axis=0), color=colour, label=method_name(name), linestyle=method_line(name))
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
    ax.plot(share, curve.random.mean(axis=0), color=BLACK, linestyle=":", label="random orders")
    return ax


_MOST_DOTS = 4000


def draw_evaluation(evaluation: Evaluation, path: Path, *, title: str) -> None:
    """Save a page of six charts as .png, .pdf or .svg.

    Predictions against labels; mean squared error in ten bins of the margin (thesis, Fig. 7); bias of each trial;
    coverage of intervals; the error as frames are withheld; the trial of median error over time.
    """
    require_picture_path(path, example="evaluation.png")
    conditions = conditions_in_order(evaluation.conditions)
    predictions, trials = evaluation.predictions, evaluation.trials
    with drawing_style():
        figure = Figure(figsize=(12, 7.5), layout="constrained")
        figure.suptitle(title, x=0.01, ha="left", fontsize=13, fontweight="bold", parse_math=False)
        scatter, errors, biases, coverage, risk, typical = figure.subplots(2, 3).ravel()
        plot_predictions(predictions, ax=scatter).set_title("Predictions")
        plot_bins({name: evaluation.conditions[name].bins for name in conditions}, ax=errors)
        errors.set_title("Error by margin")
        _plot_trials(predictions, conditions, ax=biases)
        _plot_coverage(evaluation.coverage, conditions, ax=coverage)
        _plot_risk(evaluation.risk, ax=risk)
        ranked = sorted(trials, key=lambda name: trials[name].mse)
        rows = predictions.where(predictions.trial == ranked[(len(ranked) - 1) // 2])
        plot_margins(rows.where(np.argsort(rows.time_s, kind="stable")).to_arrow(), ax=typical)
        typical.set_xlabel("Time (s), in the trial of median error")
        save_page(figure, path)


def _plot_trials(predictions: ScoredFrames, conditions: list[str], *, ax: Axes) -> None:
    for place, name in enumerate(conditions):
        rows = predictions.where(predictions.condition == name)
        error = 100 * (rows.prediction - rows.safety_margin)
        biases = [float(error[rows.trial == trial].mean()) for trial in np.unique(rows.trial)]
        spread = np.linspace(-0.25, 0.25, len(biases)) if len(biases) > 1 else np.zeros(1)
        ax.scatter(np.sort(biases), place + spread, s=14, color=CONDITION_COLOURS.get(name, GREEN), linewidths=0)
    ax.axvline(0, color=BLACK, linewidth=1, linestyle="--")
    ax.set(xlabel="Mean of predicted less true Γ (points)", title="Bias of each trial")
    ax.set_ylim(len(conditions) - 0.5, -0.5)
    ax.set_yticks(range(len(conditions)), conditions)


def _plot_coverage(coverage: Mapping[str, Mapping[str, float]], conditions: list[str], *, ax: Axes) -> None:
    calibrated = {name: coverage[name] for name in conditions if coverage[name]}
    for name, shares in calibrated.items():
        nominal, actual = zip(
            *sorted((100 * float(level), 100 * share) for level, share in shares.items()), strict=True
        )
        ax.plot(nominal, actual, label=name, color=CONDITION_COLOURS.get(name, GREEN), marker="o", markersize=4)
    ax.plot([0, 100], [0, 100], color=BLACK, linestyle="--", linewidth=1, label="nominal")
    ax.set(xlabel="Nominal (% of the frames)", ylabel="Covered (%)", xlim=(40, 100), ylim=(0, 102), title="Intervals")
    if not calibrated:
        write_over(ax, "this network was never calibrated")
    ax.legend(markerscale=2, fontsize=8, loc="upper left")


def _plot_risk(risk: RiskCoverage | None, *, ax: Axes) -> None:
    ax.set(xlabel="Withheld (% of the frames)", ylabel="MAE of the rest (points of Γ)", xlim=(0, 96))
    ax.set_title("Error after withholding")
    if risk is None:
        write_over(ax, "not measured")
        return
    colours = {"known": BLUE, "spread": PURPLE, "perfect": GREY}
    words = {"known": "least known first", "spread": "widest first", "perfect": "worst first (ideal)"}
    for name, errors in risk.error.items():
        line = "--" if name == "perfect" else "-"
        shares = 100 * (1 - np.array(risk.covered))
        ax.plot(shares, 100 * np.array(errors), color=colours[name], linestyle=line, label=words[name])
    ax.set_ylim(bottom=0)
    ax.legend(fontsize=8)
