"""The claims of the thesis, each tested on this data.

References
----------
Polak, *Explainable Neural Networks for Incipient Slip Sensing in Robot Tactile Learning*, sections 5.2 to 5.4 and 6.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TypeVar

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
    signed,
    tell_ends,
)
from sliplens.progress import number_of
from sliplens.report.comparisons import (
    AS_RUN,
    compare_gain,
    gap_from,
    removal_by_setting,
    share_of_strongest,
    voting_settings,
)
from sliplens.report.results import Results
from sliplens.report.verdict import OPPOSITE, Finding, Outcome, Row, Verdict, all_of, judge_gap, most_of, write_ends
from sliplens.results.faithfulness import Faithfulness
from sliplens.results.study import MapQuality, Truth

Record = TypeVar("Record")
POLY_CAM, GRAD_CAM, NOISY = (f"{method}{AS_RUN}" for method in ("poly-cam", "grad-cam", "integrated-gradients"))
"""Methods as the thesis ran them: its claims are of these alone."""
_RIVALS = (GRAD_CAM, NOISY)


def judge_claims(results: Results, *, rng: np.random.Generator) -> tuple[Verdict, ...]:
    """Test every claim of the thesis; it stays undecided and says why where results are missing."""
    study = results.study
    unscored = "its explanations were not scored; `sliplens study` does that"
    unmeasured = "the looks of the maps were not measured; `sliplens study` does that"
    unknown = "only simulated touch tells what each marker does, and no such result is here"
    claims: list[tuple[str, str, str, list[Row]]] = [
        (
            "most-faithful",
            "Poly-CAM is the most faithful of the three methods",
            "Tested by the symmetric relevance gain (SRG): holds under a fill where Poly-CAM's is larger than "
            "both others' and the 95 % interval of each difference leaves zero out.",
            _each(results, study.faithfulness, partial(_beats_rivals, results=results, rng=rng), why=unscored),
        ),
        (
            "difference",
            "Difference images give more faithful explanations than raw images",
            "Tested on the same frames, evidence lost in margin units: holds under a fill where the SRG averaged "
            "over the methods is larger for difference images, beyond the 95 % interval.",
            [_compare_inputs(results, rng=rng)],
        ),
        (
            "grad-cam",
            "Grad-CAM is not faithful",
            "Tested against maps that know nothing of the network: holds under a fill where Grad-CAM's SRG lies "
            "below chance or below the best control for sure; does not hold where it lies above both for sure.",
            _each(results, study.faithfulness, partial(_no_better, results=results, rng=rng), why=unscored),
        ),
        (
            "noisy",
            "Integrated Gradients is noisy",
            "Tested by numbers: holds where its maps have a larger total variation than those of the other "
            "two, beyond the 95 % interval.",
            _each(results, study.map_quality, _noisiest, why=unmeasured),
        ),
        (
            "two-markers",
            "The network looks at the edges of two markers",
            "Tested on simulated touch in two parts, both needed: putting back a marker at a time, the strongest "
            "two hold more than half of all change of the prediction; and Poly-CAM's relevance lies on marker edges "
            "more than their share of the image.",
            _each(results, study.truth, partial(_looks_at_two, rng=rng), why=unknown),
        ),
    ]
    return tuple(
        Verdict(id=key, title=title, test=test, rows=tuple(replace(row, claim=title) for row in rows))
        for key, title, test, rows in claims
    )


def _each(results: Results, records: Mapping[str, Record], judge: Callable[[Record], Row], *, why: str) -> list[Row]:
    """Judge each network; one without a record stays undecided."""
    names = inputs_in_order(results.study.inputs)[::-1]
    return [judge(records[name]) if name in records else _untested(input_name(name), why) for name in names]


def _untested(subject: str, why: str, findings: Iterable[Finding] = ()) -> Row:
    sentence = f"Not tested: {why}."
    return Row(claim="", subject=subject, outcome="undecided", sentence=sentence, findings=tuple(findings))


def _decide(
    subject: str,
    by_setting: Mapping[str, Outcome],
    findings: Iterable[Finding],
    voting: Sequence[tuple[str, str]],
) -> Row:
    """Decide by most of the fills that vote; the number is that of the first."""
    votes: dict[str, Outcome] = {
        name: by_setting[name] for name in (fill_name(*setting) for setting in voting) if name in by_setting
    }
    findings = [replace(finding, outcome=finding.outcome if finding.where in votes else None) for finding in findings]
    if not votes:
        why = "under no fill that was scored does a map made from the truth win for sure"
        return _untested(subject, why, findings)
    by_outcome = {
        outcome: [name for name, vote in votes.items() if vote == outcome] for outcome in (*OPPOSITE, "undecided")
    }
    parts = [f"{outcome} under {listed(names)}" for outcome, names in by_outcome.items() if names]
    first = next(finding for finding in findings if finding.where in votes)
    sentence = "; ".join(parts)
    return Row(
        claim="",
        subject=subject,
        outcome=most_of(list(votes.values())),
        sentence=f"{sentence[:1].upper()}{sentence[1:]}. Number: {first.compared}, {first.where}.",
        number="" if first.gap is None else signed(first.gap.estimate, 3),
        interval=write_ends(first.gap),
        findings=tuple(findings),
    )


def _judged(where: str, gaps: Mapping[str, Difference | None]) -> list[Finding]:
    return [Finding(where=where, compared=name, gap=gap, outcome=judge_gap(gap)) for name, gap in gaps.items()]


def _beats_rivals(faithful: Faithfulness, *, results: Results, rng: np.random.Generator) -> Row:
    findings, subject, name = [], input_name(faithful.input), method_name(POLY_CAM)
    by_setting: dict[str, Outcome] = {}
    for where, curves in removal_by_setting(faithful):
        if {POLY_CAM, *_RIVALS} <= set(curves):
            gaps = {rival: compare_gain((curves[POLY_CAM], curves[rival]), rng=rng) for rival in _RIVALS}
            by_setting[where] = all_of(judge_gap(gap) for gap in gaps.values())
            findings += _judged(where, {f"SRG, {name} less {method_name(rival)}": gap for rival, gap in gaps.items()})
    if not by_setting:
        return _untested(subject, "the thesis's three methods, as it ran them, were not scored together")
    return _decide(subject, by_setting, findings, voting_settings(faithful, results.study.truth.get(faithful.input)))


def _compare_inputs(results: Results, *, rng: np.random.Generator) -> Row:
    findings, by_setting, records = [], {}, results.study.faithfulness
    studied = results.study.inputs
    names = [name for name in ("difference", "raw") if name in studied] or inputs_in_order(studied)
    subject = listed([input_name(name).lower() for name in names]).capitalize()
    if not {"difference", "raw"} <= set(records):
        scored = listed([input_name(name).lower() for name in inputs_in_order(records)] or ["none"])
        return _untested(subject, f"it compares difference images with raw ones, and scored were {scored}")
    difference, raw = records["difference"], dict(removal_by_setting(records["raw"]))
    for where, curves in removal_by_setting(difference):
        pairs = {
            method: (curves[method], raw[where][method])
            for method in (*_RIVALS, POLY_CAM)
            if method in curves and method in raw.get(where, {})
        }
        if pairs:
            gap = compare_gain(*pairs.values(), rng=rng)
            by_setting[where] = judge_gap(gap)
            findings += _judged(where, {f"SRG, mean of {number_of(len(pairs), 'method')}, difference less raw": gap})
    if not by_setting:
        return _untested(subject, "no method was scored on both inputs under one fill")
    return _decide(subject, by_setting, findings, voting_settings(difference, *results.study.truth.values()))


def _no_better(faithful: Faithfulness, *, results: Results, rng: np.random.Generator) -> Row:
    findings, by_setting, subject, name = [], {}, input_name(faithful.input), method_name(GRAD_CAM)
    leads = {
        fill_name(*score.key[:2]): score.lead_over_controls for score in faithful.scores if score.method == GRAD_CAM
    }
    for where, curves in removal_by_setting(faithful):
        curve = curves.get(GRAD_CAM)
        if curve is None:
            continue
        assert curve.clusters is not None  # of a saved table
        gaps = {"chance": mean_interval(curve.symmetric_gain, clusters=curve.clusters, rng=rng)}
        if (lead := leads.get(where)) is not None:
            gaps[method_name(lead.control)] = lead.gap
        # not faithful is what is claimed: a gain for sure speaks against it
        by_setting[where] = OPPOSITE.get(all_of(judge_gap(gap) for gap in gaps.values()), "undecided")
        findings += [Finding(where=where, compared=f"SRG, {name} less {other}", gap=gap) for other, gap in gaps.items()]
    if not by_setting:
        return _untested(subject, f"{name} was not scored")
    voting = voting_settings(faithful, results.study.truth.get(faithful.input))
    return _decide(subject, by_setting, findings, voting)


def _noisiest(looks: MapQuality) -> Row:
    subject, name = input_name(looks.input), method_name(NOISY)
    rivals = [method for method in looks.methods if method.endswith(AS_RUN) and method != NOISY]
    methods = [method for method in (*rivals, NOISY) if method in looks.methods]
    variation = {method: looks.methods[method].total_variation for method in methods}
    rivals = [method for method in rivals if variation[method] is not None]
    if variation.get(NOISY) is None or not rivals:
        return _untested(subject, f"total variation of {name} and of another method are not both known")
    gaps = {
        f"{name} less {method_name(method)}": gap_from(pair, NOISY)
        for method in rivals
        for pair in looks.comparisons
        if {pair.first, pair.second} == {NOISY, method}
    }
    findings = _judged("total variation", gaps)
    others = listed([f"{method_name(method)} {decimals(variation[method], 3)}" for method in rivals])
    return Row(
        claim="",
        subject=subject,
        outcome=all_of(judge_gap(gap) for gap in gaps.values()),
        sentence=f"Total variation of its maps, against {others}.",
        number=decimals(variation[NOISY], 3),
        findings=tuple(findings),
    )


def _looks_at_two(truth: Truth, *, rng: np.random.Generator) -> Row:
    share = share_of_strongest(truth.effects, count=2, rng=rng)
    above_half = None
    if share is not None:
        # of a single trial there are no ends
        ends = {name: end for name in ("estimate", "low", "high") if (end := getattr(share, name)) is not None}
        above_half = replace(share, **{name: end - 0.5 for name, end in ends.items()})
    method, area = truth.methods.get(POLY_CAM), truth.areas["edges"]
    mass, gap = (None, None) if method is None else (method.mass["edges"], method.edges)
    name, count = method_name(POLY_CAM), len(np.unique(truth.effects.marker))
    on_edges = f"{name} puts {percent(mass)} of its relevance on edges, which cover {percent(area)} of the image"
    if mass is None:
        on_edges = f"no map of {name} was compared with the truth"
    outcomes = judge_gap(above_half), judge_gap(gap)
    where, compared = "each marker put back", "share of the two strongest markers"
    massed = f"on edges, less their {percent(area)} of the image"
    return Row(
        claim="",
        subject=input_name(truth.input),
        outcome=all_of(outcomes),
        sentence=f"Share of the change that the two strongest of up to {count} markers hold; {on_edges}.",
        number="" if share is None else percent(share.estimate),
        interval="" if share is None else tell_ends(share, percent),
        findings=(
            Finding(where=where, compared=compared, gap=share, outcome=outcomes[0]),
            Finding(where="relevance mass", compared=massed, gap=gap, outcome=outcomes[1]),
        ),
    )
