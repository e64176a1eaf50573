"""The claim that difference images give more faithful explanations than raw images."""

import numpy as np

from sliplens.report.study.claim import Answer, Claim, Finding, judge_gap, most_of, tell_first, tell_settings, untested
from sliplens.report.study.evidence import compare_gain, compare_mean_gain, compare_thesis_score, settings
from sliplens.report.study.scored import Faithful
from sliplens.report.style import fill_name, method_name
from sliplens.report.thesis import THESIS_POLY_CAM
from sliplens.report.workspace import Results

POLY_CAM, RIVALS = "poly-cam", ("grad-cam", "integrated-gradients")
"""What the thesis compared."""


def claim_difference(results: Results, *, rng: np.random.Generator) -> Claim:
    """Test it on the same frames, evidence lost in margin units."""
    found = results.study.faithfulness
    if not {"difference", "raw"} <= set(found):
        answers = [untested("", "the explanations of both networks are needed, and those of one are there")]
    else:
        answers = [_compare_inputs(found["difference"], found["raw"], results, rng=rng)]
    return Claim(
        id="difference",
        title="Difference images give more faithful explanations than raw images",
        test="Tested on the same frames, evidence lost in margin units: holds under a fill where the SRG averaged over "
        "the methods is larger for difference images, beyond the 95 % interval.",
        answers=tuple(answers),
    )


def _compare_inputs(difference: Faithful, raw: Faithful, results: Results, *, rng: np.random.Generator) -> Answer:
    findings, by_setting, claimed = [], {}, (*RIVALS, poly_cams(difference)[0])
    for fill, unit in settings(difference):
        methods = [one for one in claimed if (fill, unit, one) in difference.curves and (fill, unit, one) in raw.curves]
        if not methods:
            continue
        where = fill_name(fill, unit)
        pairs = {one: (difference.curves[fill, unit, one], raw.curves[fill, unit, one]) for one in methods}
        gap = compare_mean_gain(*zip(*pairs.values(), strict=True), rng=rng)
        by_setting[where] = judge_gap(gap)
        compared = f"SRG, mean of {len(pairs)} methods, difference less raw"
        findings.append(Finding(where=where, compared=compared, gap=gap, outcome=by_setting[where]))
        findings += [
            Finding(
                where=where,
                compared=f"SRG of {method_name(one)}, difference less raw",
                gap=compare_gain(*pair, rng=rng),
            )
            for one, pair in pairs.items()
        ]
    if not by_setting:
        return untested("", "no method was scored on both inputs under one fill")
    findings += _thesis_score_of_inputs(results, rng=rng)
    return Answer(
        subject="Both networks",
        outcome=most_of(list(by_setting.values())),
        text=f"{tell_settings(by_setting)} {tell_first(findings)}",
        findings=tuple(findings),
    )


def _thesis_score_of_inputs(results: Results, *, rng: np.random.Generator) -> list[Finding]:
    scored = {name: one for (name, source), one in results.scores.items() if source == results.study.source}
    if not {"difference", "raw"} <= set(scored):
        return []
    trials, first, second = scored_trials(results, "difference"), scored["difference"].curves, scored["raw"].curves
    return [
        Finding(
            where="score of the thesis",
            compared=f"D of {method_name(one)}, difference less raw (below zero = more faithful)",
            gap=compare_thesis_score(first[one], second[one], trials, rng=rng),
        )
        for one in (*RIVALS, THESIS_POLY_CAM, POLY_CAM)
        if one in first and one in second
    ]


def poly_cams(faithful: Faithful) -> list[str]:
    """Poly-CAM as in the thesis, and ours: the claim is of the first, and the second is what is used now."""
    scored = {method for _, _, method in faithful.curves}
    return [one for one in (THESIS_POLY_CAM, POLY_CAM) if one in scored] or [POLY_CAM]


def scored_trials(results: Results, name: str) -> dict[str, str]:
    """Trial of each scored frame of an input."""
    faithful = results.study.faithfulness.get(name)
    if faithful is not None:
        return {
            frame: str(trial)
            for curve in faithful.curves.values()
            for frame, trial in zip(curve.frame_ids, curve.trials, strict=True)
        }
    choice = results.study.choice
    return {} if choice is None else {frame.id: frame.trial for frame in choice.frames if frame.scored}
