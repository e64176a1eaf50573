"""Sections of the page: a table, of which those are drawn whose results are there."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

from sliplens.plots.style import fill_name, input_name, inputs_in_order, listed, method_name, name_methods
from sliplens.progress import number_of
from sliplens.report import charts, plates, tables
from sliplens.report.results import Results
from sliplens.report.verdict import MethodRow, answer_trust, load_thesis, why_no_verdict
from sliplens.results.explanation import BASELINES, Explanation
from sliplens.results.study import TESTS

OF_PACKAGE = "These are results on the simulated networks of the thesis that come with sliplens, not on this workspace."


@dataclass(frozen=True, kw_only=True)
class Notes:
    """Sentences under a head of their own: alarms, or what was done."""

    layout: ClassVar[str] = "notes"

    title: str
    sentences: tuple[str, ...]
    tone: Literal["plain", "caution"] = "plain"


Block = tables.CellTable | plates.Plate | Notes
"""Laid out by the template's macro of the name `layout`."""
Blocks = Iterator[Block | None]
"""None stands for a block that is not there."""


@dataclass(frozen=True, kw_only=True)
class Opening:
    """First page: the answer, what shows it, and what to do next."""

    answer: str
    blocks: tuple[Block, ...]
    next_step: str


def build_opening(results: Results, rows: Sequence[MethodRow]) -> Opening:
    """Build the first page from the study of a workspace, or from that of the package where it holds none."""
    strip = results.strip
    answer, reasons = "Not known: no explanation was scored yet.", []
    if rows:
        reasons = [why_no_verdict(results, name) for name in dict.fromkeys(row.input for row in rows)]
        answer = answer_trust(rows, reasons)
    elif strip is not None and not results.begun:
        rows = load_thesis().methods
        answer = f"{answer_trust(rows)} {OF_PACKAGE}"
    blocks = [
        plates.plate_strip(strip) if strip else None,
        plates.plate_moved(strip, strip.moved) if strip and strip.moved else None,
        charts.plate_shift(load_thesis()) if strip and strip.source == "simulated" else None,
        tables.table_methods(rows) if rows else None,
    ]
    best = next((row.method for row in rows if row.status == "ahead"), None)
    if not results.begun:
        step = "judge the maps of your own network on your recordings: `sliplens study DATA --network RUN --quick`."
    elif best:
        step = f"look at your own frames with the method that is ahead: `sliplens explain RUN DATA --method {best}`."
    else:
        step = "train on more trials until five of them are predicted within 5 points, and run the study again."
    return Opening(answer=answer, blocks=tuple(block for block in blocks if block is not None), next_step=step)


@dataclass(frozen=True, kw_only=True)
class Section:
    """A part of the page; without any block it is left out."""

    id: str
    title: str
    short_title: str
    intro: str
    build: Callable[[Results], Blocks]
    step: str = ""
    """Step of a study that makes its results; the page names it where it was not run. Empty where no study has it."""
    blocks: tuple[Block, ...] = ()
    """In the order they are read, once it is built."""


def build_sections(results: Results) -> tuple[Section, ...]:
    """Build the sections whose results are there, in the order they are read; the last says what was not run."""
    built, absent = [], []
    explained = (results.explanations | results.real).values()
    baseline = next((BASELINES[each.baseline] for each in explained), BASELINES["untouched"])
    for section in SECTIONS:
        blocks = tuple(block for block in section.build(results) if block is not None)
        if blocks or section is RECIPE:
            built.append(replace(section, intro=section.intro.replace("{baseline}", baseline), blocks=blocks))
        elif results.begun and section.step and not (section.step == "truth" and results.source == "real"):
            left_out = results.config is not None and section.step in set(TESTS) - set(results.config.tests)
            absent += [] if left_out else [section.short_title]
    missing = f" {', '.join(absent)}: not run yet; `sliplens study` makes it." if absent else ""
    return *built[:-1], replace(built[-1], intro=f"{built[-1].intro}{missing}")


def _names(names: Iterable[str]) -> list[str]:
    """Difference before raw, as in the thesis's figures, and before both what it had not."""
    return inputs_in_order(names)[::-1]


def _notes(title: str, sentences: Iterable[str], *, tone: Literal["plain", "caution"] = "caution") -> Notes | None:
    texts = dict.fromkeys(
        f"{text[:1].upper()}{text[1:].rstrip('.')}." for text in map(name_methods, filter(None, sentences))
    )
    return Notes(title=title, sentences=tuple(texts), tone=tone) if texts else None


def _alarms(name: str, *sentences: Iterable[str]) -> Notes | None:
    return _notes(f"Alarms, {input_name(name).lower()}", (text for each in sentences for text in each))


def _accuracy(results: Results) -> Blocks:
    if results.evaluations:
        yield charts.plate_bins(results)
        yield charts.plate_predictions(results)


def _faithfulness(results: Results) -> Blocks:
    for name in _names({*results.faithfulness, *results.deletion}):
        records = results.faithfulness.get(name), results.deletion.get(name)
        yield tables.table_scores(name, *records)
        yield _alarms(name, *(record.alarms for record in records if record is not None))
    if deletion := results.deletion:
        yield charts.plate_deletion({name: deletion[name] for name in _names(deletion)})


def _maps(results: Results, explanations: Mapping[str, Explanation]) -> Blocks:
    for name in _names(explanations):
        explained = explanations[name]
        yield plates.plate_states(results, explained)
        warnings = {method_name(method): notes.warnings for method, notes in explained.methods.items()}
        yield _alarms(name, (f"{method}: {text}" for method, texts in warnings.items() for text in texts))


def _study_maps(results: Results) -> Blocks:
    if results.states is not None:
        yield _notes("Markers that could not be followed", results.states.untracked)
    yield from _maps(results, results.explanations)
    if results.map_quality or results.randomisation or results.timing:
        yield tables.table_properties(results)
    for name in _names(results.randomisation):
        yield _alarms(name, results.randomisation[name].alarms)


def _choice(results: Results) -> Blocks:
    if (choice := results.choice) is not None:
        sentences = [choice.summary, *results.left_out.values()]
        yield _notes(f"{number_of(len(choice.trials), 'trial')} of {choice.condition} objects", sentences, tone="plain")


def _truth(results: Results) -> Blocks:
    for name in _names(results.truth):
        truth = results.truth[name]
        yield tables.table_localisation(truth)
        unfit = [fill_name(test.fill) for test in truth.meta if not test.holds]
        if unfit:
            why = "a map of the Shapley values does not gain more than the same map with half of the markers shuffled"
            yield _notes(f"Fills without a vote, {input_name(name).lower()}", [f"Under {listed(unfit)} {why}"])
        yield _notes(f"How this was measured, {input_name(name).lower()}", [truth.summary], tone="plain")


def _grip(results: Results) -> Blocks:
    if results.grip is not None:
        yield charts.plate_trace(results.grip)


def _claims(results: Results) -> Blocks:
    if results.begun or results.strip is not None:
        thesis = load_thesis()
        caption = "Claims of the thesis, its numbers, and ours with 95 % intervals over days and trials."
        yield tables.table_claims(f"{caption} {thesis.sample}", thesis.claims)


RECIPE = Section(
    id="recipe",
    title="How these results were made",
    short_title="Recipe",
    intro="Every stage is in a folder of its own; `sliplens report` draws this page from the folders alone, and "
    "`sliplens study` with the same options goes on where it stopped.",
    build=lambda _: iter(()),
)
SECTIONS: tuple[Section, ...] = (
    Section(
        id="real",
        title="Real touch",
        short_title="Real touch",
        intro="Frames of a real sensor, shown to each network.",
        build=lambda results: _maps(results, results.real),
    ),
    Section(
        id="accuracy",
        title="How well the safety margin is predicted",
        short_title="Accuracy",
        intro="Each network predicts trials that it was not trained on (Table 1 and Fig. 7 of the thesis, for this "
        "data). A raw image is the camera's frame; a difference image is that frame against the untouched sensor; "
        "in an image pair both stand side by side.",
        build=_accuracy,
        step="evaluate",
    ),
    Section(
        id="grip",
        title="What the margin holds",
        short_title="Grip",
        intro="A simulated gripper lifts an object and holds it while something happens; the predictions of the "
        "fingertips decide how hard it presses. The least force that holds is the load over both frictions, which no "
        "controller knows.",
        build=_grip,
    ),
    Section(
        id="faithfulness",
        title="How far the explanations can be believed",
        short_title="Faithfulness",
        intro="Parts of a frame are removed: the most supporting first, the least supporting first, and at random. "
        "With a faithful map the prediction returns to that of {baseline} at once in the first case, and not "
        "in the second. Controls are maps that use nothing the network learned. The thesis's score beside it: D = "
        "(1 \N{MINUS SIGN} |change of Γ|)² while pixels go, the most salient first, 1 where nothing changed; with "
        "every pixel gone no map has a part in it.",
        build=_faithfulness,
        step="faithfulness",
    ),
    Section(
        id="maps",
        title="Where each network looks, and what the maps look like",
        short_title="Saliency maps",
        intro="From full stick (Γ 100 %) to the onset of full slip (Γ 0 %): why each network predicts its margin "
        "rather than that of {baseline}. The thesis judged the maps by eye; a study measures the same.",
        build=_study_maps,
        step="explain",
    ),
    Section(
        id="choice",
        title="Which trials were taken",
        short_title="Trials",
        intro="The trials and frames that are explained and scored.",
        build=_choice,
        step="choice",
    ),
    Section(
        id="truth",
        title="What the network should have looked at",
        short_title="Truth",
        intro="Beside the neutral judge, whose effects no map is made to predict: Shapley values, the mean effect of "
        "putting a marker back in the company of all others, to which Integrated Gradients is close by construction. "
        "The best estimate of the margin is linear in the displacements and shows where the network should look.",
        build=_truth,
        step="truth",
    ),
    Section(
        id="claims",
        title="The claims of the thesis",
        short_title="Claims",
        intro="From a study of the two networks that come with sliplens, one an input, on simulated trials of their "
        "sensor: not of this workspace. A claim holds or does not hold beyond the interval; otherwise it is open.",
        build=_claims,
    ),
    RECIPE,
)
"""Sections in the order they are read."""
