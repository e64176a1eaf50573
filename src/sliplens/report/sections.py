"""Sections of the page: what each holds, and what is still missing of it."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from sliplens.report.blocks import Notes
from sliplens.report.charts import (
    chart_bins,
    chart_faithfulness,
    chart_learning,
    chart_over_time,
    chart_predictions,
)
from sliplens.report.drawing import Chart
from sliplens.report.panels import Panel, build_panel
from sliplens.report.study.claim import Claim
from sliplens.report.style import in_order, input_name, inputs_in_order
from sliplens.report.tables import (
    Table,
    table_accuracy,
    table_deletion,
    table_real,
    table_timing,
    table_training,
)
from sliplens.report.workspace import Results

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
        total = f"{simulation.trials or 'an unknown number of'} trials, {simulation.frames or 'unknown'} frames"
        conditions = f" Objects: {', '.join(simulation.conditions)}." if simulation.conditions else ""
        intro = f"Simulated: {total}{f' ({counts})' if counts else ''}.{conditions}"
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
