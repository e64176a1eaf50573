"""The claims of the thesis, each tested on this data.

References
----------
Polak, *Explainable Neural Networks for Incipient Slip Sensing in Robot Tactile Learning*, sections 5.2 to 5.4 and 6.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

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
    settings,
    share_of_strongest,
    voting_settings,
    write_ends,
)
from sliplens.report.results import Results
from sliplens.report.verdict import OPPOSITE, Finding, Outcome, Row, Verdict, all_of, judge_gap, most_of
from sliplens.results.faithfulness import RemovalCurve

POLY_CAM, GRAD_CAM, NOISY = (f"{method}{AS_RUN}" for method in ("poly-cam", "grad-cam", "integrated-gradients"))
"""Methods as the thesis ran them: its claims are of these alone."""
_RIVALS = (GRAD_CAM, NOISY)
_UNSCORED = "its explanations were not scored; `sliplens study` does that"
_Gaps = Mapping[str, Difference | None]


@dataclass(frozen=True, kw_only=True)
class Claim:
    """Claim of the thesis and how it is tested."""

    id: str
    title: str
    test: str
    judge: Callable[[Results, str, np.random.Generator], Row]
    """Judge the claim on the network of an input."""
    of_pair: bool = False
    """True where it compares both networks and is judged once."""


def judge_claims(results: Results, *, rng: np.random.Generator) -> tuple[Verdict, ...]:
    """Test every claim of the thesis; it stays undecided and says why where results are missing."""
    names = inputs_in_order(results.study.inputs)[::-1]
    return tuple(
        Verdict(
            id=claim.id,
            title=claim.title,
            test=claim.test,
            rows=tuple(
                replace(claim.judge(results, name, rng), claim=claim.title)
                for name in (names[:1] if claim.of_pair else names)
            ),
        )
        for claim in CLAIMS
    )


def _untested(subject: str, why: str, findings: Sequence[Finding] = ()) -> Row:
    sentence = f"Not tested: {why}."
    return Row(claim="", subject=subject, outcome="undecided", sentence=sentence, findings=tuple(findings))


def _judged(where: str, gaps: _Gaps) -> list[Finding]:
    return [Finding(where=where, compared=name, gap=gap, outcome=judge_gap(gap)) for name, gap in gaps.items()]


def _vote(
    subject: str, gaps: Mapping[tuple[str, str], _Gaps], voting: Sequence[tuple[str, str]], *, below: bool = False
) -> Row:
    """Decide by most of the fills that vote: a claim holds under one where all gaps lie above zero, or `below` it."""
    votes: dict[str, Outcome] = {}
    findings: list[Finding] = []
    for setting, compared in gaps.items():
        where, judged = fill_name(*setting), _judged(fill_name(*setting), compared)
        outcome = all_of(finding.outcome or "undecided" for finding in judged)
        if setting in voting:
            votes[where] = OPPOSITE.get(outcome, "undecided") if below else outcome
        else:
            judged = [replace(finding, outcome=None) for finding in judged]
        if below:
            judged = [replace(row, outcome=row.outcome and OPPOSITE.get(row.outcome, "undecided")) for row in judged]
        findings += judged
    if not votes:
        why = "under no fill that was scored does a map made from the truth win for sure"
        return _untested(subject, why, findings)
    groups = {kind: [name for name, vote in votes.items() if vote == kind] for kind in (*OPPOSITE, "undecided")}
    sentence = "; ".join(f"{outcome} under {listed(names)}" for outcome, names in groups.items() if names)
    first = next(finding for finding in findings if finding.where in votes)
    return Row(
        claim="",
        subject=subject,
        outcome=most_of(list(votes.values())),
        sentence=f"{sentence[:1].upper()}{sentence[1:]}. Number: {first.compared}, {first.where}.",
        number="" if first.gap is None else signed(first.gap.estimate, 3),
        interval=write_ends(first.gap),
        findings=tuple(findings),
    )


def _curves(results: Results, name: str) -> Iterator[tuple[tuple[str, str], dict[str, RemovalCurve]]]:
    """Settings of an input with their curves by method, in the order they are read."""
    if (faithful := results.study.faithfulness.get(name)) is not None:
        for setting in settings(faithful):
            yield setting, {key[2]: curve for key, curve in faithful.curves.items() if key[:2] == setting}


def _most_faithful(results: Results, name: str, rng: np.random.Generator) -> Row:
    if name not in results.study.faithfulness:
        return _untested(input_name(name), _UNSCORED)
    gaps = {
        setting: {
            f"SRG, {method_name(POLY_CAM)} less {method_name(rival)}": compare_gain(
                (curves[POLY_CAM], curves[rival]), rng=rng
            )
            for rival in _RIVALS
        }
        for setting, curves in _curves(results, name)
        if {POLY_CAM, *_RIVALS} <= set(curves)
    }
    if not gaps:
        return _untested(input_name(name), "the thesis's three methods, as it ran them, were not scored together")
    voting = voting_settings(results.study.faithfulness[name], results.study.truth.get(name))
    return _vote(input_name(name), gaps, voting)


def _compare_inputs(results: Results, _: str, rng: np.random.Generator) -> Row:
    study = results.study
    names = [name for name in ("difference", "raw") if name in study.inputs] or inputs_in_order(study.inputs)
    subject = listed([input_name(name).lower() for name in names]).capitalize()
    if not {"difference", "raw"} <= set(study.faithfulness):
        scored = listed([input_name(name).lower() for name in inputs_in_order(study.faithfulness)] or ["none"])
        return _untested(subject, f"it compares difference images with raw ones, and scored were {scored}")
    raw, gaps = dict(_curves(results, "raw")), {}
    for setting, curves in _curves(results, "difference"):
        others = raw.get(setting, {})
        pairs = [(curves[key], others[key]) for key in (*_RIVALS, POLY_CAM) if key in curves and key in others]
        if pairs:
            compared = f"SRG, mean of {number_of(len(pairs), 'method')}, difference less raw"
            gaps[setting] = {compared: compare_gain(*pairs, rng=rng)}
    if not gaps:
        return _untested(subject, "no method was scored on both inputs under one fill")
    return _vote(subject, gaps, voting_settings(study.faithfulness["difference"], *study.truth.values()))


def _unfaithful(results: Results, name: str, rng: np.random.Generator) -> Row:
    faithful, method = results.study.faithfulness.get(name), method_name(GRAD_CAM)
    if faithful is None:
        return _untested(input_name(name), _UNSCORED)
    leads = {score.key[:2]: score.lead_over_controls for score in faithful.scores if score.method == GRAD_CAM}
    gaps = {}
    for setting, curves in _curves(results, name):
        if (curve := curves.get(GRAD_CAM)) is not None:
            assert curve.clusters is not None  # of a saved table
            chance = mean_interval(curve.symmetric_gain, clusters=curve.clusters, rng=rng)
            gaps[setting] = {f"SRG, {method} less chance": chance}
            if (lead := leads.get(setting)) is not None:
                gaps[setting][f"SRG, {method} less {method_name(lead.control)}"] = lead.gap
    if not gaps:
        return _untested(input_name(name), f"{method} was not scored")
    voting = voting_settings(faithful, results.study.truth.get(name))
    # a gain for sure speaks against the claim
    return _vote(input_name(name), gaps, voting, below=True)


def _noisiest(results: Results, name: str, _: np.random.Generator) -> Row:
    quality, subject, title = results.study.map_quality.get(name), input_name(name), method_name(NOISY)
    if quality is None:
        return _untested(subject, "the looks of the maps were not measured; `sliplens study` does that")
    variation = {
        method: measures.total_variation
        for method, measures in quality.methods.items()
        if method.endswith(AS_RUN) and measures.total_variation is not None
    }
    rivals = [method for method in variation if method != NOISY]
    if NOISY not in variation or not rivals:
        return _untested(subject, f"total variation of {title} and of another method are not both known")
    gaps: dict[str, Difference] = {}
    for pair in quality.comparisons:
        rival, sign = (pair.second, 1) if pair.first == NOISY else (pair.first, -1)
        if {pair.first, pair.second} == {NOISY, rival} and rival in rivals:
            ends = [None if end is None else sign * end for end in (pair.gap.low, pair.gap.high)][::sign]
            turned = replace(pair.gap, estimate=sign * pair.gap.estimate, low=ends[0], high=ends[1])
            gaps[f"{title} less {method_name(rival)}"] = turned
    others = listed([f"{method_name(method)} {decimals(variation[method], 3)}" for method in rivals])
    return Row(
        claim="",
        subject=subject,
        outcome=all_of(judge_gap(gap) for gap in gaps.values()),
        sentence=f"Total variation of its maps, against {others}.",
        number=decimals(variation[NOISY], 3),
        findings=tuple(_judged("total variation", gaps)),
    )


def _looks_at_two(results: Results, name: str, rng: np.random.Generator) -> Row:
    truth = results.study.truth.get(name)
    if truth is None:
        why = "only simulated touch tells what each marker does, and no such result is here"
        return _untested(input_name(name), why)
    share, above_half = share_of_strongest(truth.effects, count=2, rng=rng), None
    if share is not None:
        # of a single trial there are no ends
        ends = {key: end for key in ("estimate", "low", "high") if (end := getattr(share, key)) is not None}
        above_half = replace(share, **{key: end - 0.5 for key, end in ends.items()})
    method, area = truth.methods.get(POLY_CAM), percent(truth.areas["edges"])
    on_edges = f"no map of {method_name(POLY_CAM)} was compared with the truth"
    if method is not None:
        mass = percent(method.mass["edges"])
        on_edges = f"{method_name(POLY_CAM)} puts {mass} of its relevance on edges, which cover {area} of the image"
    edges = None if method is None else method.edges
    outcomes = judge_gap(above_half), judge_gap(edges)
    compared = "share of the two strongest markers", f"on edges, less their {area} of the image"
    return Row(
        claim="",
        subject=input_name(name),
        outcome=all_of(outcomes),
        sentence="Share of the change that the two strongest of up to "
        f"{len(np.unique(truth.effects.marker))} markers hold; {on_edges}.",
        number="" if share is None else percent(share.estimate),
        interval="" if share is None else tell_ends(share, percent),
        findings=(
            Finding(where="each marker put back", compared=compared[0], gap=share, outcome=outcomes[0]),
            Finding(where="relevance mass", compared=compared[1], gap=edges, outcome=outcomes[1]),
        ),
    )


CLAIMS = (
    Claim(
        id="most-faithful",
        title="Poly-CAM is the most faithful of the three methods",
        test="Tested by the symmetric relevance gain (SRG): holds under a fill where Poly-CAM's is larger than "
        "both others' and the 95 % interval of each difference leaves zero out.",
        judge=_most_faithful,
    ),
    Claim(
        id="difference",
        title="Difference images give more faithful explanations than raw images",
        test="Tested on the same frames, evidence lost in margin units: holds under a fill where the SRG averaged "
        "over the methods is larger for difference images, beyond the 95 % interval.",
        judge=_compare_inputs,
        of_pair=True,
    ),
    Claim(
        id="grad-cam",
        title="Grad-CAM is not faithful",
        test="Tested against maps that know nothing of the network: holds under a fill where Grad-CAM's SRG lies "
        "below chance or below the best control for sure; does not hold where it lies above both for sure.",
        judge=_unfaithful,
    ),
    Claim(
        id="noisy",
        title="Integrated Gradients is noisy",
        test="Tested by numbers: holds where its maps have a larger total variation than those of the other "
        "two, beyond the 95 % interval.",
        judge=_noisiest,
    ),
    Claim(
        id="two-markers",
        title="The network looks at the edges of two markers",
        test="Tested on simulated touch in two parts, both needed: putting back a marker at a time, the strongest "
        "two hold more than half of all change of the prediction; and Poly-CAM's relevance lies on marker edges "
        "more than their share of the image.",
        judge=_looks_at_two,
    ),
)
"""Claims in the order of the page."""
