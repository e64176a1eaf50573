"""Sections of the page: one list, from which those are taken whose results are there."""

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np

from sliplens.plots.style import input_name, inputs_in_order
from sliplens.report import charts, pictures, tables
from sliplens.report.alarms import alarms_of, group_alarms
from sliplens.report.claims import judge_claims
from sliplens.report.comparisons import tell_sample
from sliplens.report.diagnosis import table_slices
from sliplens.report.grip import show_grip
from sliplens.report.plates import Plate, explained_of
from sliplens.report.results import Results
from sliplens.report.verdict import Verdict


@dataclass(frozen=True, kw_only=True)
class Notes:
    """Sentences under a head of their own: what to be wary of, or what was done; alarms of a kind are one."""

    layout: ClassVar[str] = "notes"

    title: str
    groups: dict[str, list[str]]
    """By what they have in common."""
    tone: Literal["plain", "caution"] = "plain"


Block = tables.Table | Plate | Verdict | Notes
"""Laid out by the template's macro of the name `layout`."""


@dataclass(frozen=True, kw_only=True)
class Section:
    """A part of the page: as it could be, and as it is once it is built."""

    id: str
    title: str
    short_title: str
    intro: str | Callable[[Results], str]
    apart: bool = False
    """True where a study does not have it."""
    simulated: bool = False
    """True where a study has it of simulated data alone."""
    test: str = ""
    """Test of a study whose results they are, which it may leave out; empty where every study has them."""
    build: Callable[[Results, np.random.Generator], Iterable[Block | None]] = lambda *_: ()
    """Makes its blocks; None for one that is not there. Without any, the section is left out."""
    needs: Callable[[Results], Collection[str]] = lambda results: results.inputs
    """Inputs that its results are there for; one that is missing is named."""
    of_sample: bool = False
    """True where its scores are of the study's sample: the page says beside each how sound that is."""
    missing: tuple[str, ...] = ()
    blocks: tuple[Block, ...] = ()
    """In the order they are read."""


def build_sections(results: Results, *, rng: np.random.Generator) -> tuple[Section, ...]:
    """Build the sections whose results are there, in the order they are read; the last says what was not run."""
    sections, absent = [], []
    for section in SECTIONS:
        blocks = tuple(block for block in section.build(results, rng) if block is not None)
        # a study that stopped was asked for what it says; single commands are asked for one by one
        study = results.study
        unasked = section.apart or not study or (section.simulated and study.source == "real")
        if not blocks and (unasked or (section.test and study.config and section.test not in study.config.tests)):
            continue
        if not blocks:
            absent.append(section.short_title)
            continue
        expected = _names(results.inputs) if results.study else []
        without = [name for name in expected if name not in section.needs(results)]
        missing = tuple(f"{input_name(name)}: not run yet; `sliplens study` makes it." for name in without)
        intro = section.intro if isinstance(section.intro, str) else section.intro(results)
        if results.study.choice is not None and section.of_sample:
            sample = tell_sample(results.study.choice)
            intro += f" {sample}"
            blocks = tuple(
                replace(block, caption=f"{block.caption} {sample}") if isinstance(block, tables.Table) else block
                for block in blocks
            )
        sections.append(replace(section, intro=intro, missing=missing, blocks=blocks))
    return (*sections, _recipe(results, absent))


def _accuracy(results: Results, _: np.random.Generator) -> Iterable[Block | None]:
    if results.evaluations:
        yield tables.table_accuracy(results)
        yield charts.plate_bins(results)
        yield charts.plate_predictions(results)


def _faithfulness(results: Results, _: np.random.Generator) -> Iterable[Block | None]:
    records = results.study.faithfulness
    for name in _names(records):
        yield tables.table_scores(records[name], results.scores.get((name, results.study.source)))
        yield tables.table_leads(records[name])
        yield _alarms(results, name, "faithfulness")
        yield charts.plate_removal_curves(records[name])


def _deletion(results: Results, rng: np.random.Generator) -> Iterable[Block | None]:
    by_source = {
        source: {name: results.scores[name, source] for name in _names(scored)}
        for source in ("simulated", "real")
        if (scored := [name for name, score in results.scores if score == source])
    }
    # beside the sound scores stands D already
    yield from (
        tables.table_deletion(scores, rng=rng) for scores in by_source.values() if not results.study.faithfulness
    )
    yield from (charts.plate_faithfulness(scores) for scores in by_source.values())
    for name in _names(by_source.get(results.study.source, {})):
        yield _alarms(results, name, "score")


def _randomisation(results: Results, _: np.random.Generator) -> Iterable[Block | None]:
    records = results.study.randomisation
    if records:
        yield charts.plate_randomisation(results)
        yield tables.table_randomisation(records)
        yield from (_alarms(results, name, "randomisation") for name in _names(records))


def _maps(results: Results, _: np.random.Generator) -> Iterable[Block | None]:
    study = results.study
    if study.states is not None:
        yield _notes("Markers that could not be followed", study.states.untracked, tone="caution")
    for name in _names(results.inputs):
        explained = explained_of(results, name)
        if explained is not None:
            yield pictures.plate_states(results, explained)
            yield _alarms(results, name, "explain")
    yield tables.table_looks(study.map_quality) if study.map_quality else None


def _real(results: Results, _: np.random.Generator) -> Iterable[Block | None]:
    chosen = {name: explanation for (name, source), explanation in results.explanations.items() if source == "real"}
    if chosen and results.study.source != "real":
        for name in _names(chosen):
            yield pictures.plate_states(results, chosen[name])
            yield _alarms(results, name, "explain") if explained_of(results, name) is None else None


def _cost(results: Results, _: np.random.Generator) -> Iterable[Block | None]:
    if results.study.timing:
        yield tables.table_times(results.study.timing)


def _truth(results: Results, _: np.random.Generator) -> Iterable[Block | None]:
    records = results.study.truth
    for name in _names(records):
        yield pictures.plate_truth(results, name)
        yield tables.table_localisation(records[name])
        yield tables.table_meta(records[name])
        yield _notes(f"How this was measured, {input_name(name).lower()}", [records[name].summary])


def _diagnosis(results: Results, _: np.random.Generator) -> Iterable[Block | None]:
    for name in _names(results.diagnoses):
        records = results.diagnoses[name]
        groups = {sentence: [sentence] for sentence in records.sentences}
        yield Notes(title=f"What was found, {input_name(name).lower()}", groups=groups)
        yield table_slices(records)


def _recipe(results: Results, absent: list[str]) -> Section:
    again = " `sliplens study` with the same options goes on where it stopped, and" if results.study else ""
    intro = (
        f"Every stage is kept in a folder of its own;{again} `sliplens report` draws this page from the folders alone."
    )
    return Section(
        id="recipe",
        title="How these results were made",
        short_title="Recipe",
        intro=intro,
        missing=(f"{', '.join(absent)}: not run yet; `sliplens study` makes it.",) if absent else (),
        blocks=(charts.plate_learning(results),) if results.trainings else (),
    )


def _alarms(results: Results, name: str, stage: str) -> Notes | None:
    alarms = alarms_of(results, name, stage)
    title = "Warnings of the methods" if stage == "explain" else "Alarms"
    return _notes(f"{title}, {input_name(name).lower()}", alarms, tone="caution")


def _notes(title: str, sentences: Iterable[str], *, tone: Literal["plain", "caution"] = "plain") -> Notes | None:
    groups = group_alarms([sentence for sentence in sentences if sentence])
    return Notes(title=title, groups=groups, tone=tone) if groups else None


def _names(found: Iterable[str]) -> list[str]:
    """Difference before raw, as in the thesis's figures, and before both what it had not."""
    return inputs_in_order(found)[::-1]


SECTIONS: tuple[Section, ...] = (
    Section(
        id="claims",
        of_sample=True,
        title="The claims of the thesis, tested here",
        short_title="Claims",
        intro="Each claim holds, does not hold, or stays undecided. A fill is what removed parts become; intervals (95 "
        "%) are over days and trials; fewer than five trials decide nothing. A claim holds for a network where it "
        "holds under more than half of the fills and the opposite is sure under none.",
        build=lambda results, rng: judge_claims(results, rng=rng) if results.study else (),
    ),
    Section(
        id="accuracy",
        title="How well the safety margin is read",
        short_title="Accuracy",
        intro="Each network answers on trials it was not trained on (Table 1 and Fig. 7 of the thesis, for this "
        "data). A raw image is the camera's frame; a difference image is that frame against the untouched sensor; "
        "in an image pair both stand side by side.",
        build=_accuracy,
        needs=lambda results: results.evaluations,
    ),
    Section(
        id="diagnosis",
        title="Where the network fails, and why",
        short_title="Why it fails",
        intro="Slices of the trials in which the error is large, tested on trials they were not found on; how much of "
        "the error no reader of one frame could spare; what the network says of the same press and pull where friction "
        "alone differs.",
        apart=True,
        build=_diagnosis,
        needs=lambda results: results.diagnoses,
    ),
    Section(
        id="grip",
        title="What the margin holds",
        short_title="Grip",
        intro="A simulated gripper lifts an object and holds it while something happens; what the fingertips read "
        "decides how hard it presses. The least force that holds is the load over both frictions, which no controller "
        "knows.",
        apart=True,
        build=lambda results, _: () if results.grip is None else show_grip(results.grip),
        needs=lambda results: results.inputs,
    ),
    Section(
        id="faithfulness",
        test="faithfulness",
        of_sample=True,
        title="How far the explanations can be believed",
        short_title="Faithfulness",
        intro="Parts of a frame are removed: the most supporting first, the least supporting first, and at random. "
        "With a faithful map the prediction returns to that of the untouched sensor at once in the first case, and not "
        "in the second. Controls are maps that use nothing the network learned.",
        build=_faithfulness,
        needs=lambda results: results.study.faithfulness,
    ),
    Section(
        id="deletion",
        test="score",
        of_sample=True,
        title="The thesis's score, step by step",
        short_title="Deletion",
        intro="D = (1 \N{MINUS SIGN} |change of Γ|)² while pixels go, the most salient first: 1 where nothing changed, "
        "towards 0 if the network did rely on them. Removing pixels in random order is the control that each method "
        "has to beat. With every pixel gone no map has a part in it.",
        build=_deletion,
        needs=lambda results: {name for name, _ in results.scores},
    ),
    Section(
        id="randomisation",
        test="randomisation",
        of_sample=True,
        title="Does the explanation notice that the network forgot everything?",
        short_title="New weights",
        intro="The weights are drawn anew, layer by layer from the output. A map of what was learned has to change.",
        build=_randomisation,
        needs=lambda results: results.study.randomisation,
    ),
    Section(
        id="maps",
        of_sample=True,
        title="Where each network looks, and what the maps look like",
        short_title="Saliency maps",
        intro="From full stick (Γ 100 %) to the onset of full slip (Γ 0 %): what each method holds to speak for the "
        "answer, rather than for that on the untouched sensor. The thesis judged the maps by eye; a study measures "
        "the same.",
        build=_maps,
        needs=lambda results: {name for name, source in results.explanations if source == results.study.source},
    ),
    Section(
        id="real",
        title="Real touch",
        short_title="Real touch",
        intro="Frames of a real sensor, shown to each network.",
        apart=True,
        build=_real,
        # real frames may exist as difference images only, so one input is enough
    ),
    Section(
        id="timing",
        test="timing",
        title="What an explanation costs",
        short_title="Cost",
        intro="Seconds a frame; a study measures them with warm-up, and waiting for the device to finish.",
        build=_cost,
        needs=lambda results: results.study.timing,
    ),
    Section(
        id="choice",
        title="Which trials were taken",
        short_title="Trials",
        intro=lambda results: (
            ""
            if results.study.choice is None
            else " ".join([results.study.choice.summary, *(f"{text}." for text in results.study.left_out.values())])
        ),
        build=lambda results, _: () if results.study.choice is None else (tables.table_trials(results.study.choice),),
    ),
    Section(
        id="truth",
        test="truth",
        simulated=True,
        of_sample=True,
        title="What the network should have looked at",
        short_title="Truth",
        intro="The simulator draws each frame again with markers put back to rest. A Shapley value is the mean "
        "of its effect on the prediction in the company of all others; a map should show these values, signs included. "
        "Integrated Gradients is close to them by construction. The best estimate of the margin is linear in the "
        "markers' displacements and shows where the network should look.",
        build=_truth,
        needs=lambda results: results.study.truth,
    ),
)
"""Sections in the order they are read."""
