"""Sections of the page: a table, of which those are drawn whose results are there."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

from sliplens.plots.style import fill_name, input_name, inputs_in_order, listed, method_name, name_methods
from sliplens.progress import number_of
from sliplens.report import charts, plates, tables
from sliplens.report.comparisons import write_sample
from sliplens.report.results import Results
from sliplens.report.verdict import load_thesis
from sliplens.results.explanation import BASELINES
from sliplens.results.study import TESTS


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
class Section:
    """A part of the page; without any block it is left out."""

    id: str
    title: str
    short_title: str
    intro: str
    build: Callable[[Results], Blocks]
    step: str = ""
    """Step of a study that makes its results; the page names it where it was not run. Empty where no study has it."""
    of_sample: bool = False
    """True where its scores are of the study's sample: the page says how sound that is."""
    blocks: tuple[Block, ...] = ()
    """In the order they are read, once it is built."""


def build_sections(results: Results) -> tuple[Section, ...]:
    """Build the sections whose results are there, in the order they are read; the last says what was not run."""
    built, absent, study = [], [], results.study
    baseline = next((BASELINES[each.baseline] for each in results.explanations.values()), BASELINES["untouched"])
    for section in SECTIONS:
        blocks = tuple(block for block in section.build(results) if block is not None)
        if blocks:
            sample = f" {write_sample(study.choice)}" if study.choice is not None and section.of_sample else ""
            intro = f"{section.intro}{sample}".replace("{baseline}", baseline)
            built.append(replace(section, intro=intro, blocks=blocks))
        elif study and section.step and not (section.step == "truth" and study.source == "real"):
            left_out = study.config is not None and section.step in set(TESTS) - set(study.config.tests)
            absent += [] if left_out else [section.short_title]
    blocks = tuple(block for block in RECIPE.build(results) if block is not None)
    missing = f" {', '.join(absent)}: not run yet; `sliplens study` makes it." if absent else ""
    return *built, replace(RECIPE, intro=f"{RECIPE.intro}{missing}", blocks=blocks)


def _names(names: Iterable[str]) -> list[str]:
    """Difference before raw, as in the thesis's figures, and before both what it had not."""
    return inputs_in_order(names)[::-1]


def _notes(title: str, sentences: Iterable[str], *, tone: Literal["plain", "caution"] = "caution") -> Notes | None:
    texts = dict.fromkeys(
        f"{text[:1].upper()}{text[1:].rstrip('.')}." for text in map(name_methods, filter(None, sentences))
    )
    return Notes(title=title, sentences=tuple(texts), tone=tone) if texts else None


def _alarms(name: str, sentences: Iterable[str]) -> Notes | None:
    return _notes(f"Alarms, {input_name(name).lower()}", sentences)


def _accuracy(results: Results) -> Blocks:
    if results.evaluations:
        yield tables.table_accuracy(results)
        yield charts.plate_bins(results)
        yield charts.plate_predictions(results)


def _faithfulness(results: Results) -> Blocks:
    for name in _names(results.study.faithfulness):
        faithful = results.study.faithfulness[name]
        yield tables.table_scores(name, faithful, results.scores.get((name, results.study.source)))
        yield _alarms(name, faithful.alarms)
        yield charts.plate_removal_curves(faithful)


def _deletion(results: Results) -> Blocks:
    study = results.study
    for source in ("simulated", "real"):
        scores = {
            name: results.scores[name, source] for name in _names(results.inputs) if (name, source) in results.scores
        }
        if scores:
            yield charts.plate_deletion(scores)
        for name, scored in scores.items():
            # beside the removal scores stands D already
            yield None if name in study.faithfulness else tables.table_scores(name, None, scored)
            yield _alarms(name, scored.alarms)


def _randomisation(results: Results) -> Blocks:
    if records := results.study.randomisation:
        yield tables.table_randomisation(records)
        yield from (_alarms(name, records[name].alarms) for name in _names(records))


def _maps(results: Results, source: str) -> Blocks:
    for name in _names(name for name, origin in results.explanations if origin == source):
        explained = results.explanations[name, source]
        yield plates.plate_states(results, explained)
        warnings = {method_name(method): notes.warnings for method, notes in explained.methods.items()}
        yield _alarms(name, (f"{method}: {text}" for method, texts in warnings.items() for text in texts))


def _study_maps(results: Results) -> Blocks:
    study = results.study
    if study.states is not None:
        yield _notes("Markers that could not be followed", study.states.untracked)
    yield from _maps(results, study.source)
    yield tables.table_looks(study.map_quality) if study.map_quality else None


def _real_maps(results: Results) -> Blocks:
    if results.study.source != "real":
        yield from _maps(results, "real")


def _timing(results: Results) -> Blocks:
    if results.study.timing:
        yield tables.table_times(results.study.timing)


def _choice(results: Results) -> Blocks:
    if (choice := results.study.choice) is not None:
        sentences = [choice.summary, write_sample(choice), *results.study.left_out.values()]
        yield _notes(f"{number_of(len(choice.trials), 'trial')} of {choice.condition} objects", sentences, tone="plain")


def _truth(results: Results) -> Blocks:
    for name in _names(results.study.truth):
        truth = results.study.truth[name]
        yield plates.plate_truth(results, name)
        yield tables.table_localisation(truth)
        unfit = [fill_name(test.fill) for test in truth.meta if not test.holds]
        if unfit:
            why = "a map of the Shapley values does not gain more than the same map with half of the markers shuffled"
            yield _notes(f"Fills without a vote, {input_name(name).lower()}", [f"Under {listed(unfit)} {why}"])
        yield _notes(f"How this was measured, {input_name(name).lower()}", [truth.summary], tone="plain")


def _grip(results: Results) -> Blocks:
    if results.grip is not None:
        yield charts.plate_trace(results.grip)
        yield tables.table_episodes(results.grip)


def _claims(results: Results) -> Blocks:
    if results.study or results.strip is not None:
        yield tables.table_claims(load_thesis())


def _learning(results: Results) -> Blocks:
    if results.trainings:
        yield charts.plate_learning(results)


SECTIONS: tuple[Section, ...] = (
    Section(
        id="real",
        title="Real touch",
        short_title="Real touch",
        intro="Frames of a real sensor, shown to each network.",
        build=_real_maps,
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
        "in the second. Controls are maps that use nothing the network learned.",
        build=_faithfulness,
        step="faithfulness",
        of_sample=True,
    ),
    Section(
        id="deletion",
        title="The thesis's score, step by step",
        short_title="Deletion",
        intro="D = (1 \N{MINUS SIGN} |change of Γ|)² while pixels go, the most salient first: 1 where nothing changed, "
        "towards 0 if the network did rely on them. Removing pixels in random order is the control that each method "
        "has to beat. With every pixel gone no map has a part in it.",
        build=_deletion,
        step="score",
        of_sample=True,
    ),
    Section(
        id="randomisation",
        title="Does the explanation notice that the network forgot everything?",
        short_title="New weights",
        intro="The weights are drawn anew, layer by layer from the output. A map of what was learned has to change.",
        build=_randomisation,
        step="randomisation",
        of_sample=True,
    ),
    Section(
        id="maps",
        title="Where each network looks, and what the maps look like",
        short_title="Saliency maps",
        intro="From full stick (Γ 100 %) to the onset of full slip (Γ 0 %): why each network predicts its margin "
        "rather than that of {baseline}. The thesis judged the maps by eye; a study measures the same.",
        build=_study_maps,
        step="explain",
        of_sample=True,
    ),
    Section(
        id="timing",
        title="What an explanation costs",
        short_title="Cost",
        intro="Seconds a frame; a study measures them with warm-up, and waiting for the device to finish.",
        build=_timing,
        step="timing",
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
        intro="The simulator draws each frame again with groups of markers moved to where they lie at another margin "
        "of the same trial: a map should predict, signs included, how that changes the prediction. No map is made to. "
        "Beside this neutral judge: Shapley values, the mean effect of putting a marker back to the stick frame, or to "
        "rest, in the company of all others. Integrated Gradients is close to those by construction. The best "
        "estimate of the margin is linear in the markers' displacements and shows where the network should look.",
        build=_truth,
        step="truth",
        of_sample=True,
    ),
    Section(
        id="claims",
        title="The claims of the thesis",
        short_title="Claims",
        intro="From a study of the two networks that come with sliplens, one an input, on simulated trials of their "
        "sensor: not of this workspace. A claim holds or does not hold beyond the interval; otherwise it is open.",
        build=_claims,
    ),
)
"""Sections in the order they are read."""
RECIPE = Section(
    id="recipe",
    title="How these results were made",
    short_title="Recipe",
    intro="Every stage is in a folder of its own; `sliplens report` draws this page from the folders alone, and "
    "`sliplens study` with the same options goes on where it stopped.",
    build=_learning,
)
