"""Tables of the page: cells as text, so that the template only lays them out."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, TypeVar

import numpy as np

from sliplens.grip.records import Grip
from sliplens.intervals import Difference
from sliplens.plots.style import (
    UNKNOWN,
    conditions_in_order,
    decimals,
    fill_name,
    input_name,
    inputs_in_order,
    method_name,
    methods_in_order,
    percent,
    signed,
)
from sliplens.progress import number_of
from sliplens.report.comparisons import (
    ACCURACY,
    DELETION,
    MARK,
    NETWORK_PIXELS,
    SECONDS,
    settings,
    thesis_row,
    write_ends,
    write_gap,
    write_units,
)
from sliplens.report.results import Results
from sliplens.report.verdict import MethodRow, ThesisRecord
from sliplens.results.faithfulness import (
    CHANCE,
    DeletionScores,
    Faithfulness,
    MethodScore,
    RemovalScore,
    is_control,
)
from sliplens.results.study import MAP_MEASURES, REGIONS, MapQuality, Randomisation, Timing, Truth

Kind = Literal["name", "number", "best", "thesis", "outcome"]
Record = TypeVar("Record")
_LOOK_NAMES = ("Resolution", "Total variation")
_TRUTHS = ("oracle", "degraded-oracle")


@dataclass(frozen=True, kw_only=True)
class Cell:
    """Text of a cell, and what it is: a name, a number, the best number of its group, or a figure of the thesis."""

    text: str
    kind: Kind = "number"


@dataclass(frozen=True, kw_only=True)
class CellTable:
    """A table with its caption."""

    layout: ClassVar[str] = "table"

    caption: str
    head: tuple[Cell, ...]
    rows: tuple[tuple[Cell, ...], ...]
    wrap: bool = False
    """True where the cells hold sentences."""


def make_table(
    caption: str,
    columns: Mapping[str, Callable[[Record], str | Cell]],
    records: Iterable[Record],
    *,
    names: int = 1,
    wrap: bool = False,
) -> CellTable:
    """Make a table of records from its columns: a head, and what each record has there.

    The first columns hold names, the others numbers; those with "thesis" in their head are marked.
    """
    kinds: list[Kind] = [
        "name" if place < names else "thesis" if "thesis" in head.lower() else "number"
        for place, head in enumerate(columns)
    ]
    rows = [
        tuple(
            cell if isinstance(cell := write(record), Cell) else Cell(text=cell, kind=kind)
            for write, kind in zip(columns.values(), kinds, strict=True)
        )
        for record in records
    ]
    head = tuple(Cell(text=text, kind="thesis" if "thesis" in text.lower() else "name") for text in columns)
    return CellTable(caption=caption, head=head, rows=tuple(rows), wrap=wrap)


def _each_method(
    records: Mapping[str, MapQuality] | Mapping[str, Randomisation] | Mapping[str, Timing],
) -> Iterator[tuple[str, str, Any]]:
    """Input, method, and what a record of the input holds of the method, in the order they are read."""
    for name in inputs_in_order(records):
        methods = records[name].methods
        yield from ((name, method, methods[method]) for method in methods_in_order(methods))


def _best(text: str, best: bool) -> Cell:
    return Cell(text=text, kind="best" if best else "number")


def table_methods(rows: Sequence[MethodRow]) -> CellTable:
    """Tabulate every method beside the best control."""
    return make_table(
        "Every method beside the best control, a map that uses nothing the network learned. Truth: correlation of a "
        "map's sums over groups of markers with the change of this prediction as a group is moved to another margin of "
        "the trial; on recordings, the symmetric gain of removal in margin units. Ahead or behind: beyond the 95 % "
        "interval over days and trials of one network; tied: neither.",
        {
            "Input": lambda row: input_name(row.input),
            "Method": lambda row: method_name(row.method),
            "Status": lambda row: Cell(text=row.status, kind="outcome"),
            "Truth": lambda row: row.score,
            "Best control": lambda row: row.control,
            "Lead": lambda row: row.lead,
        },
        rows,
        names=2,
        wrap=True,
    )


def table_claims(record: ThesisRecord) -> CellTable:
    """Tabulate the claims of the thesis, each beside its number."""
    return make_table(
        f"Claims of the thesis, its numbers, and ours with 95 % intervals over days and trials. {record.sample}",
        {
            "Claim": lambda row: row.claim,
            "Where": lambda row: row.source,
            "Network": lambda row: row.subject,
            "Outcome": lambda row: Cell(text="open" if row.outcome == "undecided" else row.outcome, kind="outcome"),
            "Its number": lambda row: Cell(text=row.thesis, kind="thesis"),
            "Ours": lambda row: row.ours,
            "Why": lambda row: Cell(text=row.why, kind="name"),
        },
        record.claims,
        names=3,
        wrap=True,
    )


def table_accuracy(results: Results) -> CellTable:
    """Tabulate MSE, R2 and MAE by condition and input (thesis, Table 1)."""
    evaluations = {name: results.evaluations[name] for name in inputs_in_order(results.evaluations)}
    conditions = conditions_in_order(name for evaluation in evaluations.values() for name in evaluation.conditions)
    rows = [
        (condition, name, evaluation.conditions[condition], ACCURACY.get((name, condition), (None, None)))
        for condition in conditions
        for name, evaluation in evaluations.items()
        if condition in evaluation.conditions
    ]
    lowest = {condition: min(score.mse for key, _, score, _ in rows if key == condition) for condition in conditions}
    text = "".join(
        f" {input_name(name)}: the network was told the friction, {evaluation.friction}."
        for name, evaluation in evaluations.items()
        if evaluation.friction
    )
    return make_table(
        "Error of each network on test trials. MSE in squared margin units (Γ from 0 to 1), MAE in percentage points "
        f"of Γ; the lower MSE of each condition is bold. Grey columns: the {MARK}.{text}",
        {
            "Objects": lambda row: row[0].capitalize(),
            "Input": lambda row: input_name(row[1]),
            "MSE": lambda row: _best(decimals(row[2].mse, 4), len(evaluations) > 1 and row[2].mse == lowest[row[0]]),
            "MSE, thesis": lambda row: decimals(row[3][0], 4),
            "R²": lambda row: decimals(row[2].r2, 3),
            "R², thesis": lambda row: decimals(row[3][1], 2),
            "MAE (points)": lambda row: decimals(100 * row[2].mae, 1),
            "Frames / trials": lambda row: f"{row[2].frames} / {row[2].trials}",
        },
        rows,
        names=2,
    )


def table_scores(name: str, faithful: Faithfulness | None, scored: DeletionScores | None) -> CellTable:
    """Tabulate the thesis's deletion score (its Table 2) beside the symmetric gain under every fill."""
    scores = {} if faithful is None else {score.key: score for score in faithful.scores}
    plain = {} if scored is None else scored.methods
    methods, lowest = {*(method for _, _, method in scores), *plain}, _lowest(plain)
    fill = f", {scored.fill} fill" if scored else ""
    gains = {
        f"SRG, {fill_name(*setting)}": lambda method, setting=setting: _gain_cell(scores.get((*setting, method)))
        for setting in (settings(faithful) if faithful else ())
    }
    text = (
        " Symmetric relevance gain, SRG, in margin units (0 = uninformative), with 95 % intervals over "
        f"{write_units(score.srg for score in scores.values())}; * = excludes zero. Bold: ahead of every control "
        "beyond the interval of the difference; otherwise the method has shown nothing about this network under that "
        "fill."
    )
    return make_table(
        f"{input_name(name)}: deletion score D of the thesis{fill}, mean ± standard deviation over frames; lower = "
        f"more faithful, the lowest is bold.{text if scores else ''} Grey column: the {MARK}.",
        {
            "Method": method_name,
            "Score D": lambda method: _score_cell(plain.get(method), lowest),
            "Score D, thesis": lambda method: _thesis_score(name, method, methods),
            **gains,
        },
        methods_in_order(methods),
    )


def table_looks(looks: Mapping[str, MapQuality]) -> CellTable:
    """Tabulate what the eye judges of maps."""
    return make_table(
        f"Looks of the maps, means over {number_of(max(record.frames for record in looks.values()), 'frame')}. "
        "Resolution: depth of the valley between neighbouring markers (1 = told apart). Total variation: mean step "
        "between pixels over the map's range (noise has 1/3).",
        {
            "Input": lambda row: input_name(row[0]),
            "Method": lambda row: method_name(row[1]),
            **{
                title: lambda row, name=name: decimals(getattr(row[2], name), 3)
                for title, name in zip(_LOOK_NAMES, MAP_MEASURES, strict=True)
            },
        },
        _each_method(looks),
        names=2,
    )


def table_randomisation(randomisation: Mapping[str, Randomisation]) -> CellTable:
    """Tabulate what is left of a map once every layer has new weights."""
    return make_table(
        "Weights drawn anew, layer by layer from the output: similarity of the map to the trained network's (1 = "
        "unchanged: such a map does not depend on what was learned).",
        {
            "Input": lambda row: input_name(row[0]),
            "Method": lambda row: method_name(row[1]),
            "First layers new": lambda row: decimals(next(iter(row[2].similarity), None), 2),
            "All layers new": lambda row: decimals(next(reversed(row[2].similarity), None), 2),
        },
        _each_method(randomisation),
        names=2,
    )


def table_times(timing: Mapping[str, Timing]) -> CellTable:
    """Tabulate seconds a frame, with the forward pass and without it, beside those of the thesis."""
    methods = {method for record in timing.values() for method in record.methods}
    machines = "; ".join(
        f"{input_name(name).lower()}: {timing[name].device} with {number_of(timing[name].threads, 'thread')}, "
        f"{number_of(timing[name].frames, 'frame')}, a forward pass takes {_seconds(timing[name].forward_seconds)} s"
        for name in inputs_in_order(timing)
    )
    return make_table(
        f"Seconds to explain one frame: median over frames after a warm-up, and their range ({machines}). The thesis "
        f"timed images of {NETWORK_PIXELS} px on an RTX 3060 Ti without waiting for the GPU, and left Grad-CAM's "
        "forward pass out.",
        {
            "Input": lambda row: input_name(row[0]),
            "Method": lambda row: method_name(row[1]),
            "With forward pass": lambda row: _seconds(row[2].seconds),
            "Range": lambda row: f"{_seconds(row[2].low)} to {_seconds(row[2].high)}",
            "Without": lambda row: _seconds(row[2].seconds_without_forward),
            "Frames": lambda row: str(row[2].frames),
            "Thesis": lambda row: decimals(SECONDS.get(thesis_row(row[1], methods)), 3),
        },
        _each_method(timing),
        names=2,
    )


def table_localisation(truth: Truth) -> CellTable:
    """Tabulate where relevance lies, and how well maps rank the markers."""
    perfect = [name for name in _TRUTHS if name in truth.methods]
    areas = ", ".join(f"{region.replace('_', ' ')} {percent(truth.areas[region])}" for region in REGIONS)
    masses = {
        f"Mass, {region.replace('_', ' ')}": lambda name, region=region: percent(truth.methods[name].mass[region])
        for region in REGIONS
    }

    def write(gap: Difference | None) -> str:
        return write_gap(gap, digits=2)

    return make_table(
        f"{input_name(truth.input)}, {number_of(truth.frames, 'simulated frame')}: share of the relevance in three "
        f"regions (share of the image: {areas}). Neutral: correlation of the map's sums over random groups of "
        "markers with the change of the prediction as a group is moved to another margin of the trial. Lead: that "
        "less that of the strongest control; a method whose interval includes zero has shown nothing about this "
        "network on these days. Beside it the signed rank correlation of the map's means over the markers with their "
        "Shapley values, put back to the stick frame or to the untouched sensor, single effects, and effects on the "
        f"best estimate of the margin (95 % interval over {write_units(row.neutral for row in truth.methods.values())}"
        ").",
        {
            # here chance is a map, not an order
            "Method": lambda name: "Random map (control)" if name == CHANCE else method_name(name),
            "Neutral": lambda name: write(truth.methods[name].neutral),
            "Lead over controls": lambda name: write((lead := truth.methods[name].lead_over_controls) and lead.gap),
            "Shapley values, stick": lambda name: write(truth.methods[name].stick),
            "Shapley values, untouched": lambda name: write(truth.methods[name].shapley),
            "With markers put back alone": lambda name: write(truth.methods[name].network),
            "With the best estimate": lambda name: write(truth.methods[name].margin),
            **masses,
        },
        [*methods_in_order(set(truth.methods) - set(perfect)), *perfect],
    )


def table_episodes(grip: Grip) -> CellTable:
    """Tabulate the episodes of a grip."""
    setup = grip.setup
    return make_table(
        f"{number_of(len(grip.episodes), 'episode')}: {setup.object}, {setup.condition}, "
        f"controller {setup.controller}.",
        {
            "Episodes": lambda rows: f"{len(rows):,}",
            "Friction known": lambda rows: f"{int((rows.known_friction > 0).sum()):,}",
            "Dropped": lambda rows: percent(float(rows.dropped.mean()), digits=1),
            "Crushed": lambda rows: percent(float(rows.crushed.mean()), digits=1),
            "Slip, median": lambda rows: f"{1e3 * float(np.median(rows.slip_m)):.1f} mm",
            "Mean force": lambda rows: f"{float(rows.mean_force_n.mean()):.2f} N",
            "Over the least (quartiles)": lambda rows: " / ".join(
                percent(float(excess)) for excess in np.quantile(rows.force_excess, (0.25, 0.5, 0.75))
            ),
            "Under 20 %": lambda rows: f"{float(rows.under_20_s.mean()):.2f} s",
        },
        [grip.episodes],
    )


def _lowest(methods: Mapping[str, MethodScore]) -> float | None:
    return min((score.mean for name, score in methods.items() if not is_control(name)), default=None)


def _thesis_score(name: str, method: str, among: Collection[str]) -> str:
    mean, sd = DELETION.get((name, thesis_row(method, among)), (None, None))
    return UNKNOWN if mean is None else f"{mean:.3f} ± {sd:.3f}"


def _score_cell(score: MethodScore | None, best: float | None) -> Cell:
    return Cell(text=UNKNOWN) if score is None else _best(f"{score.mean:.3f} ± {score.sd:.3f}", score.mean == best)


def _gain_cell(score: RemovalScore | None) -> Cell:
    if score is None:
        return Cell(text=UNKNOWN)
    lead = score.lead_over_controls
    # in two lines, so that every fill fits beside the others
    text = f"{signed(score.srg.estimate, 3)}{'*' if score.srg.sure else ''}\n{write_ends(score.srg)}"
    return _best(text, lead is not None and lead.shows_something)


def _seconds(value: float | None) -> str:
    return decimals(value, 4 if value is not None and value < 0.1 else 2)
