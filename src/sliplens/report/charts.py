"""Charts of the page: which numbers go into which picture, and what its caption says."""

import numpy as np
from matplotlib.axes import Axes

from sliplens.report.drawing import Chart, draw_picture
from sliplens.report.figures import (
    plot_bins,
    plot_faithfulness,
    plot_learning_curves,
    plot_margin_over_time,
    plot_predictions,
)
from sliplens.report.records import Predictions, Scored
from sliplens.report.style import (
    INPUT_COLOURS,
    PURPLE,
    conditions_in_order,
    decimals,
    input_name,
    inputs_in_order,
    method_name,
    methods_in_order,
    percent,
    source_name,
)
from sliplens.report.workspace import Results


def chart_bins(results: Results) -> Chart:
    """Chart the MSE in bins of the safety margin, one picture a condition."""
    evaluations = results.evaluations
    scores = {
        condition: {
            name: evaluations[name].conditions[condition].bins
            for name in inputs_in_order(evaluations)
            if condition in evaluations[name].conditions
        }
        for condition in _conditions(results)
    }
    every = [row for bins in scores.values() for rows in bins.values() for row in rows if row.mse is not None]
    top = 1.15 * max((row.mse or 0.0 for row in every), default=1.0)
    pictures = []
    for condition, bins in scores.items():

        def plot(ax: Axes, condition: str = condition, bins: dict = bins) -> None:
            # one scale for all conditions, or the eye compares bars that do not compare
            plot_bins(bins, ax=ax).set(title=_title(condition.capitalize()), ylim=(0, top))

        pictures.append(draw_picture(plot, alt=f"Bars of the MSE in bins of Γ, {condition}; worst bin: {_worst(bins)}"))
    worst = "; ".join(f"{condition}: {_worst(bins)}" for condition, bins in scores.items())
    return Chart(
        pictures=tuple(pictures),
        caption=f"Mean squared error by bins of the true safety margin. Largest error, {worst}. "
        "A bin without bars holds no test frame.",
    )


def chart_predictions(results: Results) -> Chart:
    """Chart the answer against the label, one picture an input and condition."""
    answers = np.concatenate([one.predictions.prediction for one in results.evaluations.values()])
    # one scale for all, so that the scatter compares
    low, high = min(0.0, 100 * float(answers.min())), max(100.0, 100 * float(answers.max()))
    pictures = []
    for condition in _conditions(results):
        for name in inputs_in_order(results.evaluations):
            evaluation = results.evaluations[name]
            rows = evaluation.predictions.condition == condition
            if not rows.any() or condition not in evaluation.conditions:
                continue
            title = f"{input_name(name)}, {_title(condition)} (R² {decimals(evaluation.conditions[condition].r2, 2)})"
            shown, colour = evaluation.predictions.where(rows), INPUT_COLOURS.get(name, PURPLE)

            def plot(ax: Axes, shown: Predictions = shown, colour: str = colour, title: str = title) -> None:
                plot_predictions(shown, colour=colour, ax=ax).set(title=title, ylim=(low - 5, high + 5))

            pictures.append(draw_picture(plot, alt=f"Predicted against true Γ: {title}, {rows.sum()} frames"))
    frames = sum(len(one.predictions.trial) for one in results.evaluations.values())
    return Chart(
        pictures=tuple(pictures),
        caption=f"Predicted against true safety margin, {frames} answers on frames of test trials. "
        "A perfect network would put every dot on the dashed line.",
    )


def chart_over_time(results: Results) -> Chart:
    """Chart label and answers through one typical test trial of each condition."""
    pictures, chosen = [], []
    for condition in _conditions(results):
        trial = _typical_trial(results, condition)
        if trial is None:
            continue
        shown = {}
        for name, evaluation in results.evaluations.items():
            rows = (evaluation.predictions.trial == trial) & (evaluation.predictions.condition == condition)
            if rows.any():
                shown[name] = evaluation.predictions.where(rows)

        def plot(ax: Axes, shown: dict = shown, condition: str = condition) -> None:
            plot_margin_over_time(shown, ax=ax).set_title(_title(condition.capitalize()))

        pictures.append(
            draw_picture(plot, alt=f"True and predicted Γ over time through test trial {trial}, {condition}")
        )
        chosen.append(f"{trial} ({condition})")
    return Chart(
        pictures=tuple(pictures),
        caption="Safety margin through one test trial of each condition: the trial whose mean error is the median of "
        f"all, neither the best nor the worst. Shown: {', '.join(chosen)}.",
    )


def chart_learning(results: Results) -> Chart:
    """Chart the learning curves of all inputs in one picture."""
    told = [
        f"{input_name(name)}: best validation MSE {decimals(one.best_validation_mse, 4)} "
        f"after {decimals(one.epochs, 1)} epochs (stopped by {one.stopped_by})"
        for name in inputs_in_order(results.trainings)
        for one in [results.trainings[name]]
    ]
    picture = draw_picture(
        lambda ax: plot_learning_curves(results.trainings, ax=ax),
        alt="Training and validation error by epoch. " + "; ".join(told),
        size_in=(5.6, 3.2),
    )
    return Chart(pictures=(picture,), caption=f"Learning curves. {'; '.join(told)}.", columns=1)


def chart_faithfulness(results: Results, scores: dict[str, Scored]) -> Chart:
    """Chart the deletion curves, one picture an input."""
    pictures, frames = [], set()
    for name in inputs_in_order(scores):
        scored = scores[name]
        explained = results.explanations.get((name, scored.source))
        pixels = max(int(curve.pixels_removed.max()) for curve in scored.curves.values())
        if explained is not None:
            pixels = max(pixels, explained.image_size**2)
        frames |= {len(curve.frame_ids) for curve in scored.curves.values()}
        drawn = ", ".join(
            f"{method_name(method)} mean {decimals(float(scored.curves[method].scores.mean()), 2)}"
            for method in methods_in_order(scored.curves)
        )

        def plot(ax: Axes, scored: Scored = scored, pixels: int = pixels, name: str = name) -> None:
            plot_faithfulness(scored.curves, pixels=pixels, ax=ax).set_title(input_name(name))

        pictures.append(draw_picture(plot, alt=f"Deletion curves of {input_name(name)}: {drawn}", size_in=(4.2, 3.4)))
    sources = " and ".join(sorted({source_name(scored.source) for scored in scores.values()}))
    fills = sorted({scored.fill for scored in scores.values()})
    return Chart(
        pictures=tuple(pictures),
        caption=f"Deletion score D on {sources} while pixels become {' or '.join(fills)}, most salient first: mean of "
        f"{' or '.join(str(count) for count in sorted(frames))} frames, the band holds the middle half of them. A "
        "curve that falls early names pixels the network relies on; one above the dotted curve does worse than chance.",
    )


def _conditions(results: Results) -> list[str]:
    return conditions_in_order(name for one in results.evaluations.values() for name in one.conditions)


def _title(condition: str) -> str:
    # matplotlib would read what stands between dollar signs as mathematics
    return condition.replace("$", r"\$")


def _worst(bins: dict) -> str:
    rows = [(row.mse, row, name) for name, scores in bins.items() for row in scores if row.mse is not None]
    if not rows:
        return "no frame"
    mse, row, name = max(rows, key=lambda one: one[0])
    return f"{input_name(name).lower()} at {100 * row.low:.0f} to {percent(row.high)} (MSE {mse:.3f})"


def _typical_trial(results: Results, condition: str) -> str | None:
    # judged by the last input (difference where it was run), so that the choice favours neither curve by eye
    name = inputs_in_order(results.evaluations)[-1]
    shown = results.evaluations[name].predictions
    shown = shown.where(shown.condition == condition)
    trials = np.unique(shown.trial)
    if len(trials) == 0:
        return None
    error = np.abs(shown.prediction - shown.safety_margin)
    ranked = sorted(trials.tolist(), key=lambda trial: float(error[shown.trial == trial].mean()))
    return ranked[(len(ranked) - 1) // 2]
