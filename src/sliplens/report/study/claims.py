"""The claims of the thesis, each tested on this data.

References
----------
Polak, *Explainable Neural Networks for Incipient Slip Sensing in Robot Tactile Learning*, sections 5.2 to 5.4 and 6.
"""

import numpy as np

from sliplens.report.study.claim import (
    Answer,
    Claim,
    Finding,
    all_of,
    judge_gap,
    most_of,
    tell_first,
    tell_settings,
    untested,
)
from sliplens.report.study.evidence import (
    best_control,
    compare_gain,
    compare_thesis_score,
    gain_over_chance,
    mean_at,
    settings,
)
from sliplens.report.study.input_claim import RIVALS, claim_difference, poly_cams, scored_trials
from sliplens.report.study.looked_claims import claim_edges, claim_noisy
from sliplens.report.study.scored import Faithful
from sliplens.report.style import fill_name, input_name, inputs_in_order, method_name, percent
from sliplens.report.workspace import Results

GRAD_CAM = "grad-cam"
_SMALL_AREA = 0.05


def judge_claims(results: Results, *, rng: np.random.Generator) -> tuple[Claim, ...]:
    """Test every claim; where the results it needs are not there, it stays undecided and says why."""
    return (
        _claim_poly_cam(results, rng=rng),
        claim_difference(results, rng=rng),
        _claim_grad_cam(results, rng=rng),
        claim_noisy(results),
        claim_edges(results, rng=rng),
    )


def _claim_poly_cam(results: Results, *, rng: np.random.Generator) -> Claim:
    answers = []
    for name in _inputs(results):
        faithful = results.study.faithfulness.get(name)
        if faithful is None:
            answers.append(untested(name))
            continue
        claimants = poly_cams(faithful)
        answers += [_best_of(faithful, one, claimants, results, rng=rng) for one in claimants]
    return Claim(
        id="most-faithful",
        title="Poly-CAM is the most faithful of the three methods",
        test="Tested by the symmetric relevance gain (SRG): holds under a fill where Poly-CAM's is larger than both "
        "others' and the 95 % interval of each difference leaves zero out.",
        answers=tuple(answers),
    )


def _best_of(
    faithful: Faithful, method: str, claimants: list[str], results: Results, *, rng: np.random.Generator
) -> Answer:
    rivals = list(RIVALS)
    findings, by_setting = [], {}
    for fill, unit in settings(faithful):
        own = faithful.curves.get((fill, unit, method))
        others = [one for one in rivals if (fill, unit, one) in faithful.curves]
        if own is None or not others:
            continue
        gaps = {one: compare_gain(own, faithful.curves[fill, unit, one], rng=rng) for one in others}
        where = fill_name(fill, unit)
        by_setting[where] = all_of(judge_gap(gap) for gap in gaps.values())
        findings += [
            Finding(
                where=where,
                compared=f"SRG, {method_name(method)} less {method_name(one)}",
                gap=gap,
                outcome=judge_gap(gap),
            )
            for one, gap in gaps.items()
        ]
    if not by_setting:
        return untested(faithful.input, f"{method_name(method)} and another method were not scored together")
    findings += _thesis_score_findings(results, faithful.input, method, rivals, rng=rng)
    named = f", {method_name(method)}" if len(claimants) > 1 else ""
    return Answer(
        subject=f"{input_name(faithful.input)}{named}",
        outcome=most_of(list(by_setting.values())),
        text=f"{tell_settings(by_setting)} {tell_first(findings)}",
        findings=tuple(findings),
    )


def _thesis_score_findings(
    results: Results, name: str, method: str, rivals: list[str], *, rng: np.random.Generator
) -> list[Finding]:
    scored = next((one for (own, _), one in results.scores.items() if own == name), None)
    if scored is None or method not in scored.curves:
        return []
    trials = scored_trials(results, name)
    return [
        Finding(
            where="score of the thesis",
            compared=f"D, {method_name(method)} less {method_name(one)} (below zero = more faithful)",
            gap=compare_thesis_score(scored.curves[method], scored.curves[one], trials, rng=rng),
        )
        for one in rivals
        if one in scored.curves
    ]


def _claim_grad_cam(results: Results, *, rng: np.random.Generator) -> Claim:
    answers = []
    for name in _inputs(results):
        faithful = results.study.faithfulness.get(name)
        answers.append(untested(name) if faithful is None else _no_better(faithful, GRAD_CAM, rng=rng))
    return Claim(
        id="grad-cam",
        title="Grad-CAM is not faithful",
        test="Tested against maps that know nothing of the network: holds under a fill where Grad-CAM's SRG lies below "
        "chance or below the best control for sure; does not hold where it lies above both for sure.",
        answers=tuple(answers),
    )


def _no_better(faithful: Faithful, method: str, *, rng: np.random.Generator) -> Answer:
    findings, by_setting = [], {}
    for fill, unit in settings(faithful):
        own = faithful.curves.get((fill, unit, method))
        if own is None:
            continue
        where, control = fill_name(fill, unit), best_control(faithful, fill, unit)
        gaps = {"chance": gain_over_chance(own, rng=rng)}
        if control is not None:
            gap = compare_gain(own, faithful.curves[fill, unit, control], rng=rng)
            gaps |= {} if gap is None else {method_name(control): gap}
        # not faithful is what is claimed: a gain for sure speaks against it
        better = all_of(judge_gap(gap) for gap in gaps.values())
        by_setting[where] = {"holds": "does not hold", "does not hold": "holds"}.get(better, "undecided")
        findings += [
            Finding(where=where, compared=f"SRG, {method_name(method)} less {rival}", gap=gap)
            for rival, gap in gaps.items()
        ]
        most, chance = mean_at(own, _SMALL_AREA)
        findings.append(
            Finding(
                where=where,
                compared=f"change once {percent(_SMALL_AREA)} of the image is gone, against random order",
                value=f"{most:.3f} against {chance:.3f}",
            )
        )
    if not by_setting:
        return untested(faithful.input, f"{method_name(method)} was not scored")
    return Answer(
        subject=input_name(faithful.input),
        outcome=most_of(list(by_setting.values())),
        text=f"{tell_settings(by_setting)} {tell_first(findings)}",
        findings=tuple(findings),
    )


def _inputs(results: Results) -> list[str]:
    return inputs_in_order(results.study.inputs)[::-1]
