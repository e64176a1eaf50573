"""First page, sections, tables and alarms of the page; cells of tables are text."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from sliplens.plots import style
from sliplens.report import plates, verdict
from sliplens.results.explanation import BASELINES
from sliplens.results.faithfulness import DeletionScores, Faithfulness, RemovalScore, is_control
from sliplens.results.study import TESTS, Study

Kind = Literal["name", "number", "best", "thesis", "outcome"]


@dataclass(frozen=True, kw_only=True)
class Cell:
    """Text of a cell, and what it is: a name, a number, the best number of its group, or a figure of the thesis."""

    text: str
    kind: Kind = "number"


@dataclass(frozen=True, kw_only=True)
class CellTable:
    """A table with its caption."""

    caption: str
    head: tuple[Cell, ...]
    rows: tuple[tuple[Cell, ...], ...]
    wrap: bool = False
    """True where the cells hold sentences."""


def make_table(
    caption: str, heads: Sequence[str], rows: Sequence[Sequence[str | Cell]], *, names: int = 1, wrap: bool = False
) -> CellTable:
    """Make a table without its empty columns; the first hold names, the others numbers, some of the thesis."""
    kinds: list[Kind] = [
        "name" if place < names else "thesis" if "thesis" in head.lower() else "number"
        for place, head in enumerate(heads)
    ]
    cells = [
        [cell if isinstance(cell, Cell) else Cell(text=cell, kind=kind) for cell, kind in zip(row, kinds, strict=True)]
        for row in rows
    ]
    filled = [place for place in range(len(heads)) if any(row[place].text for row in cells)]
    head = tuple(Cell(text=heads[place], kind="thesis" if kinds[place] == "thesis" else "name") for place in filled)
    texts = tuple(tuple(row[place] for place in filled) for row in cells)
    return CellTable(caption=caption, head=head, rows=texts, wrap=wrap)


def _best(text: str, best: bool) -> Cell:
    return Cell(text=text, kind="best" if best else "number")


def _outcome(outcome: str) -> Cell:
    return Cell(text="open" if outcome == "undecided" else outcome, kind="outcome")


def _two_lines(text: str) -> str:
    """Set an interval below its estimate, so that every column fits."""
    return text.replace(" (", "\n").rstrip(")")


def table_methods(rows: Sequence[verdict.MethodRow]) -> CellTable:
    """Tabulate every method beside the best control."""
    beside = (
        " Beside it the rank correlation of the map's means over markers with their Shapley values, put back to the "
        "stick frame or to the untouched sensor, to which Integrated Gradients is close by construction."
    )
    return make_table(
        "Every method beside the best control, a map that uses nothing the network learned. Truth: correlation of a "
        "map's sums over groups of markers with the change of this prediction as a group is moved to another margin of "
        "the trial; on recordings, the symmetric gain of removal in margin units. Ahead or behind: beyond the 95 % "
        "interval over days and trials of one network; tied: neither."
        f"{beside if any(row.shapley for row in rows) else ''}",
        ("Method", "Input", "Status", "Truth", "Best control", "Lead", "Shapley, stick", "Shapley, untouched"),
        [
            (
                style.method_name(row.method),
                style.short_input_name(row.input),
                _outcome(row.status),
                _two_lines(row.score),
                row.control.replace(", ", "\n"),
                *map(_two_lines, (row.lead, row.stick, row.shapley)),
            )
            for row in rows
        ],
        names=2,
        wrap=True,
    )


def table_claims(caption: str, rows: Sequence[verdict.ClaimRow]) -> CellTable:
    """Tabulate claims, each beside its number; those of the thesis with their place and number there."""
    cells = []
    for row in rows:
        why = Cell(text=row.why, kind="name")
        cells.append((row.claim, row.source, row.subject, _outcome(row.outcome), row.thesis, row.ours, why))
    heads = ("Claim", "Where", "Network", "Outcome", "Thesis", "Ours", "Why")
    return make_table(caption, heads, cells, names=3, wrap=True)


def table_accuracy(results: Study) -> CellTable:
    """Tabulate MSE, R2 and MAE by condition and input (thesis, Table 1)."""
    evaluations, rows = results.evaluations, []
    for condition, scores in verdict.scores_by_condition(results).items():
        lowest = min(score.mse for score in scores.values())
        for name, score in scores.items():
            mse, r2 = verdict.ACCURACY.get((name, condition), (None, None))
            rows.append(
                (
                    condition.capitalize(),
                    style.input_name(name),
                    _best(style.decimals(score.mse, 4), len(evaluations) > 1 and score.mse == lowest),
                    style.decimals(mse, 4),
                    style.decimals(score.r2, 3),
                    style.decimals(r2, 2),
                    style.decimals(100 * score.mae, 1),
                    _outcome(verdict.judge_accuracy(score)),
                    f"{score.frames} / {score.trials}",
                )
            )
    text = "".join(
        f" {style.input_name(name)}: the network was given the friction, {evaluations[name].friction}."
        for name in style.inputs_in_order(evaluations)
        if evaluations[name].friction
    )
    return make_table(
        "Error of each network on test trials. MSE in squared margin units (Γ from 0 to 1), MAE in percentage points "
        "of Γ; the lower MSE of each condition is bold. Holds: better than always predicting the mean label, over five "
        f"trials or more. Each input stands for one trained network. Grey columns: the {verdict.MARK}.{text}",
        ("Objects", "Input", "MSE", "MSE, thesis", "R²", "R², thesis", "MAE (points)", "Outcome", "Frames / trials"),
        rows,
        names=2,
    )


def table_scores(name: str, faithful: Faithfulness | None, scored: DeletionScores | None) -> CellTable:
    """Tabulate the thesis's deletion score (its Table 2) beside the symmetric gain under every fill."""
    scores = {} if faithful is None else {score.key: score for score in faithful.scores}
    plain, every = {} if scored is None else scored.methods, verdict.settings(faithful) if faithful else []
    methods = {*(method for _, _, method in scores), *plain}
    lowest = min((score.mean for method, score in plain.items() if not is_control(method)), default=None)
    rows = []
    for method in style.methods_in_order(methods):
        score, published = plain.get(method), verdict.DELETION.get((name, verdict.thesis_row(method, methods)))
        rows.append(
            (
                style.method_name(method),
                _best(f"{score.mean:.3f} ± {score.sd:.3f}", score.mean == lowest) if score else style.UNKNOWN,
                "{:.3f} ± {:.3f}".format(*published) if published else style.UNKNOWN,
                *(_gain_cell(scores.get((*setting, method))) for setting in every),
            )
        )
    over = next((f" over {score.srg.over}" for score in scores.values()), "")
    text = (
        f" Symmetric relevance gain, SRG, in margin units (0 = uninformative), with 95 % intervals{over}; * = "
        "excludes zero. Bold: ahead of every control beyond the interval of the difference; otherwise the method has "
        "shown nothing about this network under that fill."
    )
    return make_table(
        f"{style.input_name(name)}: deletion score D of the thesis{f', {scored.fill} fill' if scored else ''}, mean ± "
        "standard deviation over frames; lower = more faithful, the lowest is bold."
        f"{text if scores else ''} Grey column: the {verdict.MARK}.",
        ("Method", "Score D", "Score D, thesis", *(f"SRG, {style.fill_name(*setting)}" for setting in every)),
        rows,
    )


def _gain_cell(score: RemovalScore | None) -> Cell:
    if score is None:
        return Cell(text=style.UNKNOWN)
    lead = score.lead_over_controls
    text = _two_lines(verdict.write_gap(score.srg)).replace("\n", "*\n" if score.srg.sure else "\n")
    return _best(text, lead is not None and lead.gap.above_zero)


def table_properties(results: Study) -> CellTable:
    """Tabulate what the maps of each method look like, and what they cost."""
    rows = []
    for name in style.inputs_in_order(results.map_quality):
        looks = results.map_quality[name].methods
        costs = results.explanations[name].methods if name in results.explanations else {}
        rows += [
            (
                style.input_name(name),
                style.method_name(method),
                style.decimals(looks[method].resolution, 3),
                style.decimals(looks[method].total_variation, 3),
                style.decimals(looks[method].infidelity, 3),
                style.decimals(looks[method].max_sensitivity, 2),
                style.decimals(costs[method].seconds_per_frame if method in costs else None, 3),
                style.decimals(verdict.SECONDS.get(verdict.thesis_row(method, looks)), 3),
            )
            for method in style.methods_in_order(looks)
        ]
    measures = "Resolution", "Total variation", "Infidelity", "Max-sensitivity"
    return make_table(
        "Resolution: depth of the valley between neighbouring markers (1 = distinguished). Variation: mean step "
        "between pixels over the map's range (noise has 1/3). Infidelity: error of the change that a map predicts if "
        "half of the pixels become the baseline's, in units of the output; max-sensitivity: largest change of a map "
        "under noise of 2 %, as a share of the map (two frames each). Seconds a frame beside other work; the thesis "
        "timed 224 px on an RTX 3060 Ti.",
        ("Input", "Method", *measures, "Seconds", "In the thesis"),
        rows,
        names=2,
    )


OF_PACKAGE = "These are results on the simulated networks of the thesis that come with sliplens, not on this workspace."

Block = CellTable | plates.Plate | str
"""Table, figure or paragraph of the page."""


@dataclass(frozen=True, kw_only=True)
class Opening:
    """First page: the answer, what shows it, and what to do next."""

    answer: str
    blocks: tuple[Block, ...]
    next_step: str


def build_opening(results: Study, rows: Sequence[verdict.MethodRow]) -> Opening:
    """Build the first page from the study of a workspace, or from that of the package where it holds none."""
    strip = results.strip
    answer, reasons = "Not known: no explanation was scored yet.", []
    if rows:
        reasons = [verdict.why_no_verdict(results, name) for name in dict.fromkeys(row.input for row in rows)]
        answer = verdict.answer_trust(rows, reasons)
    elif strip is not None and not results.begun:
        rows = verdict.load_thesis().methods
        answer = f"{verdict.answer_trust(rows)} {OF_PACKAGE}"
    blocks: list[Block] = []
    if strip is not None:
        blocks.append(plates.plate_strip(strip))
        blocks += [plates.plate_moved(strip, strip.moved)] if strip.moved else []
        blocks += [plates.plate_shift(verdict.load_thesis())] if strip.source == "simulated" else []
    blocks += [table_methods(rows)] if rows else []
    best = next((row.method for row in rows if row.status == "ahead"), None)
    if not results.begun:
        step = "judge the maps of your own network on your recordings: `sliplens study DATA --network RUN --quick`."
    elif best:
        step = f"look at your own frames with the method that is ahead: `sliplens explain RUN DATA --method {best}`."
    else:
        step = "train on more trials until five of them are predicted within 5 points, and run the study again."
    return Opening(answer=answer, blocks=tuple(blocks), next_step=step)


@dataclass(frozen=True, kw_only=True)
class Section:
    """A part of the page; it is left out without any block."""

    id: str
    title: str
    intro: str
    blocks: Sequence[Block]
    step: str = ""
    """Step of a study that makes its results, named on the page where it was not run; empty where no study has it."""


def build_sections(results: Study) -> tuple[Section, ...]:
    """Build the sections in the order they are read; those whose results are not there have no block."""
    explained = (results.explanations | results.real).values()
    baseline = next((BASELINES[each.baseline] for each in explained), BASELINES["untouched"])
    claims = "Claims of the thesis, its numbers, and ours with 95 % intervals over days and trials."
    thesis = verdict.load_thesis() if results.begun or results.strip is not None else None
    scored = _names({*results.faithfulness, *results.deletion})
    return (
        Section(
            id="real",
            title="Real touch",
            intro="Frames of a real sensor, shown to each network.",
            blocks=[plates.plate_states(results, results.real[name]) for name in _names(results.real)],
        ),
        Section(
            id="accuracy",
            title="Accuracy",
            intro="Each network predicts trials that it was not trained on (Table 1 and Fig. 7 of the thesis, for this "
            "data). A raw image is the camera's frame; a difference image is that frame against the untouched sensor; "
            "in an image pair both stand side by side.",
            blocks=[plates.plate_bins(results)] if results.evaluations else [],
            step="evaluate",
        ),
        Section(
            id="faithfulness",
            title="Faithfulness",
            intro="Parts of a frame are removed: the most supporting first, the least supporting first, and at random. "
            f"With a faithful map the prediction returns to that of {baseline} at once in the first case, and not "
            "in the second. Controls are maps that use nothing the network learned. The thesis's score beside it: D = "
            "(1 \N{MINUS SIGN} |change of Γ|)² while pixels go, the most salient first, 1 where nothing changed; with "
            "every pixel gone no map has a part in it.",
            blocks=[
                *(table_scores(name, results.faithfulness.get(name), results.deletion.get(name)) for name in scored),
                *([plates.plate_deletion(results.deletion)] if results.deletion else []),
            ],
            step="faithfulness",
        ),
        Section(
            id="maps",
            title="Saliency maps",
            intro="From full stick (Γ 100 %) to the onset of full slip (Γ 0 %): why each network predicts its margin "
            f"rather than that of {baseline}. The thesis judged the maps by eye; a study measures the same.",
            blocks=[
                *(plates.plate_states(results, results.explanations[name]) for name in _names(results.explanations)),
                *([table_properties(results)] if results.map_quality else []),
            ],
            step="explain",
        ),
        Section(
            id="choice",
            title="Trials",
            intro="The trials and frames that are explained and scored.",
            blocks=[
                *([results.choice.summary] if results.choice else []),
                *(f"{text[:1].upper()}{text[1:]}." for text in results.left_out.values()),
                *(f"Truth, {name} images: {results.truth[name].summary}." for name in _names(results.truth)),
            ],
            step="choice",
        ),
        Section(
            id="claims",
            title="Claims",
            intro="From a study of the two networks that come with sliplens, one an input, on simulated trials of "
            "their sensor: not of this workspace. A claim holds or not beyond the interval; otherwise it is open.",
            blocks=[table_claims(f"{claims} {thesis.sample}", thesis.claims)] if thesis else [],
        ),
    )


def missing_sections(results: Study, sections: Sequence[Section]) -> list[str]:
    """Titles of the sections of a study that was asked for them and has not made them."""
    left_out = set(TESTS) - set(results.config.tests) if results.config else set()
    wanted = [each for each in sections if each.step and each.step not in left_out] if results.begun else []
    return [each.title for each in wanted if not each.blocks]


def _names(names: Iterable[str]) -> list[str]:
    """Difference before raw, as in the thesis's figures, and before both what it had not."""
    return style.inputs_in_order(names)[::-1]


def list_alarms(results: Study) -> list[str]:
    """Sentences on what puts results in doubt, each once, in the order of the networks."""
    alarms = [*results.notes, *(results.states.untracked if results.states else ())]
    if len({tuple(sorted(run.versions.items())) for run in results.runs.values()}) > 1:
        alarms.append("The stages were run with different versions of the libraries; see each run.json.")
    tested, explained = (results.faithfulness, results.deletion), results.explanations
    for name in _names({*results.truth, *(name for table in (*tested, explained, results.real) for name in table)}):
        texts = [text for table in tested if name in table for text in table[name].alarms]
        for maps in (table[name] for table in (explained, results.real) if name in table):
            texts += [f"{method}: {text}" for method, notes in maps.methods.items() for text in notes.warnings]
        truth = results.truth.get(name)
        if unfit := [style.fill_name(test.fill) for test in (truth.meta if truth else ()) if not test.holds]:
            why = "a map of the Shapley values does not gain more than the same map with half of the markers shuffled"
            texts.append(f"under {style.listed(unfit)} {why}, so that this fill has no vote")
        alarms += [f"{style.input_name(name)}: {text.rstrip('.')}." for text in texts]
    return list(dict.fromkeys(alarms))
