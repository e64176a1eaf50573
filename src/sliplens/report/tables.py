"""Tables of the page: cells as text, so that the template only lays them out."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from sliplens.intervals import Difference
from sliplens.plots.style import (
    FILL_NAMES,
    UNKNOWN,
    conditions_in_order,
    decimals,
    fill_name,
    input_name,
    inputs_in_order,
    method_name,
    methods_in_order,
    percent,
    short_input_name,
    signed,
    source_name,
)
from sliplens.progress import number_of
from sliplens.report.comparisons import (
    ACCURACY,
    DELETION,
    MARK,
    NETWORK_PIXELS,
    SECONDS,
    against_control,
    settings,
    tell_bounds,
    tell_interval,
    tell_over,
    thesis_row,
)
from sliplens.report.results import Results
from sliplens.results.faithfulness import (
    CHANCE,
    DeletionScores,
    Faithfulness,
    Lead,
    MethodScore,
    RemovalScore,
    is_control,
)
from sliplens.results.study import MAP_MEASURES, REGIONS, Choice, MapQuality, Randomisation, Timing, Truth

Kind = Literal["name", "number", "best", "thesis"]
_LOOK_NAMES = {
    "resolution": "Resolution",
    "total_variation": "Total variation",
}
_REGION_NAMES = {"markers": "markers", "slip_annulus": "slip annulus", "edges": "marker edges"}
_CORRELATIONS = ("With Shapley values", "Lead over controls", "With markers put back alone", "With the best reading")
_GAINS = ("SRG of the truth", "SRG, damaged", "Truth less damaged", "SRG of |x - b|")
_TRUTHS = ("oracle", "degraded-oracle")


@dataclass(frozen=True, kw_only=True)
class Cell:
    """Text of a cell, and what it is: a name, a number, the best number of its group, or a figure of the thesis."""

    text: str
    kind: Kind = "number"


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table with its caption."""

    layout: ClassVar[str] = "table"

    caption: str
    head: tuple[Cell, ...]
    rows: tuple[tuple[Cell, ...], ...]


def make_table(caption: str, head: Sequence[str], rows: Iterable[Sequence[str | Cell]], *, names: int = 1) -> Table:
    """Make a table of texts: names in the first columns, then numbers, the thesis's own where the head says so."""
    heads = tuple(Cell(text=text, kind="thesis" if "thesis" in text.lower() else "name") for text in head)
    kinds: list[Kind] = [
        "name" if place < names else "thesis" if cell.kind == "thesis" else "number" for place, cell in enumerate(heads)
    ]
    cells = tuple(
        tuple(
            record if isinstance(record, Cell) else Cell(text=record, kind=kind)
            for record, kind in zip(row, kinds, strict=True)
        )
        for row in rows
    )
    return Table(caption=caption, head=heads, rows=cells)


def tell_spread(mean: float, sd: float) -> str:
    """Write a mean with its standard deviation."""
    return f"{mean:.3f} ± {sd:.3f}"


def _each_method(records: Mapping[str, Any]) -> list[tuple[str, str, Any]]:
    """Input, method, and what a record of the input holds of the method, in the order they are read."""
    result = {name: records[name].methods for name in inputs_in_order(records)}
    return [(name, method, methods[method]) for name, methods in result.items() for method in methods_in_order(methods)]


def _best(text: str, best: bool) -> Cell:
    return Cell(text=text, kind="best" if best else "number")


def table_accuracy(results: Results) -> Table:
    """Tabulate MSE, R2 and MAE by condition and input (thesis, Table 1)."""
    evaluations, rows = results.evaluations, []
    for condition in conditions_in_order(name for evaluation in evaluations.values() for name in evaluation.conditions):
        scores = {
            name: evaluations[name].conditions[condition]
            for name in inputs_in_order(evaluations)
            if condition in evaluations[name].conditions
        }
        lowest = min(score.mse for score in scores.values())
        for name, score in scores.items():
            thesis_mse, thesis_r2 = ACCURACY.get((name, condition), (None, None))
            mse = _best(decimals(score.mse, 4), score.mse == lowest and len(scores) > 1)
            r2, mae, counts = decimals(score.r2, 3), decimals(100 * score.mae, 1), f"{score.frames} / {score.trials}"
            thesis = decimals(thesis_mse, 4), decimals(thesis_r2, 2)
            rows.append((condition.capitalize(), input_name(name), mse, thesis[0], r2, thesis[1], mae, counts))
    text = "".join(
        f" {input_name(name)}: the network was told the friction, {evaluations[name].friction}."
        for name in inputs_in_order(evaluations)
        if evaluations[name].friction
    )
    return make_table(
        "How well each network reads the safety margin on test trials. MSE in squared margin units (Γ from 0 to 1), "
        f"MAE in percentage points of Γ; the lower MSE of each condition is bold. Grey columns: the {MARK}.{text}",
        ("Objects", "Input", "MSE", "MSE, thesis", "R²", "R², thesis", "MAE (points)", "Frames / trials"),
        rows,
        names=2,
    )


def table_deletion(scores: Mapping[str, DeletionScores], *, rng: np.random.Generator) -> Table:
    """Tabulate the deletion score by input and method, with the random control (thesis, Table 2)."""
    rows, gaps = [], []
    for name, method, score in _each_method(scores):
        scored = scores[name]
        lowest = min((method.mean for other, method in scored.methods.items() if other != CHANCE), default=None)
        gaps.append(against_control(scored, method, rng=rng))
        against = _interval(gaps[-1], digits=3)
        last, thesis = decimals(score.last_step_mean, 3), _thesis_score(name, method, scored.methods)
        cells = (_score_cell(score, lowest), against, last, thesis, str(score.frames))
        rows.append((input_name(name), method_name(method), *cells))
    sources = " and ".join(sorted({source_name(scored.source) for scored in scores.values()}))
    return make_table(
        f"Deletion score D on {sources}, averaged over all steps, mean ± standard deviation over frames; lower = more "
        "faithful, and the lowest of each input is bold. “Against random”: mean difference from the random control "
        f"with a 95 % interval over {tell_over(gaps)}; below zero = better than chance. “Last step”: D once every "
        f"pixel is filled, which no map has a part in. Grey column: the {MARK}.",
        ("Input", "Method", "Score D", "Against random", "Last step", "Score D, thesis", "Frames"),
        rows,
        names=2,
    )


def table_scores(faithful: Faithfulness, scored: DeletionScores | None) -> Table:
    """Tabulate the thesis's deletion score (its Table 2) beside the symmetric gain under every fill."""
    fills = settings(faithful)
    scores = {score.key: score for score in faithful.scores}
    gains = [(key[:2], score.srg.estimate) for key, score in scores.items() if not score.control]
    top = {fill: max((gain for setting, gain in gains if setting == fill), default=None) for fill in fills}
    plain = {} if scored is None else scored.methods
    methods = {*(score.method for score in faithful.scores), *plain}
    lowest = min((record.mean for name, record in plain.items() if not is_control(name)), default=None)
    fill = f", {scored.fill} fill" if scored else ""
    return make_table(
        f"{input_name(faithful.input)}: deletion score D of the thesis{fill} (mean ± standard deviation; lower = more "
        "faithful) and symmetric relevance gain, SRG, in margin units (0 = uninformative), with 95 % intervals over "
        f"{tell_over(score.srg for score in faithful.scores)}; * = excludes zero. Bold: best of its column, controls "
        f"left out. Grey column: the {MARK}.",
        ("Method", "Score D", "Score D, thesis", *(f"SRG, {fill_name(*setting)}" for setting in fills)),
        [
            (
                method_name(method),
                _score_cell(plain.get(method), lowest),
                _thesis_score(faithful.input, method, methods),
                *(_gain_cell(scores.get((*setting, method)), top[setting]) for setting in fills),
            )
            for method in methods_in_order(methods)
        ],
    )


def table_leads(faithful: Faithfulness) -> Table:
    """Tabulate the symmetric gain of each method less that of the strongest control, under every fill."""
    fills = settings(faithful)
    leads = {score.key: lead for score in faithful.scores if (lead := score.lead_over_controls) is not None}

    def tell(lead: Lead | None) -> Cell | str:
        if lead is None:
            return UNKNOWN
        control = method_name(lead.control).removesuffix(" (control)")
        return _best(f"{tell_interval(lead.gap)}, {control}", lead.shows_something)

    return make_table(
        f"{input_name(faithful.input)}: symmetric relevance gain of each method less that of the strongest control, "
        "named beside it, in margin units with 95 % intervals. Bold: ahead of every control. Otherwise the method has "
        "shown nothing about this network under that fill.",
        ("Method", *(fill_name(*setting) for setting in fills)),
        [
            (method_name(method), *(tell(leads.get((*setting, method))) for setting in fills))
            for method in methods_in_order({key[2] for key in leads})
        ],
    )


def table_looks(looks: Mapping[str, MapQuality]) -> Table:
    """Tabulate what the eye judges of maps."""
    return make_table(
        f"Looks of the maps, means over {number_of(max(record.frames for record in looks.values()), 'frame')}. "
        "Resolution: depth of the valley between neighbouring markers (1 = told apart). Total variation: mean step "
        "between pixels over the map's range (noise has 1/3).",
        ("Input", "Method", *(_LOOK_NAMES[measure] for measure in MAP_MEASURES)),
        [
            (
                input_name(name),
                method_name(method),
                *(decimals(getattr(measures, record), 3) for record in MAP_MEASURES),
            )
            for name, method, measures in _each_method(looks)
        ],
        names=2,
    )


def table_randomisation(randomisation: Mapping[str, Randomisation]) -> Table:
    """Tabulate what is left of a map once every layer has new weights."""
    counts = {
        method.layers[0] for records in randomisation.values() for method in records.methods.values() if method.layers
    }
    first = f"{counts.pop()} layers new" if len(counts) == 1 else "First layers new"
    return make_table(
        "Weights drawn anew, layer by layer from the output: similarity of the map to the trained network's (1 = "
        "unchanged: such a map does not depend on what was learned).",
        ("Input", "Method", first, "All layers new"),
        [
            (
                input_name(name),
                method_name(method),
                *(decimals(record.similarity[place] if record.similarity else None, 2) for place in (0, -1)),
            )
            for name, method, record in _each_method(randomisation)
        ],
        names=2,
    )


def table_times(timing: Mapping[str, Timing]) -> Table:
    """Tabulate seconds a frame, with the forward pass and without it, beside those of the thesis."""
    names = inputs_in_order(timing)
    rows, methods = [], {method for name in names for method in timing[name].methods}
    for method in methods_in_order(methods):
        cells = []
        for whole, record in ((timing[name].frames, timing[name].methods.get(method)) for name in names):
            part = f" on {number_of(record.frames, 'frame')}" if record is not None and record.frames < whole else ""
            spread = "" if record is None else f" ({_seconds(record.low)} to {_seconds(record.high)}{part})"
            cells.append(UNKNOWN if record is None else f"{_seconds(record.seconds)}{spread}")
            cells.append(_seconds(None if record is None else record.seconds_without_forward))
        rows.append((method_name(method), *cells, _thesis_seconds(method, methods)))
    text = "; ".join(
        f"{input_name(name).lower()}: {record.device}"
        f"{f' with {record.threads} threads' if record.threads and record.device == 'cpu' else ''}, "
        f"{number_of(record.frames, 'frame')}, a forward pass takes {_seconds(record.forward_seconds)} s"
        for name in names
        for record in [timing[name]]
    )
    heads = [f"{short_input_name(name)}, {what}" for name in names for what in ("with forward pass", "without")]
    return make_table(
        f"Seconds to explain one frame: median over the sample's frames after a warm-up, their range, and on how many "
        f"of them a slow method was timed ({text}). The thesis "
        f"timed images of {NETWORK_PIXELS} px on an RTX 3060 Ti without waiting for the GPU, and left Grad-CAM's "
        "forward pass out.",
        ("Method", *heads, "Thesis"),
        rows,
    )


def table_trials(choice: Choice) -> Table:
    """Tabulate the trials of the study, and how far each network was off at worst."""
    names = inputs_in_order({*choice.inputs, *(name for trial in choice.trials for name in trial.worst_error)})
    return make_table(
        f"The {number_of(len(choice.trials), 'trial')} of the study ({choice.condition}): the worst error of "
        f"each network at the chosen margins, in percentage points; within {percent(choice.tolerance)} at all of "
        "them it qualifies.",
        ("Trial", "Qualified", *(f"Worst error, {short_input_name(name).lower()}" for name in names), "Frames scored"),
        [
            (
                trial.trial,
                "yes" if trial.qualified else "no",
                *(percent(trial.worst_error.get(name), digits=1) for name in names),
                str(sum(frame.trial == trial.trial and frame.scored for frame in choice.frames)),
            )
            for trial in choice.trials
        ],
        names=2,
    )


def table_localisation(truth: Truth) -> Table:
    """Tabulate where relevance lies, and how well maps rank the markers."""
    names = [
        *methods_in_order(set(truth.methods) - set(_TRUTHS)),
        *(record for record in _TRUTHS if record in truth.methods),
    ]
    heads = [f"Mass, {_REGION_NAMES[region]}" for region in REGIONS]
    rows = []
    for name in names:
        records, lead = truth.methods[name], truth.methods[name].lead_over_controls
        gaps = (records.shapley, lead and lead.gap, records.network, records.margin)
        shares = [percent(records.mass[region]) for region in REGIONS]
        title = "Random map (control)" if name == CHANCE else method_name(name)  # here it is a map, not an order
        rows.append((title, *shares, *map(_interval, gaps)))
    nothing = ("A map that knows nothing", *(percent(truth.areas[region]) for region in REGIONS), *4 * ["0"])
    return make_table(
        f"{input_name(truth.input)}, {number_of(truth.frames, 'simulated frame')}: share of the relevance in "
        "three regions; signed rank correlation of the map's means over the markers with their "
        "Shapley values, single effects, and effects on the best estimate of the margin (95 % interval over "
        f"{tell_over(method.shapley for method in truth.methods.values())}). Lead: the first less that of the "
        "strongest control; a method whose interval includes zero has shown nothing about this network.",
        ("Method", *heads, *_CORRELATIONS),
        [*rows, nothing],
    )


def table_meta(truth: Truth) -> Table | None:
    """Tabulate whether the score itself ranks a perfect map above a damaged one above chance; None if not tested."""
    if not truth.meta:
        return None
    return make_table(
        f"{input_name(truth.input)}: test of the score. The map of the Shapley values must gain more than the same "
        "map with half of the markers shuffled, beyond the 95 % interval; a fill where it does not has no vote. Where "
        "|x - b| comes near the truth, the setting mostly measures the input.",
        ("Fill", "Holds", *_GAINS),
        [
            (
                FILL_NAMES.get(test.fill, test.fill),
                "yes" if test.holds else "no",
                *(decimals(value, 3) for value in (test.oracle, test.degraded)),
                _interval(test.gap, digits=3),
                decimals(test.changed, 3),
            )
            for test in truth.meta
        ],
        names=2,
    )


def _interval(gap: Difference | None, value: float | None = None, *, digits: int = 2) -> str:
    """Write an interval; the value alone where none is known."""
    return decimals(value, digits) if gap is None else tell_interval(gap, digits=digits)


def _thesis_score(name: str, method: str, among: Collection[str]) -> str:
    thesis = DELETION.get((name, thesis_row(method, among) or ""))
    return tell_spread(*thesis) if thesis else UNKNOWN


def _thesis_seconds(method: str, among: Collection[str]) -> str:
    return decimals(SECONDS.get(thesis_row(method, among) or ""), 3)


def _score_cell(score: MethodScore | None, best: float | None) -> Cell:
    return Cell(text=UNKNOWN) if score is None else _best(tell_spread(score.mean, score.sd), score.mean == best)


def _gain_cell(score: RemovalScore | None, best: float | None) -> Cell:
    if score is None:
        return Cell(text=UNKNOWN)
    # in two lines, so that every fill fits beside the others
    text = f"{signed(score.srg.estimate, 3)}{'*' if score.srg.sure else ''}\n{tell_bounds(score.srg)}"
    return _best(text, not score.control and score.srg.estimate == best)


def _seconds(value: float | None) -> str:
    return decimals(value, 4 if value is not None and value < 0.1 else 2)
