"""Plots of errors, predictions and deletion curves; each draws on the axes it is given."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes

from sliplens.report.records import BinScore, DeletionCurve, Predictions, Training
from sliplens.report.style import (
    BLACK,
    CONTROL,
    GREY,
    INPUT_COLOURS,
    METHOD_COLOURS,
    METHOD_LINES,
    PURPLE,
    inputs_in_order,
    method_name,
    methods_in_order,
    short_input_name,
)

MARGIN_LABEL = "Safety margin Γ (%)"


def plot_bins(bins: Mapping[str, tuple[BinScore, ...]], *, ax: Axes) -> Axes:
    """Draw the MSE in each bin of the safety margin as bars, one colour an input (thesis, Fig. 7).

    Parameters
    ----------
    bins
        Bin scores by input; a bin without frames stays empty.
    """
    names = inputs_in_order(bins)
    width = 0.8 / max(1, len(names))
    for index, name in enumerate(names):
        shown = [(place, score.mse) for place, score in enumerate(bins[name]) if score.mse is not None]
        ax.bar(
            [place + (index - (len(names) - 1) / 2) * width for place, _ in shown],
            [mse for _, mse in shown],
            width=width,
            color=INPUT_COLOURS.get(name, PURPLE),
            label=short_input_name(name),
        )
    edges = next(iter(bins.values()), ())
    ax.set_xticks(
        np.arange(len(edges) + 1) - 0.5,
        [f"{100 * edge:.0f}" for edge in [*(row.low for row in edges), 1.0]][: len(edges) + 1],
    )
    ax.grid(visible=False, axis="x")
    ax.set(xlabel=MARGIN_LABEL, ylabel="MSE (Γ as a fraction, squared)", xlim=(-0.6, len(edges) - 0.4))
    _legend_above(ax)
    return ax


def plot_predictions(predictions: Predictions, *, colour: str, ax: Axes) -> Axes:
    """Draw the answer against the label of every frame, in percent, with the line of perfect answers."""
    ax.plot([0, 100], [0, 100], color=BLACK, linewidth=1, linestyle="--", label="perfect", zorder=3)
    ax.scatter(
        100 * predictions.safety_margin,
        100 * predictions.prediction,
        s=9,
        color=colour,
        alpha=0.45,
        linewidths=0,
        rasterized=True,  # thousands of dots as vectors would swell the page
        label="one frame",
    )
    low, high = _limits(predictions.prediction)
    ax.set(xlabel="True Γ (%)", ylabel="Predicted Γ (%)", xlim=(-3, 103), ylim=(low, high))
    ax.legend(loc="best")
    return ax


def plot_learning_curves(trainings: Mapping[str, Training], *, ax: Axes) -> Axes:
    """Draw the error on the training and validation frames by epoch, one colour an input."""
    for name in inputs_in_order(trainings):
        training, colour = trainings[name], INPUT_COLOURS.get(name, PURPLE)
        label = short_input_name(name)
        ax.plot(training.epoch, training.train_mse, color=colour, linestyle=":", label=f"{label}, training")
        ax.plot(training.epoch, training.validation_mse, color=colour, label=f"{label}, validation")
    ax.set(xlabel="Epoch (passes over the training frames)", ylabel="MSE (Γ as a fraction, squared)", yscale="log")
    ax.legend()
    return ax


def plot_faithfulness(curves: Mapping[str, DeletionCurve], *, pixels: int, ax: Axes) -> Axes:
    """Draw the mean deletion score D while pixels go, most salient first (thesis, Fig. 9).

    The band holds the middle half of the frames.

    Parameters
    ----------
    curves
        Deletion curves by method, the random control among them.
    pixels
        Pixels of an image, for the share removed.
    """
    for name in methods_in_order(curves):
        curve, colour = curves[name], METHOD_COLOURS.get(name, PURPLE)
        share = 100 * curve.pixels_removed / pixels
        low, high = np.quantile(curve.scores, [0.25, 0.75], axis=0)
        ax.fill_between(share, low, high, color=colour, alpha=0.12, linewidth=0)
        ax.plot(
            share,
            curve.scores.mean(axis=0),
            color=colour,
            linestyle=METHOD_LINES.get(name, "-"),
            linewidth=2.2 if name != CONTROL else 2.4,
            label=method_name(name),
        )
    ax.set(xlabel="Pixels removed (%)", ylabel="Deletion score D (no unit)", xlim=(0, 100), ylim=(0, 1.03))
    ax.legend()
    return ax


def plot_margin_over_time(trials: Mapping[str, Predictions], *, ax: Axes) -> Axes:
    """Draw the label and each network's answer through one trial.

    Parameters
    ----------
    trials
        Frames of the same trial by input.
    """
    names = inputs_in_order(trials)
    label = trials[names[0]]
    order = np.argsort(label.time_s)
    ax.plot(label.time_s[order], 100 * label.safety_margin[order], color=BLACK, linewidth=2.4, label="true")
    for name in names:
        trial = trials[name]
        order = np.argsort(trial.time_s)
        ax.plot(
            trial.time_s[order],
            100 * trial.prediction[order],
            color=INPUT_COLOURS.get(name, PURPLE),
            marker="o",
            markersize=3,
            linewidth=1.2,
            label=short_input_name(name),
        )
    ax.axhline(0, color=GREY, linewidth=0.8)
    low, high = _limits(np.concatenate([trial.prediction for trial in trials.values()]))
    ax.set(xlabel="Time (s)", ylabel=MARGIN_LABEL, ylim=(low, high))
    _legend_above(ax)
    return ax


def _legend_above(ax: Axes) -> None:
    # right of the title, where it can hide no data
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 0.99), ncols=3, borderaxespad=0.2, columnspacing=1.2)


def _limits(prediction: np.ndarray) -> tuple[float, float]:
    # answers are not clipped to 0-100 %: show all of them
    return min(-5.0, 100 * float(prediction.min()) - 3), max(105.0, 100 * float(prediction.max()) + 3)
