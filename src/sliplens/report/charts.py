"""Plates that are charts: errors by margin, deletion and removal curves, weights drawn anew."""

from collections.abc import Mapping
from textwrap import fill as wrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sliplens.plots import errors, style
from sliplens.progress import number_of
from sliplens.report.comparisons import settings
from sliplens.report.plates import Plate, named_columns, rows_of
from sliplens.report.results import Results
from sliplens.results.faithfulness import DeletionScores, Faithfulness, RemovalCurve, is_control

_FEW = 4  # charts in a row


def plate_bins(results: Results) -> Plate:
    """Draw the MSE by bins of the margin, a chart a condition (thesis, Fig. 7)."""
    evaluations, conditions = results.evaluations, _conditions(results)
    bins = {
        condition: {
            name: evaluations[name].conditions[condition].bins
            for name in style.inputs_in_order(evaluations)
            if condition in evaluations[name].conditions
        }
        for condition in conditions
    }
    rows = [
        (condition, name, row.low, row.high, row.frames, row.mse)
        for condition, by_input in bins.items()
        for name, scores in by_input.items()
        for row in scores
    ]
    # one scale for all conditions, or the eye compares bars that do not compare
    top = 1.15 * max((row[5] for row in rows if row[5] is not None), default=1.0)
    figure, axes = make_charts(len(conditions), each=(4.4, 3.2))
    text = []
    with style.drawing_style():
        for ax, condition in zip(axes, conditions, strict=True):
            errors.plot_bins(bins[condition], ax=ax).set(ylim=(0, top))
            ax.set_title(f"{condition.capitalize()} objects", parse_math=False)
            valid = [row for row in rows if row[0] == condition and row[5] is not None]
            if valid:
                _, name, low, high, _, mse = max(valid, key=lambda row: row[5] or 0.0)
                place = f"{style.percent(low)} to {style.percent(high)}, {style.input_name(name).lower()}"
                text.append(f"{condition}: {place}, MSE {mse:.4f}")
    return Plate(
        name="fig-07-mse-by-bin",
        figure=figure,
        alt=f"Bars of the mean squared error in bins of Γ; largest, {'; '.join(text)}",
        caption=f"Mean squared error by bins of the true safety margin. Largest error, {'; '.join(text)}. A bin "
        "without bars holds no test frame.",
        numbers=named_columns(("condition", "input", "low", "high", "frames", "mse"), rows),
    )


def plate_predictions(results: Results) -> Plate:
    """Draw the answer against the label, a chart an input and condition."""
    answers = np.concatenate([evaluation.predictions.prediction for evaluation in results.evaluations.values()])
    # one scale for all, so that the scatter compares
    low, high = min(0.0, 100 * float(answers.min())), max(100.0, 100 * float(answers.max()))
    chosen = [
        (name, condition, evaluation.predictions.where(evaluation.predictions.condition == condition))
        for condition in _conditions(results)
        for name in style.inputs_in_order(results.evaluations)
        for evaluation in [results.evaluations[name]]
        if condition in evaluation.conditions and (evaluation.predictions.condition == condition).any()
    ]
    figure, axes = make_charts(len(chosen), each=(3.4, 3.1))
    rows = []
    with style.drawing_style():
        for ax, (name, condition, frames) in zip(axes, chosen, strict=True):
            r2 = style.decimals(results.evaluations[name].conditions[condition].r2, 2)
            errors.plot_predictions(frames, colour=style.INPUT_COLOURS.get(name, style.PURPLE), ax=ax)
            ax.set(ylim=(low - 5, high + 5))
            ax.set_title(f"{style.short_input_name(name)}, {condition} (R² {r2})", parse_math=False)
            answered = (frames.trial, frames.condition, frames.frame, frames.safety_margin, frames.prediction)
            rows += [(name, *values) for values in rows_of(*answered)]
    return Plate(
        name="predictions",
        figure=figure,
        alt="Predicted against true Γ: "
        f"{style.listed([f'{style.input_name(name)}, {kind}' for name, kind, _ in chosen])}",
        caption=f"Predicted against true safety margin, {len(answers)} answers on frames of test trials. A perfect "
        "network would put every dot on the dashed line.",
        numbers=named_columns(("input", "trial", "condition", "frame", "safety_margin", "prediction"), rows),
    )


def plate_learning(results: Results) -> Plate:
    """Draw the learning curves of all inputs."""
    trainings = {name: results.trainings[name] for name in style.inputs_in_order(results.trainings)}
    text = "; ".join(
        f"{style.input_name(name)}: best validation MSE {style.decimals(training.best_validation_mse, 4)} "
        f"after {style.decimals(training.epochs, 1)} epochs (stopped by {training.stopped_by})"
        for name, training in trainings.items()
    )
    figure, axes = make_charts(1, each=(5.6, 3.2))
    with style.drawing_style():
        errors.plot_learning_curves(trainings, ax=axes[0])
    rows = [
        (name, *values)
        for name, training in trainings.items()
        for values in rows_of(training.curve.epoch, training.curve.train_mse, training.curve.validation_mse)
    ]
    return Plate(
        name="learning",
        figure=figure,
        alt=f"Training and validation error by epoch. {text}",
        caption=f"Learning curves. {text}.",
        numbers=named_columns(("input", "epoch", "train_mse", "validation_mse"), rows),
    )


def plate_faithfulness(scores: Mapping[str, DeletionScores]) -> Plate:
    """Draw the mean deletion score while pixels go, a chart an input, all of one source (thesis, Fig. 9)."""
    figure, axes = make_charts(len(scores), each=(4.6, 3.5))
    with style.drawing_style():
        for ax, (name, score) in zip(axes, scores.items(), strict=True):
            errors.plot_faithfulness(score.curves, pixels=_pixels(score), ax=ax).set_title(style.input_name(name))
    text = "; ".join(f"{style.input_name(name).lower()}: {_tell_order(score)}" for name, score in scores.items())
    source = " or ".join(sorted({style.source_name(score.source) for score in scores.values()}))
    fill = " or ".join(sorted({score.fill for score in scores.values()}))
    real = "-real" if all(score.source == "real" for score in scores.values()) else ""
    return Plate(
        name=f"fig-09-faithfulness{real}",
        figure=figure,
        alt=f"Deletion score D against pixels removed. Mean over all steps, {text}",
        caption=f"Deletion score D of the thesis on {source} while pixels become {fill}, most salient first; the line "
        "is the mean over frames, the band holds the middle half of them. A curve that falls early names pixels the "
        f"network relies on. Mean over all steps, lowest first, {text}.",
        numbers=_deletion_numbers(scores),
    )


def plate_removal_curves(faithful: Faithfulness) -> Plate | None:
    """Draw change against area, most and least influential first and at random, by method and fill; None without."""
    methods = style.methods_in_order({method for _, _, method in faithful.curves if not is_control(method)})
    fills = settings(faithful)
    if not methods or not fills:
        return None
    chosen = [curve for key, curve in faithful.curves.items() if key[2] in methods]
    top = max(float(curve.most_first.mean(axis=0).max()) for curve in chosen)
    # below zero where more speaks for the answer than before
    bottom = min(
        float(line.mean(axis=0).min()) for record in chosen for line in (record.most_first, record.least_first)
    )
    with style.drawing_style():
        figure = Figure(figsize=(1.75 * len(fills) + 0.9, 1.55 * len(methods) + 0.9), layout="constrained")
        axes = figure.subplots(len(methods), len(fills), squeeze=False, sharex=True, sharey=True)
        for line, method in zip(axes, methods, strict=True):
            for ax, (fill, unit) in zip(line, fills, strict=True):
                curve = faithful.curves.get((fill, unit, method))
                if curve is None:
                    ax.set_axis_off()
                else:
                    _plot_removal(curve, method, ax=ax)
            line[0].set_ylabel(wrap(style.method_name(method), 20), fontsize=8.5)
        for ax, (fill, unit) in zip(axes[0], fills, strict=True):
            ax.set_title(style.fill_name(fill, unit).capitalize().replace(" (", "\n("), fontsize=8.5)
        axes[0, 0].set(ylim=(1.15 * min(bottom, 0.0), 1.15 * max(top, 1e-3)), xlim=(0, 100), xticks=[0, 50, 100])
        kinds: dict[str, Any] = {"most supporting first": "-", "least supporting first": "--", "random orders": ":"}
        handles = [Line2D([], [], color=style.BLACK, linestyle=line, label=label) for label, line in kinds.items()]
        figure.legend(handles=handles, loc="outside upper left", ncols=3)
        figure.supxlabel("Removed (% of the image)", fontsize=9)
        figure.supylabel("Evidence lost (margin units)", fontsize=9)
    numbers = []
    for key, curve in faithful.curves.items():
        lines = (line.mean(axis=0) for line in (curve.most_first, curve.least_first, curve.random))
        numbers += [(*key, *values) for values in rows_of(curve.areas, *lines)]
    return Plate(
        name=f"sound-curves-{faithful.input}",
        figure=figure,
        alt=f"Evidence lost against the area removed, {style.input_name(faithful.input).lower()}, for "
        f"{style.listed([style.method_name(method) for method in methods])}",
        caption=f"{style.input_name(faithful.input)}: how much of the answer's change from the untouched sensor is "
        "lost while parts go, most supporting first, "
        f"least supporting first, and in {faithful.random_orders} random orders; the band holds the middle half of "
        f"{number_of(faithful.frames, 'frame')}. The area between the first two is the symmetric gain. "
        f"{_tell_gains(faithful, methods)}",
        numbers=named_columns(("fill", "unit", "method", "area", "most_first", "least_first", "random"), numbers),
    )


def plate_randomisation(results: Results) -> Plate:
    """Draw how alike maps stay as layers get new weights, a chart an input."""
    records = results.study.randomisation
    names = style.inputs_in_order(records)[::-1]
    rows, text = [], []
    figure, axes = make_charts(len(names), each=(4.6, 3.5), sharey=True)
    with style.drawing_style():
        for ax, name in zip(axes, names, strict=True):
            for method in style.methods_in_order(records[name].methods):
                record = records[name].methods[method]
                colour, line = style.method_colour(method), style.method_line(method)
                dots = {"marker": "o", "markersize": 3.5, "label": style.method_name(method)}
                similarity = np.array(record.similarity, dtype=np.float64)
                ax.plot(record.layers, similarity, color=colour, linestyle=line, **dots)
                rows += [
                    (name, method, layer, value) for layer, value in zip(record.layers, record.similarity, strict=True)
                ]
                last = record.similarity[-1] if record.similarity else None
                if last is not None:
                    where = style.short_input_name(name).lower()
                    text.append(f"{style.method_name(method)} {style.signed(last, 2)} ({where})")
            ax.axhline(0, color=style.BLACK, linewidth=0.8, linestyle=":")
            ax.set(xlabel="Layers with new weights, from the output", ylabel="Similarity of the map (no unit)")
            ax.set_title(style.input_name(name))
        lines = {line.get_label(): line for ax in axes for line in ax.get_lines() if line.get_marker() == "o"}
        figure.legend(handles=list(lines.values()), loc="outside upper left", ncols=3)
    return Plate(
        name="randomisation",
        figure=figure,
        alt=f"Similarity of maps while layers get new weights; with all new: {', '.join(text)}",
        caption="Similarity of each method's map to that of the trained network while layers get new weights: a map "
        "that stays alike does not show what was learned. With the last layer tested new: "
        f"{', '.join(text) or 'not defined'}.",
        numbers=named_columns(("input", "method", "layers", "similarity"), rows),
    )


def make_charts(count: int, *, each: tuple[float, float], sharey: bool = False) -> tuple[Figure, list[Axes]]:
    """Make a figure of some charts, at most `_FEW` in a row."""
    wide = min(count, _FEW)
    high = -(-count // wide)
    with style.drawing_style():
        figure = Figure(figsize=(each[0] * wide, each[1] * high), layout="constrained")
        axes = list(figure.subplots(high, wide, squeeze=False, sharey=sharey).ravel())
    for ax in axes[count:]:
        ax.set_axis_off()
    return figure, axes[:count]


def _conditions(results: Results) -> list[str]:
    return style.conditions_in_order(
        name for evaluation in results.evaluations.values() for name in evaluation.conditions
    )


def _pixels(scored: DeletionScores) -> int:
    return max(int(curve.pixels_removed.max()) for curve in scored.curves.values())


def _tell_order(scored: DeletionScores) -> str:
    means = {method: float(curve.scores.mean()) for method, curve in scored.curves.items()}
    return ", ".join(
        f"{style.method_name(mean)} {means[mean]:.3f}" for mean in sorted(means, key=lambda one: means[one])
    )


def _deletion_numbers(scores: Mapping[str, DeletionScores]) -> dict[str, list]:
    names = ("input", "method", "pixels_removed", "share_removed", "mean", "quartile_low", "quartile_high", "sd")
    rows = []
    for name, score in scores.items():
        for method in style.methods_in_order(score.curves):
            curve = score.curves[method]
            mean, quartiles = curve.scores.mean(axis=0), np.quantile(curve.scores, [0.25, 0.75], axis=0)
            removed = (curve.pixels_removed, curve.pixels_removed / _pixels(score))
            rows += [(name, method, *row) for row in rows_of(*removed, mean, *quartiles, curve.scores.std(axis=0))]
    return named_columns(names, rows)


def _plot_removal(curve: RemovalCurve, method: str, *, ax: Axes) -> None:
    share, colour = 100 * curve.areas, style.method_colour(method)
    low, high = np.quantile(curve.most_first, [0.25, 0.75], axis=0)
    ax.fill_between(share, low, high, color=colour, alpha=0.15, linewidth=0)
    ax.plot(share, curve.most_first.mean(axis=0), color=colour, linewidth=1.6)
    ax.plot(share, curve.least_first.mean(axis=0), color=colour, linestyle="--", linewidth=1.3)
    ax.plot(share, curve.random.mean(axis=0), color=style.BLACK, linestyle=":", linewidth=1.3)
    ax.tick_params(labelsize=7.5)


def _tell_gains(faithful: Faithfulness, methods: list[str]) -> str:
    fill, unit = settings(faithful)[0]
    curves = {method: faithful.curves.get((fill, unit, method)) for method in methods}
    gains = {method: float(curve.symmetric_gain.mean()) for method, curve in curves.items() if curve is not None}
    ranked = sorted(gains, key=lambda one: -gains[one])
    text = ", ".join(f"{style.method_name(record)} {style.signed(gains[record], 3)}" for record in ranked)
    return f"Under {style.fill_name(fill, unit)} it is {text}."
