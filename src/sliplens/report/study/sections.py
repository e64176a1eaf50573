"""Sections of a study's page, in the order they are read, and the figures that go into them."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sliplens.plots.style import input_name, inputs_in_order, name_methods
from sliplens.report.blocks import Notes
from sliplens.report.claims import judge_claims
from sliplens.report.method_tables import (
    table_agreement,
    table_equal_areas,
    table_localisation,
    table_looks,
    table_meta,
    table_randomisation,
    table_remedies,
    table_scores,
    table_times,
    table_trials,
)
from sliplens.report.plates import Plate, show_plate
from sliplens.report.removal_figures import (
    plate_deletion,
    plate_highlighted,
    plate_randomisation,
    plate_removal,
    plate_removal_curves,
    removal_methods,
)
from sliplens.report.saliency_figures import (
    plate_bins,
    plate_each_frame,
    plate_faithfulness,
    plate_methods,
    plate_poly_cam,
    plate_states,
)
from sliplens.report.sections import Block, Section, recipe_section
from sliplens.report.state_figures import plate_contact_states, plate_fields_beside_saliency, plate_truth
from sliplens.report.tables import Table, table_accuracy
from sliplens.report.workspace import Results


@dataclass(frozen=True, kw_only=True)
class StudyPage:
    """Sections of a study's page, and the figures that are written beside it."""

    sections: tuple[Section, ...]
    plates: tuple[Plate, ...]


def build_study_page(results: Results, *, rng: np.random.Generator) -> StudyPage:
    """Draw and judge a study; what was not run is named in its section."""
    drawn: list[tuple[Section, list[Plate | Table | Notes | None]]] = [
        _accuracy(results),
        _faithfulness(results),
        _removal(results),
        _randomisation(results),
        _maps(results),
        _timing(results),
        _choice(results),
        _truth(results),
    ]
    claims = Section(
        id="claims",
        title="The claims of the thesis, tested here",
        short_title="Claims",
        intro="Each claim holds, does not hold, or stays undecided. A fill is what removed parts become; intervals (95 "
        "%) resample whole trials, of which fewer than five decide nothing. A claim holds for a network where it holds "
        "under more than half of the fills and the opposite is sure under none.",
        blocks=judge_claims(results, rng=rng),
    )
    sections = [replace(section, blocks=tuple(_shown(blocks))) for section, blocks in drawn]
    recipe = replace(
        recipe_section(results),
        intro="Every stage is kept in a folder of its own; `sliplens study` with the same options goes on where it "
        "stopped, and `sliplens report` draws this page from the folders alone.",
        missing=(),
    )
    return StudyPage(
        sections=(claims, *sections, recipe),
        plates=tuple(block for _, blocks in drawn for block in blocks if isinstance(block, Plate)),
    )


def _shown(blocks: Iterable[Plate | Table | Notes | None]) -> Iterable[Block]:
    for block in blocks:
        if isinstance(block, Plate):
            yield show_plate(block)
        elif block is not None:
            yield block


def _accuracy(results: Results) -> tuple[Section, list[Plate | Table | Notes | None]]:
    section = Section(
        id="accuracy",
        title="How well the safety margin is read",
        short_title="Accuracy",
        intro="Table 1 and Fig. 7 of the thesis, for this data. A raw image is the camera's frame; a difference image "
        "is that frame against the untouched sensor.",
        missing=_missing(results, results.evaluations),
    )
    return section, [table_accuracy(results), plate_bins(results)] if results.evaluations else []


def _faithfulness(results: Results) -> tuple[Section, list[Plate | Table | Notes | None]]:
    found = results.study.faithfulness
    blocks: list[Plate | Table | Notes | None] = []
    for name in _names(found):
        scored = results.scores.get((name, results.study.source))
        alarms = (*(scored.alarms if scored else ()), *found[name].alarms)
        blocks += [
            table_scores(found[name], scored),
            _alarms(name, alarms),
            table_equal_areas(found[name]),
            table_agreement(found[name]),
            plate_removal_curves(found[name]),
        ]
    section = Section(
        id="faithfulness",
        title="How far the explanations can be believed",
        short_title="Faithfulness",
        intro="Table 2 of the thesis beside scores that do not depend on one fill. Parts of a frame are removed: first "
        "those that a map says speak for the answer, first those that speak least for it, and at random. With a "
        "faithful map the answer goes back to that on the untouched sensor at once in the first case, and not in the "
        "second. Controls are maps that know nothing of the trained network.",
        missing=_missing(results, found),
    )
    return section, blocks


def _removal(results: Results) -> tuple[Section, list[Plate | Table | Notes | None]]:
    found, source = results.study.remedies, results.study.source
    blocks: list[Plate | Table | Notes | None] = [plate_deletion(results), plate_faithfulness(results)]
    for name in _names(found):
        blocks += [table_remedies(found[name], results.scores.get((name, source))), _alarms(name, found[name].alarms)]
    blocks += [plate_highlighted(results)]
    blocks += [plate_removal(results, method) for method in removal_methods(results)]
    blocks += [plate_each_frame(results, name) for name in _names(name for name, _ in results.scores)]
    section = Section(
        id="deletion",
        title="The thesis's score, step by step, and its remedies",
        short_title="Deletion",
        intro="D = (1 \N{MINUS SIGN} |change of Γ|)² while pixels become grey, the most salient first: 1 where nothing "
        "changed. With every pixel gone no map has a part in it.",
        missing=_missing(results, {name for name, _ in results.scores} & set(found) if found else ()),
    )
    return section, blocks


def _randomisation(results: Results) -> tuple[Section, list[Plate | Table | Notes | None]]:
    found = results.study.randomisation
    blocks: list[Plate | Table | Notes | None] = []
    if found:
        blocks = [plate_randomisation(results), table_randomisation(found)]
        blocks += [_alarms(name, found[name].alarms) for name in _names(found)]
    section = Section(
        id="randomisation",
        title="Does the explanation notice that the network forgot everything?",
        short_title="New weights",
        intro="The weights are drawn anew, layer by layer from the output. A map of what was learned has to change.",
        missing=_missing(results, found),
    )
    return section, blocks


def _maps(results: Results) -> tuple[Section, list[Plate | Table | Notes | None]]:
    states, looks = results.study.states, results.study.map_quality
    blocks: list[Plate | Table | Notes | None] = [
        None if states is None else plate_contact_states(states),
        Notes(title="Markers that could not be followed", sentences=states.untracked, tone="caution")
        if states is not None and states.untracked
        else None,
        plate_methods(results),
        *(plate_states(results, name) for name in _names(results.study.inputs)),
        plate_poly_cam(results),
        plate_fields_beside_saliency(results),
        table_looks(looks) if looks else None,
    ]
    absent = [] if states else ["Contact states: not run yet; `sliplens study` makes it."]
    section = Section(
        id="maps",
        title="Where the networks look, and what the maps look like",
        short_title="Saliency maps",
        intro="From full stick (Γ 100 %) to the onset of full slip (Γ 0 %). The thesis judged the maps by eye; here "
        "the same is measured.",
        missing=(*absent, *_missing(results, looks)),
    )
    return section, blocks


def _timing(results: Results) -> tuple[Section, list[Plate | Table | Notes | None]]:
    found = results.study.timing
    section = Section(
        id="timing",
        title="What an explanation costs",
        short_title="Cost",
        intro="With warm-up, and waiting for the device to finish.",
        missing=_missing(results, found),
    )
    return section, [table_times(found)] if found else []


def _choice(results: Results) -> tuple[Section, list[Plate | Table | Notes | None]]:
    choice = results.study.choice
    section = Section(
        id="choice",
        title="Which trials were taken",
        short_title="Trials",
        intro="Which trials were taken is not recorded." if choice is None else choice.told,
        missing=() if choice else ("Choice of trials: not run yet; `sliplens study` makes it.",),
    )
    return section, [] if choice is None else [table_trials(choice)]


def _truth(results: Results) -> tuple[Section, list[Plate | Table | Notes | None]]:
    found = results.study.truth
    blocks: list[Plate | Table | Notes | None] = []
    for name in _names(found):
        told = found[name].told
        blocks += [
            plate_truth(results, name),
            table_localisation(found[name]),
            table_meta(found[name]),
            Notes(title=f"How this was measured, {input_name(name).lower()}", sentences=(told,)) if told else None,
        ]
    simulated = results.study.source == "simulated"
    section = Section(
        id="truth",
        title="What the network should have looked at",
        short_title="Truth",
        intro="Simulated touch can be filmed again with one marker put back where it rested: what that does to the "
        "network's answer is what a map should show. What it does to the best reading of the margin (linear in the "
        "markers' displacements, exact for small ones) is where the network should look; stretched over a marker's "
        "whole motion that reading may exceed the margin itself, and the markers cancel."
        if simulated
        else "Only simulated touch can be filmed again with one marker put back: of recorded touch no truth is known.",
        missing=_missing(results, found) if simulated else (),
    )
    return section, blocks


def _alarms(name: str, alarms: Sequence[str]) -> Notes | None:
    if not alarms:
        return None
    title = f"Alarms, {input_name(name).lower()}"
    shown = map(name_methods, alarms)
    # the same fill can be found wanting by two scores
    sentences = tuple(dict.fromkeys(f"{one[:1].upper()}{one[1:].rstrip('.')}." for one in shown))
    return Notes(title=title, sentences=sentences, tone="caution")


def _names(found: Iterable[str]) -> list[str]:
    """Difference before raw, as in the thesis's figures."""
    return inputs_in_order(found)[::-1]


def _missing(results: Results, found: Iterable[str]) -> tuple[str, ...]:
    choice, there = results.study.choice, set(found)
    wanted = choice.inputs if choice else ("difference", "raw")
    return tuple(
        f"{input_name(name)}: not run yet; `sliplens study` makes it." for name in _names(wanted) if name not in there
    )
