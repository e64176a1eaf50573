"""The claims of the thesis, each tested on this data.

References
----------
Polak, *Explainable Neural Networks for Incipient Slip Sensing in Robot Tactile Learning*, sections 5.2 to 5.4 and 6.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, TypeVar

import numpy as np

from sliplens.intervals import Difference, mean_interval
from sliplens.plots.style import (
    decimals,
    fill_name,
    input_name,
    inputs_in_order,
    listed,
    method_name,
    percent,
    tell_ends,
)
from sliplens.progress import number_of
from sliplens.report.comparisons import (
    AS_RUN,
    compare_deletion,
    compare_gain,
    gap_from,
    mean_at,
    removal_by_setting,
    sentence,
    share_of_strongest,
    tell_interval,
    voting_settings,
)
from sliplens.report.results import Results
from sliplens.results.faithfulness import DeletionCurve, RemovalScores
from sliplens.results.study import MapQuality, Truth

Outcome = Literal["holds", "does not hold", "undecided"]
Record = TypeVar("Record")
_OPPOSITE: dict[Outcome, Outcome] = {"holds": "does not hold", "does not hold": "holds"}
_UNSCORED = "its explanations were not scored; `sliplens study` does that"
POLY_CAM, GRAD_CAM, NOISY = (f"{one}{AS_RUN}" for one in ("poly-cam", "grad-cam", "integrated-gradients"))
"""What the thesis compared, as it was published and run: its claims are of these, and rest on no others."""
_RIVALS = (GRAD_CAM, NOISY)
_MEASURES = {"total_variation": "total variation", "noise_stability": "stability under sensor noise"}
_SMALL_AREA = 0.05


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One comparison: where, of what, its number with an interval if there is one, and what it says of the claim."""

    where: str
    """Fill and unit, or the score."""
    compared: str
    gap: Difference | None = None
    value: str = ""
    """Number where no interval is kept."""
    outcome: Outcome | None = None
    """None where the comparison is told but does not decide."""


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What one network, or two together, say of a claim."""

    subject: str
    outcome: Outcome
    text: str
    findings: tuple[Finding, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Claim:
    """A claim of the thesis, in our words, with an answer for each network."""

    layout: ClassVar[str] = "claim"

    id: str
    title: str
    test: str
    answers: tuple[Answer, ...]


def judge_claims(results: Results, *, rng: np.random.Generator) -> tuple[Claim, ...]:
    """Test every claim; where the results it needs are not there, it stays undecided and says why."""
    study = results.study

    def against_rivals(faithful: RemovalScores) -> Answer:
        return _beats_rivals(faithful, results, rng=rng)

    def against_chance(faithful: RemovalScores) -> Answer:
        return _no_better(faithful, study.truth.get(faithful.input), rng=rng)

    return (
        Claim(
            id="most-faithful",
            title="Poly-CAM is the most faithful of the three methods",
            test="Tested by the symmetric relevance gain (SRG): holds under a fill where Poly-CAM's is larger than "
            "both others' and the 95 % interval of each difference leaves zero out.",
            answers=_of_each(results, study.faithfulness, against_rivals, why=_UNSCORED),
        ),
        Claim(
            id="difference",
            title="Difference images give more faithful explanations than raw images",
            test="Tested on the same frames, evidence lost in margin units: holds under a fill where the SRG averaged "
            "over the methods is larger for difference images, beyond the 95 % interval.",
            answers=(_compare_inputs(results, rng=rng),),
        ),
        Claim(
            id="grad-cam",
            title="Grad-CAM is not faithful",
            test="Tested against maps that know nothing of the network: holds under a fill where Grad-CAM's SRG lies "
            "below chance or below the best control for sure; does not hold where it lies above both for sure.",
            answers=_of_each(results, study.faithfulness, against_chance, why=_UNSCORED),
        ),
        Claim(
            id="noisy",
            title="Integrated Gradients is noisy",
            test="Tested by numbers: holds where its maps have a larger total variation than those of the other "
            "two, beyond the 95 % interval. Their stability under sensor noise is told beside it and decides nothing: "
            "means over a few frames have no interval.",
            answers=_of_each(
                results,
                study.map_quality,
                _noisiest,
                why="the looks of the maps were not measured; `sliplens study` does that",
            ),
        ),
        Claim(
            id="two-markers",
            title="The network looks at the edges of two markers",
            test="Tested on simulated touch in two parts, both needed: putting back a marker at a time, the strongest "
            "two hold more than half of all change of the answer; and Poly-CAM's relevance lies on marker edges more "
            "than their share of the image.",
            answers=_of_each(
                results,
                study.truth,
                lambda truth: _looks_at_two(truth, rng=rng),
                why="only simulated touch tells what each marker does, and no such result is here",
            ),
        ),
    )


def judge_gap(gap: Difference | None) -> Outcome:
    """Positive for sure, negative for sure, or neither."""
    if gap is None or not gap.sure:
        return "undecided"
    return "holds" if gap.estimate > 0 else "does not hold"


def all_of(outcomes: Iterable[Outcome]) -> Outcome:
    """Join parts that must all hold: one that does not is enough."""
    found = set(outcomes)
    if "does not hold" in found:
        return "does not hold"
    return "holds" if found == {"holds"} else "undecided"


def most_of(outcomes: Sequence[Outcome]) -> Outcome:
    """Join settings: more than half of them agree, and none says the opposite."""
    for outcome, opposite in _OPPOSITE.items():
        if 2 * outcomes.count(outcome) > len(outcomes) and opposite not in outcomes:
            return outcome
    return "undecided"


def _of_each(
    results: Results, found: Mapping[str, Record], judge: Callable[[Record], Answer], *, why: str
) -> tuple[Answer, ...]:
    """Answer for each network, raw images last; one without a result stays open, and why."""
    names = inputs_in_order(results.study.inputs)[::-1]
    return tuple(judge(found[name]) if name in found else _untested(input_name(name), why) for name in names)


def _untested(subject: str, why: str) -> Answer:
    return Answer(subject=subject, outcome="undecided", text=f"Not tested: {why}.")


def _over_fills(
    subject: str, by_setting: dict[str, Outcome], findings: list[Finding], voting: Sequence[tuple[str, str]]
) -> Answer:
    """Answer by what holds under most fills that vote (`voting_settings`), with the intervals of the first."""
    by_vote = [fill_name(*one) for one in voting]
    findings = [replace(one, outcome=one.outcome if one.where in by_vote else None) for one in findings]
    by_setting = {name: own for name, own in by_setting.items() if name in by_vote}
    if not by_setting:
        why = "under no fill that was scored does a map made from the truth win for sure"
        return replace(_untested(subject, why), findings=tuple(findings))
    names = {found: [name for name, own in by_setting.items() if own == found] for found in (*_OPPOSITE, "undecided")}
    text = sentence("; ".join(f"{outcome} under {listed(where)}" for outcome, where in names.items() if where))
    first = next(one.where for one in findings if one.where in by_setting)
    told = [f"{one.compared}: {tell_interval(one.gap)}" for one in findings if one.gap and one.where == first]
    text += f" Under {first}, {'; '.join(told)}." if told else " "
    outcome = most_of(list(by_setting.values()))
    return Answer(subject=subject, outcome=outcome, text=text, findings=tuple(findings))


def _judged(where: str, gaps: Mapping[str, Difference | None]) -> list[Finding]:
    return [Finding(where=where, compared=name, gap=gap, outcome=judge_gap(gap)) for name, gap in gaps.items()]


def _by_thesis_score(
    pairs: Mapping[str, tuple[DeletionCurve, DeletionCurve]], *, rng: np.random.Generator
) -> list[Finding]:
    return [
        Finding(
            where="score of the thesis",
            compared=f"{compared} (below zero = more faithful)",
            gap=compare_deletion(*pair, rng=rng),
        )
        for compared, pair in pairs.items()
    ]


def _beats_rivals(faithful: RemovalScores, results: Results, *, rng: np.random.Generator) -> Answer:
    findings, by_setting, subject, method = [], {}, input_name(faithful.input), POLY_CAM
    name = method_name(method)
    for where, curves in removal_by_setting(faithful):
        rivals = [one for one in _RIVALS if {one, method} <= set(curves)]
        if len(rivals) == len(_RIVALS):
            gaps = {one: compare_gain((curves[method], curves[one]), rng=rng) for one in rivals}
            by_setting[where] = all_of(judge_gap(gap) for gap in gaps.values())
            findings += _judged(where, {f"SRG, {name} less {method_name(one)}": gap for one, gap in gaps.items()})
    if not by_setting:
        return _untested(subject, "the thesis's three methods, as it ran them, were not scored together")
    scored = next((one.curves for (own, _), one in results.scores.items() if own == faithful.input), {})
    rivals = [one for one in _RIVALS if {one, method} <= set(scored)]
    pairs = {f"D, {name} less {method_name(one)}": (scored[method], scored[one]) for one in rivals}
    findings += _by_thesis_score(pairs, rng=rng)
    voting = voting_settings(faithful, results.study.truth.get(faithful.input))
    return _over_fills(subject, by_setting, findings, voting)


def _compare_inputs(results: Results, *, rng: np.random.Generator) -> Answer:
    findings, by_setting, found = [], {}, results.study.faithfulness
    studied = results.study.inputs
    names = [name for name in ("difference", "raw") if name in studied] or inputs_in_order(studied)
    subject = listed([input_name(name).lower() for name in names]).capitalize()
    if not {"difference", "raw"} <= set(found):
        scored = listed([input_name(name).lower() for name in inputs_in_order(found)] or ["none"])
        return _untested(subject, f"it compares difference images with raw ones, and scored were {scored}")
    difference, raw = found["difference"], dict(removal_by_setting(found["raw"]))
    for where, curves in removal_by_setting(difference):
        methods = [one for one in (*_RIVALS, POLY_CAM) if one in curves and one in raw.get(where, {})]
        if methods:
            pairs = {one: (curves[one], raw[where][one]) for one in methods}
            gap = compare_gain(*pairs.values(), rng=rng)
            by_setting[where] = judge_gap(gap)
            findings += _judged(where, {f"SRG, mean of {number_of(len(pairs), 'method')}, difference less raw": gap})
            for one, pair in pairs.items():
                compared = f"SRG of {method_name(one)}, difference less raw"
                findings.append(Finding(where=where, compared=compared, gap=compare_gain(pair, rng=rng)))
    if not by_setting:
        return _untested(subject, "no method was scored on both inputs under one fill")
    first, second = (
        results.scores[name, results.study.source].curves if (name, results.study.source) in results.scores else {}
        for name in ("difference", "raw")
    )
    methods = [one for one in (*_RIVALS, POLY_CAM) if one in first and one in second]
    pairs = {f"D of {method_name(one)}, difference less raw": (first[one], second[one]) for one in methods}
    voting = voting_settings(difference, *results.study.truth.values())
    return _over_fills(subject, by_setting, [*findings, *_by_thesis_score(pairs, rng=rng)], voting)


def _no_better(faithful: RemovalScores, truth: Truth | None, *, rng: np.random.Generator) -> Answer:
    findings, by_setting, subject, name = [], {}, input_name(faithful.input), method_name(GRAD_CAM)
    leads = {fill_name(*one.key[:2]): one.lead_over_controls for one in faithful.scores if one.method == GRAD_CAM}
    for where, curves in removal_by_setting(faithful):
        own = curves.get(GRAD_CAM)
        if own is None:
            continue
        nothing = mean_interval(own.srg, clusters=own.clusters, rng=rng)
        gaps: dict[str, Difference] = {"chance": nothing}
        if (lead := leads.get(where)) is not None:
            gaps[method_name(lead.control)] = lead.gap
        # not faithful is what is claimed: a gain for sure speaks against it
        by_setting[where] = _OPPOSITE.get(all_of(judge_gap(gap) for gap in gaps.values()), "undecided")
        findings += [Finding(where=where, compared=f"SRG, {name} less {one}", gap=gap) for one, gap in gaps.items()]
        most, chance = mean_at(own, _SMALL_AREA)
        compared = f"change once {percent(_SMALL_AREA)} of the image is gone, against random order"
        findings.append(Finding(where=where, compared=compared, value=f"{most:.3f} against {chance:.3f}"))
    if not by_setting:
        return _untested(subject, f"{name} was not scored")
    return _over_fills(subject, by_setting, findings, voting_settings(faithful, truth))


def _noisiest(looks: MapQuality) -> Answer:
    subject, findings, parts = input_name(looks.input), [], []
    rougher: Outcome = "undecided"
    for measure, name in _MEASURES.items():
        values = {
            method: value
            for method, found in looks.methods.items()
            if method.endswith(AS_RUN) and (value := getattr(found, measure)) is not None
        }
        own = values.pop(NOISY, None)
        if measure != "total_variation" and (own is None or not values):
            continue  # it decides nothing
        if own is None or not values:
            return _untested(subject, f"{name} of {method_name(NOISY)} and of another method are not both known")
        if measure == "total_variation":
            gaps = {
                f"{method_name(NOISY)} less {method_name(method)}": gap_from(one, NOISY)
                for method in values
                for one in looks.comparisons
                if {one.first, one.second} == {NOISY, method}
            }
            rougher = all_of(judge_gap(gap) for gap in gaps.values())
            findings += _judged(name, gaps)
        others = listed([f"{method_name(method)} {decimals(value, 3)}" for method, value in values.items()])
        parts.append(f"{name} {decimals(own, 3)} ({others})")
        if measure != "total_variation":
            compared = f"{method_name(NOISY)} against {others}"
            findings.append(Finding(where=name, compared=compared, value=decimals(own, 3), outcome="undecided"))
    return Answer(subject=subject, outcome=rougher, text=sentence(listed(parts)), findings=tuple(findings))


def _looks_at_two(truth: Truth, *, rng: np.random.Generator) -> Answer:
    share = share_of_strongest(truth.effects, count=2, rng=rng)
    two, told = judge_gap(None), "no marker changes the answer"
    if share is not None:
        # of a single trial there are no ends
        known = {name: end for name in ("estimate", "low", "high") if (end := getattr(share, name)) is not None}
        two = judge_gap(replace(share, **{name: end - 0.5 for name, end in known.items()}))
        told = f"{percent(share.estimate)} of the change of the answer ({tell_ends(share, percent)})"
    found, area = truth.methods.get(POLY_CAM), truth.areas["edges"]
    mass, gap = (None, None) if found is None else (found.mass["edges"], found.edges)
    on_edges, on_edges_told = judge_gap(gap), "No map of the thesis's Poly-CAM was held against the truth."
    if mass is not None:
        on_edges_told = (
            f"{method_name(POLY_CAM)} puts {percent(mass)} of its relevance on edges, which cover {percent(area)} of "
            "the image."
        )
    marked = Finding(
        where="each marker put back", compared="share of the two strongest markers", gap=share, outcome=two
    )
    massed = Finding(
        where="relevance mass", compared=f"on edges, less their {percent(area)} of the image", gap=gap, outcome=on_edges
    )
    return Answer(
        subject=input_name(truth.input),
        outcome=all_of((two, on_edges)),
        text=f"The two strongest of up to {len(np.unique(truth.effects.marker))} markers hold {told}. {on_edges_told}",
        findings=(marked, massed),
    )
