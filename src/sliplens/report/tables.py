"""Tables of the page: cells as text, so that the template only lays them out."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Literal, TypeVar

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
    signed,
)
from sliplens.progress import number_of
from sliplens.report.results import Results
from sliplens.report.verdict import (
    ACCURACY,
    DELETION,
    MARK,
    SECONDS,
    ClaimRow,
    MethodRow,
    Outcome,
    judge_accuracy,
    settings,
    thesis_row,
    write_ends,
    write_gap,
)
from sliplens.results.faithfulness import CHANCE, DeletionScores, Faithfulness, RemovalScore, is_control
from sliplens.results.study import Truth

Kind = Literal["name", "number", "best", "thesis", "outcome"]
Record = TypeVar("Record")
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


def _best(text: str, best: bool) -> Cell:
    return Cell(text=text, kind="best" if best else "number")


def _outcome(outcome: Outcome) -> Cell:
    return Cell(text="open" if outcome == "undecided" else outcome, kind="outcome")


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


def table_claims(caption: str, rows: Sequence[ClaimRow]) -> CellTable:
    """Tabulate claims, each beside its number; those of the thesis with their place and number there."""
    of_thesis = any(row.source for row in rows)
    places = {"Where": lambda row: row.source} if of_thesis else {}
    numbers = {"Its number": lambda row: Cell(text=row.thesis, kind="thesis")} if of_thesis else {}
    return make_table(
        caption,
        {
            "Claim": lambda row: row.claim,
            **places,
            "Network": lambda row: row.subject,
            "Outcome": lambda row: _outcome(row.outcome),
            **numbers,
            "Ours" if of_thesis else "Number": lambda row: row.ours,
            "Why": lambda row: Cell(text=row.why, kind="name"),
        },
        rows,
        names=2 + of_thesis,
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
        "of Γ; the lower MSE of each condition is bold. Holds: better than always predicting the mean label, over five "
        f"trials or more. Each input stands for one trained network. Grey columns: the {MARK}.{text}",
        {
            "Objects": lambda row: row[0].capitalize(),
            "Input": lambda row: input_name(row[1]),
            "MSE": lambda row: _best(decimals(row[2].mse, 4), len(evaluations) > 1 and row[2].mse == lowest[row[0]]),
            "MSE, thesis": lambda row: decimals(row[3][0], 4),
            "R²": lambda row: decimals(row[2].r2, 3),
            "R², thesis": lambda row: decimals(row[3][1], 2),
            "MAE (points)": lambda row: decimals(100 * row[2].mae, 1),
            "Outcome": lambda row: _outcome(judge_accuracy(row[2])),
            "Frames / trials": lambda row: f"{row[2].frames} / {row[2].trials}",
        },
        rows,
        names=2,
    )


def table_scores(name: str, faithful: Faithfulness | None, scored: DeletionScores | None) -> CellTable:
    """Tabulate the thesis's deletion score (its Table 2) beside the symmetric gain under every fill."""
    scores = {} if faithful is None else {score.key: score for score in faithful.scores}
    plain = {} if scored is None else scored.methods
    methods = {*(method for _, _, method in scores), *plain}
    lowest = min((score.mean for method, score in plain.items() if not is_control(method)), default=None)
    over = next((f" over {score.srg.over}" for score in scores.values()), "")

    def deletion(method: str) -> Cell:
        score = plain.get(method)
        return _best(f"{score.mean:.3f} ± {score.sd:.3f}", score.mean == lowest) if score else Cell(text=UNKNOWN)

    def thesis(method: str) -> str:
        published = DELETION.get((name, thesis_row(method, methods)))
        return "{:.3f} ± {:.3f}".format(*published) if published else UNKNOWN

    gains = {
        f"SRG, {fill_name(*setting)}": lambda method, setting=setting: _gain_cell(scores.get((*setting, method)))
        for setting in (settings(faithful) if faithful else ())
    }
    text = (
        f" Symmetric relevance gain, SRG, in margin units (0 = uninformative), with 95 % intervals{over}; * = "
        "excludes zero. Bold: ahead of every control beyond the interval of the difference; otherwise the method has "
        "shown nothing about this network under that fill."
    )
    return make_table(
        f"{input_name(name)}: deletion score D of the thesis{f', {scored.fill} fill' if scored else ''}, mean ± "
        "standard deviation over frames; lower = more faithful, the lowest is bold."
        f"{text if scores else ''} Grey column: the {MARK}.",
        {"Method": method_name, "Score D": deletion, "Score D, thesis": thesis, **gains},
        methods_in_order(methods),
    )


def _gain_cell(score: RemovalScore | None) -> Cell:
    if score is None:
        return Cell(text=UNKNOWN)
    lead = score.lead_over_controls
    # in two lines, so that every fill fits beside the others
    text = f"{signed(score.srg.estimate, 3)}{'*' if score.srg.sure else ''}\n{write_ends(score.srg)}"
    return _best(text, lead is not None and lead.shows_something)


def table_properties(results: Results) -> CellTable:
    """Tabulate what the maps of each method look like, whether they depend on the weights, and what they cost."""
    parts = {
        "Resolution: depth of the valley between neighbouring markers (1 = told apart). Total variation: mean step "
        "between pixels over the map's range (noise has 1/3). Of two frames, infidelity: error of the change that a "
        "map predicts where half of the pixels become the baseline's, in units of the output; max-sensitivity: largest "
        "change of a map under noise of 2 %, as a share of the map.": results.map_quality,
        "New weights: similarity of the map to the trained network's once the first layers from the output, or all, "
        "are drawn anew (1 = unchanged: such a map does not depend on what was learned).": results.randomisation,
        "Seconds: median for one frame after a warm-up; the thesis timed 224 px on an RTX 3060 Ti.": results.timing,
    }
    columns = {
        "Resolution": (results.map_quality, lambda of: decimals(of.resolution, 3)),
        "Total variation": (results.map_quality, lambda of: decimals(of.total_variation, 3)),
        "Infidelity": (results.map_quality, lambda of: decimals(of.infidelity, 3)),
        "Max-sensitivity": (results.map_quality, lambda of: decimals(of.max_sensitivity, 2)),
        "First layers new": (results.randomisation, lambda of: decimals(next(iter(of.similarity), None), 2)),
        "All layers new": (results.randomisation, lambda of: decimals(next(reversed(of.similarity), None), 2)),
        "Seconds": (results.timing, lambda of: decimals(of.seconds, 3)),
    }
    tables = [table for table in parts.values() if table]
    rows = [
        (name, method)
        for name in inputs_in_order(name for table in tables for name in table)
        for method in methods_in_order(method for table in tables if name in table for method in table[name].methods)
    ]

    def write(row: tuple[str, str], table: Mapping, cell: Callable) -> str:
        record = table[row[0]].methods.get(row[1]) if row[0] in table else None
        return UNKNOWN if record is None else cell(record)

    def thesis(row: tuple[str, str]) -> str:
        return decimals(SECONDS.get(thesis_row(row[1], [method for _, method in rows])), 3)

    return make_table(
        " ".join(text for text, table in parts.items() if table),
        {
            "Input": lambda row: input_name(row[0]),
            "Method": lambda row: method_name(row[1]),
            **{head: partial(write, table=table, cell=cell) for head, (table, cell) in columns.items() if table},
            **({"Seconds, thesis": thesis} if results.timing else {}),
        },
        rows,
        names=2,
    )


def table_localisation(truth: Truth) -> CellTable:
    """Tabulate how well maps rank the markers, by each truth."""
    perfect = [name for name in _TRUTHS if name in truth.methods]
    over = next((f" over {row.neutral.over}" for row in truth.methods.values() if row.neutral), "")
    truths = {
        "Neutral": "neutral",
        "Shapley values, stick": "stick",
        "Shapley values, untouched": "shapley",
        "With markers put back alone": "network",
        "With the best estimate": "margin",
    }

    def write(name: str, key: str) -> str:
        gap: Difference | None = getattr(truth.methods[name], key)
        return write_gap(gap, digits=2)

    return make_table(
        f"{input_name(truth.input)}, {number_of(truth.frames, 'simulated frame')}. Neutral: as Truth in the first "
        "table. Beside it the signed rank correlation of the map's means over the markers with their Shapley values, "
        "put back to the stick frame or to the untouched sensor, single effects, and effects on the best estimate of "
        f"the margin (95 % interval{over}).",
        {
            # here chance is a map, not an order
            "Method": lambda name: "Random map (control)" if name == CHANCE else method_name(name),
            **{head: lambda name, key=key: write(name, key) for head, key in truths.items()},
        },
        [*methods_in_order(set(truth.methods) - set(perfect)), *perfect],
    )
