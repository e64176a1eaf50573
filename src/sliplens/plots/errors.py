"""Errors of a network: by margin, frame, trial and epoch."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from sliplens.plots.style import (
    BLACK,
    BLUE,
    CONDITION_COLOURS,
    GREEN,
    GREY,
    INPUT_COLOURS,
    PURPLE,
    VERMILLION,
    conditions_in_order,
    drawing_style,
    inputs_in_order,
    method_colour,
    method_line,
    method_name,
    methods_in_order,
    place_axes,
    place_text,
    require_picture_path,
    save_page,
    shade_withheld,
    short_input_name,
    write_over,
)
from sliplens.progress import number_of
from sliplens.results.evaluation import (
    BaselineScores,
    BinScore,
    Evaluation,
    RegressionScores,
    Reliability,
    RiskCoverage,
    ScoredFrames,
    Training,
)
from sliplens.results.faithfulness import CHANCE, DeletionCurve

MARGIN_LABEL = "Safety margin Γ (%)"
_MSE_LABEL, _EPOCH_LABEL = "MSE (Γ as a fraction, squared)", "Epoch (passes over the training frames)"
_DOTS: Any = {"linewidths": 0, "rasterized": True}  # thousands of dots as vectors would swell the page


def plot_bins(bins: Mapping[str, tuple[BinScore, ...]], *, ax: Axes) -> Axes:
    """Draw the MSE in each bin of the safety margin as bars, one colour an input (thesis, Fig. 7)."""
    names = inputs_in_order(bins)
    _draw_bins([(short_input_name(name), INPUT_COLOURS.get(name, PURPLE), bins[name]) for name in names], ax=ax)
    edges = next(iter(bins.values()), ())
    ax.set_xticks(
        np.arange(len(edges) + 1) - 0.5,
        [f"{100 * edge:.0f}" for edge in [*(row.low for row in edges), 1.0]][: len(edges) + 1],
    )
    ax.grid(visible=False, axis="x")
    ax.set(xlabel=MARGIN_LABEL, ylabel=_MSE_LABEL, xlim=(-0.6, len(edges) - 0.4))
    _legend_above(ax)
    return ax


def _draw_bins(rows: Sequence[tuple[str, str, Sequence[BinScore]]], *, ax: Axes) -> None:
    """Draw bars of the MSE in each bin, side by side, each row with its name and colour."""
    width = 0.8 / max(1, len(rows))
    for index, (name, colour, bins) in enumerate(rows):
        at = np.arange(len(bins)) + (index - (len(rows) - 1) / 2) * width
        heights = [np.nan if score.mse is None else score.mse for score in bins]
        ax.bar(at, heights, width=width, color=colour, label=name)


def plot_predictions(predictions: ScoredFrames, *, colour: str, ax: Axes) -> Axes:
    """Draw prediction against label of every frame, in percent, with the line of perfect predictions."""
    ax.plot([0, 100], [0, 100], color=BLACK, linewidth=1, linestyle="--", label="perfect", zorder=3)
    label, read = 100 * predictions.safety_margin, 100 * predictions.prediction
    ax.scatter(label, read, s=9, color=colour, alpha=0.45, label="one frame", **_DOTS)
    ax.set(xlabel="True Γ (%)", ylabel="Predicted Γ (%)", xlim=(-3, 103), ylim=_limits(predictions.prediction))
    ax.legend(loc="best")
    return ax


def plot_learning_curves(trainings: Mapping[str, Training], *, ax: Axes) -> Axes:
    """Draw the error on the training and validation frames by epoch, one colour an input."""
    for name in inputs_in_order(trainings):
        curve, colour, label = trainings[name].curve, INPUT_COLOURS.get(name, PURPLE), short_input_name(name)
        ax.plot(curve.epoch, curve.train_mse, color=colour, linestyle=":", label=f"{label}, training")
        ax.plot(curve.epoch, curve.validation_mse, color=colour, label=f"{label}, validation")
    ax.set(xlabel=_EPOCH_LABEL, ylabel=_MSE_LABEL, yscale="log")
    ax.legend()
    return ax


def plot_faithfulness(curves: Mapping[str, DeletionCurve], *, pixels: int, ax: Axes) -> Axes:
    """Draw the mean deletion score D while pixels go, most salient first (thesis, Fig. 9).

    The band holds the middle half of the frames.
    """
    for name in methods_in_order(curves):
        curve, colour = curves[name], method_colour(name)
        share = 100 * curve.pixels_removed / pixels
        low, high = np.quantile(curve.scores, [0.25, 0.75], axis=0)
        ax.fill_between(share, low, high, color=colour, alpha=0.12, linewidth=0)
        line = {"linestyle": method_line(name), "linewidth": 2.2 if name != CHANCE else 2.4}
        ax.plot(share, curve.scores.mean(axis=0), color=colour, label=method_name(name), **line)
    ax.set(xlabel="Pixels removed (%)", ylabel="Deletion score D (no unit)", xlim=(0, 100), ylim=(0, 1.03))
    ax.legend()
    return ax


def _legend_above(ax: Axes) -> None:
    # right of the title, where it can hide no data
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 0.99), ncols=3, borderaxespad=0.2, columnspacing=1.2)


def _limits(prediction: np.ndarray) -> tuple[float, float]:
    # predictions are not clipped to 0-100 %: show all of them
    return min(-5.0, 100 * float(prediction.min()) - 3), max(105.0, 100 * float(prediction.max()) + 3)


_WIDTH, _HEIGHT, _LEFT, _TOP, _GAP, _CHART = 12.0, 7.5, 0.75, 1.25, 0.95, (3.05, 2.25)
_MOST_DOTS = 4000
_ESTIMATOR = 0.36  # inches of a row
_LOWEST_R2 = -0.3  # of the axis; numbers are written beside the bars


def draw_evaluation(evaluation: Evaluation, path: Path, *, title: str) -> None:
    """Save a page of six charts as .png, .pdf or .svg, or of eight where there are baselines.

    Predictions against labels; mean squared error in ten bins of the margin (thesis, Fig. 7); bias of each trial;
    coverage of intervals; the error as frames are withheld; the trial of median error over time. Below, R2 and mean
    absolute error of the network beside those of model-based estimators, where there are any.
    """
    require_picture_path(path, example="evaluation.png")
    conditions = conditions_in_order(evaluation.conditions)
    estimators = {} if evaluation.baselines is None else evaluation.baselines.estimators
    with drawing_style():
        figure = Figure(figsize=(_WIDTH, _HEIGHT + (0.9 + _ESTIMATOR * (len(estimators) + 1) if estimators else 0)))
        columns, tops = [_LEFT + at * (_CHART[0] + _GAP) for at in range(3)], (_TOP, _TOP + _CHART[1] + 1.05)
        charts = [place_axes(figure, column, top, *_CHART) for top in tops for column in columns]
        predictions = evaluation.predictions
        plot_answers(predictions, conditions, ax=charts[0])
        bins = [(name, CONDITION_COLOURS.get(name, GREEN), evaluation.conditions[name].bins) for name in conditions]
        _draw_bins(bins, ax=charts[1])
        charts[1].set(xlabel="True Γ, lower edge of the bin (%)", ylabel=_MSE_LABEL, title="Error by margin")
        charts[1].set_xticks(range(10), [str(10 * edge) for edge in range(10)])
        charts[1].legend(fontsize=8)
        _plot_trials(predictions, conditions, ax=charts[2])
        _plot_coverage(evaluation.reliability, conditions, ax=charts[3])
        _plot_risk(evaluation.risk, ax=charts[4])
        _plot_typical(predictions, evaluation.trials, ax=charts[5])
        if estimators:
            _plot_estimators(figure, {"network": evaluation, **estimators}, conditions, top=_HEIGHT + 0.25)
        place_text(figure, _LEFT - 0.5, 0.2, title, fontsize=13, fontweight="bold", parse_math=False)
        place_text(figure, _LEFT - 0.5, 0.52, _summary(evaluation, conditions), fontsize=9, color=GREY)
    save_page(figure, path)


def plot_answers(predictions: ScoredFrames, conditions: list[str], *, ax: Axes) -> None:
    """Draw prediction against label of every frame, in percent, a colour a condition."""
    for name in conditions:
        rows = np.flatnonzero(predictions.condition == name)
        rows = rows[:: max(1, len(rows) // _MOST_DOTS)]
        label, read = 100 * predictions.safety_margin[rows], 100 * predictions.prediction[rows]
        size = np.clip(3000 / max(len(rows), 1), 5, 30)  # few dots are seen as well as many
        ax.scatter(label, read, s=size, alpha=0.5, color=CONDITION_COLOURS.get(name, GREEN), label=name, **_DOTS)
    ax.plot([0, 100], [0, 100], color=BLACK, linestyle="--", linewidth=1, label="perfect")
    ax.set(xlabel="True Γ (%)", ylabel="Predicted Γ (%)", xlim=(-3, 103), title="Predictions")
    ax.legend(markerscale=2, fontsize=8, loc="upper left")


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


def _plot_coverage(reliability: Mapping[str, Reliability], conditions: list[str], *, ax: Axes) -> None:
    calibrated = {name: reliability[name].coverage for name in conditions if reliability[name].coverage}
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


def _plot_typical(predictions: ScoredFrames, trials: Mapping[str, RegressionScores], *, ax: Axes) -> None:
    ranked = sorted(trials, key=lambda name: trials[name].mse)
    trial = ranked[(len(ranked) - 1) // 2]
    rows = np.flatnonzero(predictions.trial == trial)
    frames = predictions.where(rows[np.argsort(predictions.time_s[rows], kind="stable")])
    shade_withheld(frames.time_s, frames.withheld.tolist(), ax=ax)
    read, low, high = (
        np.where(frames.withheld == "", 100 * values, np.nan)
        for values in (frames.prediction, frames.low_90, frames.high_90)
    )
    if np.isfinite(low).any():
        interval = {"color": VERMILLION, "alpha": 0.2, "linewidth": 0, "label": "90 % interval"}
        ax.fill_between(frames.time_s, low, high, **interval)
    if np.isfinite(read).any():
        ax.plot(frames.time_s, read, color=VERMILLION, label="predicted")
    ax.plot(frames.time_s, 100 * frames.safety_margin, color=BLACK, linestyle="--", label="true")
    ax.set(xlabel="Time (s)", ylabel="Γ (%)")
    ax.set_title(f"Median error: {trial if len(trial) <= 18 else f'…{trial[-17:]}'}", parse_math=False)
    ax.legend(fontsize=8)


def _plot_estimators(
    figure: Figure, estimators: Mapping[str, Evaluation | BaselineScores], conditions: list[str], *, top: float
) -> None:
    """Draw bars of R2 and of the mean absolute error, a row an estimator."""
    start, gap = 2.35, 0.5
    size = (_WIDTH - start - gap - 0.5) / 2, _ESTIMATOR * len(estimators)
    first, second = (place_axes(figure, start + at * (size[0] + gap), top, *size) for at in range(2))
    thick = 0.8 / max(1, len(conditions))
    for index, name in enumerate(conditions):
        scores = [estimator.conditions[name] for estimator in estimators.values()]
        at = np.arange(len(estimators)) + (index - (len(conditions) - 1) / 2) * thick
        r2 = np.array([np.nan if score.r2 is None else score.r2 for score in scores])
        mae = np.array([100 * score.mae for score in scores])
        for ax, values, digits in ((first, r2, 2), (second, mae, 1)):
            ax.barh(
                at, np.maximum(values, _LOWEST_R2), height=thick, color=CONDITION_COLOURS.get(name, GREEN), label=name
            )
            for place, value in zip(at, values, strict=True):
                if np.isfinite(value):
                    # -0.00 would look like less than nothing
                    ax.text(max(value, 0), place, f" {round(value, digits) + 0.0:.{digits}f}", va="center", fontsize=7)
    first.axvline(0, color=BLACK, linewidth=1)
    first.set(xlabel="R²", title="Network, and estimators from the markers alone")
    first.set_xlim(max(first.get_xlim()[0], _LOWEST_R2), 1.08)
    second.set(xlabel="Mean absolute error (points of Γ)")
    for ax, names in ((first, list(estimators)), (second, [""] * len(estimators))):
        ax.set_yticks(range(len(estimators)), names)
        ax.set_ylim(len(estimators) - 0.4, -0.6)
        ax.grid(visible=False, axis="y")
    second.legend(fontsize=8, loc="lower right")


def _summary(evaluation: Evaluation, conditions: list[str]) -> str:
    parts = []
    for name in conditions:
        scores, lead = evaluation.conditions[name], evaluation.lead_times[name]
        r2 = "none" if scores.r2 is None else f"{scores.r2:.3f}"
        words = f"{name}: {number_of(scores.frames, 'frame')}, MSE {scores.mse:.4f}, R² {r2}, "
        words += f"MAE {100 * scores.mae:.1f} points"
        slipping = f"{number_of(lead.trials, 'trial')} that slip"
        if lead.median_ms is not None:
            words += f", warns in {lead.warned} of {slipping}, {lead.median_ms:.0f} ms before"
            words += f" (the true Γ: {lead.ideal_ms:.0f} ms)"
        elif lead.trials:
            words += f", warns in none of {slipping}"
        parts.append(f"{words}, {lead.false_per_minute:.1f} false alarms a minute")
    return "\n".join(parts)


def draw_learning_curve(training: Training, path: Path, *, title: str) -> None:
    """Save the errors of a training by epoch, on a logarithmic scale, with the epoch whose weights were kept."""
    curve = training.curve
    epoch, train, validation = curve.epoch, curve.train_mse, curve.validation_mse
    best = int(np.argmin(validation))
    # few epochs have a dot each: one alone makes no line
    colour, dot = INPUT_COLOURS.get(training.input, BLUE), "o" if len(epoch) <= 40 else ""
    ring: Any = {"markersize": 10, "markerfacecolor": "none", "markeredgewidth": 1.6, "color": VERMILLION}
    errors = np.concatenate([train, validation])
    with drawing_style():
        figure = Figure(figsize=(7.0, 4.4))
        ax = place_axes(figure, 0.95, 0.75, 5.8, 3.05)
        ax.plot(epoch, train, color=colour, linestyle=":", marker=dot, markersize=3, label="training, augmented")
        ax.plot(epoch, validation, color=colour, marker=dot, markersize=3, label="validation")
        ax.plot(epoch[best], validation[best], marker="o", linestyle="", label="kept", **ring)
        ax.set(xlabel=_EPOCH_LABEL, ylabel=_MSE_LABEL, yscale="log", xlim=(0, 1.03 * max(1.0, float(epoch[-1]))))
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        # room above and below, so that a curve that hardly falls looks like one
        ax.set_ylim(0.7 * float(errors.min()), 1.4 * float(errors.max()))
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5, 7)))
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_locator(NullLocator())
        ax.legend()
        place_text(figure, 0.25, 0.15, title, fontsize=12, fontweight="bold", parse_math=False)
        summary = f"kept: epoch {epoch[best]:.4g}, validation MSE {validation[best]:.4g}"
        summary += f", root mean square error {100 * np.sqrt(validation[best]):.1f} points of Γ"
        place_text(figure, 0.25, 0.42, summary, fontsize=9, color=GREY)
        save_page(figure, path)
