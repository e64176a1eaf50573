"""Sections of the page: what each holds, and what is still missing of it."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes

from sliplens.plots.errors import (
    plot_bins,
    plot_faithfulness,
    plot_learning_curves,
    plot_margin_over_time,
    plot_predictions,
)
from sliplens.plots.layout import Chart, draw_picture
from sliplens.plots.saliency import Panel, build_panel
from sliplens.plots.style import (
    INPUT_COLOURS,
    PURPLE,
    conditions_in_order,
    decimals,
    in_order,
    input_name,
    inputs_in_order,
    method_name,
    methods_in_order,
    percent,
    source_name,
)
from sliplens.report.blocks import Notes
from sliplens.report.claims import Claim
from sliplens.report.tables import (
    Table,
    table_accuracy,
    table_deletion,
    table_real,
    table_timing,
    table_training,
)
from sliplens.report.workspace import Results
from sliplens.results.evaluation import Predictions
from sliplens.results.faithfulness import DeletionScores


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


def chart_faithfulness(results: Results, scores: dict[str, DeletionScores]) -> Chart:
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

        def plot(ax: Axes, scored: DeletionScores = scored, pixels: int = pixels, name: str = name) -> None:
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


_INPUTS = ("raw", "difference")
Block = Table | Chart | Panel | Claim | Notes
"""Laid out by the template's macro of the name `layout`."""


@dataclass(frozen=True, kw_only=True)
class Section:
    """A part of the page: what is missing of it, and what it shows in the order it is read."""

    id: str
    title: str
    short_title: str
    intro: str
    missing: tuple[str, ...] = ()
    blocks: tuple[Block, ...] = ()


def build_sections(results: Results, *, rng: np.random.Generator) -> tuple[Section, ...]:
    """Build all sections in the order they are read."""
    return (
        _accuracy_section(results),
        _faithfulness_section(results, rng=rng),
        _maps_section(results),
        _real_section(results),
        recipe_section(results),
    )


def _accuracy_section(results: Results) -> Section:
    charts = [chart_bins(results), chart_predictions(results), chart_over_time(results)] if results.evaluations else []
    return Section(
        id="accuracy",
        title="How well the safety margin is read",
        short_title="Accuracy",
        intro="The networks answer on trials they were not trained on. A raw image is the camera's frame; a difference "
        "image is that frame against the untouched sensor.",
        missing=_missing("evaluate", results.evaluations),
        blocks=(table_accuracy(results), *charts) if results.evaluations else (),
    )


def _faithfulness_section(results: Results, *, rng: np.random.Generator) -> Section:
    by_source = {
        source: {name: scored for (name, other), scored in results.scores.items() if other == source}
        for source in in_order({source for _, source in results.scores}, ("simulated", "real"))
    }
    return Section(
        id="faithfulness",
        title="How far the explanations can be believed",
        short_title="Faithfulness",
        intro="The pixels that a method calls important are removed first. If the answer moves at once, the network "
        "did rely on them: D = (1 \N{MINUS SIGN} |change of Γ|)² falls from 1 towards 0. Removing pixels in random "
        "order is the control that each method has to beat.",
        missing=_missing("score", {name for name, _ in results.scores}),
        blocks=(
            *(table_deletion(scores, rng=rng) for scores in by_source.values()),
            *(chart_faithfulness(results, scores) for scores in by_source.values()),
        ),
    )


def _maps_section(results: Results) -> Section:
    shown = {key: one for key, one in results.explanations.items() if key[1] != "real"}
    return Section(
        id="maps",
        title="Where the network looks",
        short_title="Saliency maps",
        intro="From full stick (Γ 100 %) on the left to the onset of full slip (Γ 0 %) on the right.",
        missing=_missing("explain", {name for name, _ in shown}),
        blocks=(
            *(build_panel(shown[key]) for key in sorted(shown, key=lambda key: (key[0] != "raw", key))),
            *((table_timing(results),) if results.explanations else ()),
        ),
    )


def _real_section(results: Results) -> Section:
    shown = {name: one for (name, source), one in results.explanations.items() if source == "real"}
    return Section(
        id="real",
        title="Real touch",
        short_title="Real touch",
        intro="Frames of a real sensor, shown to the same networks.",
        # real frames may exist as difference images only, so one input is enough
        missing=() if shown else ("Real frames: not run yet; `sliplens explain` makes it.",),
        blocks=(
            *((table_real(results),) if shown else ()),
            *(build_panel(shown[name]) for name in inputs_in_order(shown)),
        ),
    )


def recipe_section(results: Results) -> Section:
    """Say how the results were made; the template adds versions and recipes."""
    simulation = results.simulation
    if simulation is None:
        intro = "No simulation is recorded in this workspace."
    else:
        counts = "; ".join(
            f"{name} {count.trials} trials, {count.frames} frames" for name, count in simulation.by_split.items()
        )
        intro = f"Simulated: {simulation.trials} trials, {simulation.frames} frames ({counts})."
        intro += f" Objects: {', '.join(simulation.conditions)}."
    return Section(
        id="recipe",
        title="How these results were made",
        short_title="Recipe",
        intro=intro,
        missing=(
            *(() if simulation else ("Simulation: not run yet; `sliplens simulate` makes it.",)),
            *_missing("train", results.trainings),
        ),
        blocks=(table_training(results), chart_learning(results)) if results.trainings else (),
    )


def _missing(stage: str, found: Iterable[str]) -> tuple[str, ...]:
    there = set(found)
    return tuple(
        f"{input_name(name)}: not run yet; `sliplens {stage}` makes it." for name in _INPUTS if name not in there
    )
