"""The claims of the thesis, each tested on this data.

References
----------
Polak, *Explainable Neural Networks for Incipient Slip Sensing in Robot Tactile Learning*, sections 5.2 to 5.4 and 6.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, TypeVar

import numpy as np

from sliplens.intervals import Difference
from sliplens.plots.style import (
    CONTROLS,
    decimals,
    fill_name,
    input_name,
    inputs_in_order,
    listed,
    method_name,
    percent,
)
from sliplens.report.comparisons import (
    best_control,
    compare_gain,
    compare_mean_gain,
    compare_thesis_score,
    gain_over_chance,
    mean_at,
    reversed_gap,
    settings,
    share_of_strongest,
    tell_interval,
)
from sliplens.report.results import Results
from sliplens.report.thesis import THESIS_POLY_CAM
from sliplens.results.faithfulness import DeletionCurve, RemovalScores
from sliplens.results.study import MapQuality, Truth

Outcome = Literal["holds", "does not hold", "undecided"]
Record = TypeVar("Record")
_UNSCORED = "its explanations were not scored; `sliplens study` does that"
OUTCOMES: tuple[Outcome, ...] = ("holds", "does not hold", "undecided")


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
    """What one network, or both together, say of a claim."""

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
    opposites: dict[Outcome, Outcome] = {"holds": "does not hold", "does not hold": "holds"}
    for outcome, opposite in opposites.items():
        if 2 * outcomes.count(outcome) > len(outcomes) and opposite not in outcomes:
            return outcome
    return "undecided"


def tell_settings(by_setting: dict[str, Outcome]) -> str:
    """Say under which settings a claim holds, does not, or stays open."""
    names = {found: [name for name, own in by_setting.items() if own == found] for found in OUTCOMES}
    return _sentence("; ".join(f"{outcome} under {listed(where)}" for outcome, where in names.items() if where))


def tell_first(findings: list[Finding]) -> str:
    """Write the intervals of the first setting."""
    told = [one for one in findings if one.gap is not None and one.where == findings[0].where]
    parts = [f"{one.compared}: {tell_interval(one.gap)}" for one in told if one.gap is not None]
    return f"Under {findings[0].where}, {'; '.join(parts)}." if parts else ""


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."


def _over_settings(subject: str, by_setting: dict[str, Outcome], findings: list[Finding]) -> Answer:
    """Answer by what holds under most settings."""
    text = f"{tell_settings(by_setting)} {tell_first(findings)}"
    outcome = most_of(list(by_setting.values()))
    return Answer(subject=subject, outcome=outcome, text=text, findings=tuple(findings))


def untested(name: str, why: str) -> Answer:
    """Answer that stays open, and why; the name is that of an input, or empty for both networks."""
    subject = input_name(name) if name else "Both networks"
    return Answer(subject=subject, outcome="undecided", text=f"Not tested: {why}.")


POLY_CAM, RIVALS = "poly-cam", ("grad-cam", "integrated-gradients")
"""What the thesis compared."""


def claim_difference(results: Results, *, rng: np.random.Generator) -> Claim:
    """Test it on the same frames, evidence lost in margin units."""
    found = results.study.faithfulness
    if not {"difference", "raw"} <= set(found):
        answer = untested("", "the explanations of both networks are needed, and those of one are there")
    else:
        answer = _compare_inputs(found["difference"], found["raw"], results, rng=rng)
    return Claim(
        id="difference",
        title="Difference images give more faithful explanations than raw images",
        test="Tested on the same frames, evidence lost in margin units: holds under a fill where the SRG averaged over "
        "the methods is larger for difference images, beyond the 95 % interval.",
        answers=(answer,),
    )


def _compare_inputs(
    difference: RemovalScores, raw: RemovalScores, results: Results, *, rng: np.random.Generator
) -> Answer:
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
        for one, pair in pairs.items():
            compared = f"SRG of {method_name(one)}, difference less raw"
            findings.append(Finding(where=where, compared=compared, gap=compare_gain(*pair, rng=rng)))
    if not by_setting:
        return untested("", "no method was scored on both inputs under one fill")
    findings += _thesis_score_of_inputs(results, rng=rng)
    return _over_settings("Both networks", by_setting, findings)


def _thesis_score_of_inputs(results: Results, *, rng: np.random.Generator) -> list[Finding]:
    scored = {name: one for (name, source), one in results.scores.items() if source == results.study.source}
    if not {"difference", "raw"} <= set(scored):
        return []
    first, second = scored["difference"].curves, scored["raw"].curves
    pairs = {
        f"D of {method_name(one)}, difference less raw": (first[one], second[one])
        for one in (*RIVALS, THESIS_POLY_CAM, POLY_CAM)
        if one in first and one in second
    }
    return _by_thesis_score(pairs, scored_trials(results, "difference"), rng=rng)


def _by_thesis_score(
    pairs: dict[str, tuple[DeletionCurve, DeletionCurve]], trials: dict[str, str], *, rng: np.random.Generator
) -> list[Finding]:
    return [
        Finding(
            where="score of the thesis",
            compared=f"{compared} (below zero = more faithful)",
            gap=compare_thesis_score(*pair, trials, rng=rng),
        )
        for compared, pair in pairs.items()
    ]


def poly_cams(faithful: RemovalScores) -> list[str]:
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


_NOISY = "integrated-gradients"
_MEASURES = {"total_variation": 1, "noise_stability": -1}  # sign: noisier is more of it, or less
_MEASURE_NAMES = {"total_variation": "total variation", "noise_stability": "stability under sensor noise"}
_LOOKERS = ("poly-cam", THESIS_POLY_CAM)  # the finer of the two first: edges are finer than its coarse map
_TWO = 2


def claim_noisy(results: Results) -> Claim:
    """Integrated Gradients is noisy: rougher than the other methods, and less stable under sensor noise."""
    unmeasured = "the looks of the maps were not measured; `sliplens study` does that"
    return Claim(
        id="noisy",
        title="Integrated Gradients is noisy",
        test="Tested by numbers: holds where its maps have a larger total variation than those of every other method, "
        "beyond the 95 % interval, and are the least stable under sensor noise (means over few frames, no interval).",
        answers=_of_each(results, results.study.map_quality, lambda looks: [_noisiest(looks)], why=unmeasured),
    )


def _noisiest(looks: MapQuality) -> Answer:
    subject = input_name(looks.input)
    findings, outcomes, parts = [], [], []
    for measure, sign in _MEASURES.items():
        values = {
            name: value
            for name, found in looks.methods.items()
            if name not in CONTROLS and (value := getattr(found, measure)) is not None
        }
        own = values.pop(_NOISY, None)
        if own is None or not values:
            return Answer(subject=subject, outcome="undecided", text=f"Not tested: {_MEASURE_NAMES[measure]} of "
                          f"{method_name(_NOISY)} and of another method are not both known.")  # fmt: skip
        noisier = [name for name, value in values.items() if sign * own > sign * value]
        outcome: Outcome = "holds" if len(noisier) == len(values) else "undecided" if noisier else "does not hold"
        gaps = _rougher(looks, values) if measure == "total_variation" else {}
        if gaps:
            outcome = all_of(judge_gap(gap) for gap in gaps.values())
            named = {f"{method_name(_NOISY)} less {method_name(name)}": gap for name, gap in gaps.items()}
            findings += _judged(_MEASURE_NAMES[measure], named)
        outcomes.append(outcome)
        others = listed([f"{method_name(name)} {decimals(value, 3)}" for name, value in values.items()])
        parts.append(f"{_MEASURE_NAMES[measure]} {decimals(own, 3)} ({others})")
        findings.append(
            Finding(
                where=_MEASURE_NAMES[measure],
                compared=f"{method_name(_NOISY)} against {others}",
                value=decimals(own, 3),
                outcome=outcome,
            )
        )
    text = _sentence(listed(parts))
    return Answer(subject=subject, outcome=all_of(outcomes), text=text, findings=tuple(findings))


def _rougher(looks: MapQuality, others: Iterable[str]) -> dict[str, Difference]:
    """How much rougher its maps are than those of the others, where that was compared."""
    gaps = {}
    for name in others:
        if (_NOISY, name) in looks.rougher:
            gaps[name] = looks.rougher[_NOISY, name]
        elif (name, _NOISY) in looks.rougher:
            gaps[name] = reversed_gap(looks.rougher[name, _NOISY])
    return gaps


def claim_edges(results: Results, *, rng: np.random.Generator) -> Claim:
    """The network looks at the edges of two markers: they hold most of its effects, and maps lie on edges."""
    unknown = "only simulated touch tells what each marker does, and no such result is here"
    return Claim(
        id="two-markers",
        title="The network looks at the edges of two markers",
        test="Tested on simulated touch in two parts, both needed: putting back a marker at a time, the strongest two "
        "hold more than half of all change of the answer; and Poly-CAM's relevance lies on marker edges more than "
        "their share of the image.",
        answers=_of_each(results, results.study.truth, lambda truth: [_looks_at_two(truth, rng=rng)], why=unknown),
    )


def _looks_at_two(truth: Truth, *, rng: np.random.Generator) -> Answer:
    share = share_of_strongest(truth.effects, count=_TWO, rng=rng)
    looker = next((name for name in _LOOKERS if name in truth.methods), _LOOKERS[0])
    found = truth.methods.get(looker)
    mass, area = None if found is None else found.mass["edges"], truth.areas["edges"]
    on_edges: Outcome = "undecided" if mass is None or area is None else "holds" if mass > area else "does not hold"
    gap = None if found is None else found.edges
    if gap is not None:
        on_edges = judge_gap(gap)
    two: Outcome = "undecided"
    if share is not None:
        half = type(share)(estimate=share.estimate - 0.5, low=share.low - 0.5, high=share.high - 0.5, units=share.units)
        two = judge_gap(half)
    told = (
        "no marker changes the answer"
        if share is None
        else f"{percent(share.estimate)} of the change of the answer ({percent(share.low)} to {percent(share.high)})"
    )
    on_edges_told = (
        "No Poly-CAM map was held against the truth."
        if mass is None
        else f"{method_name(looker)} puts {percent(mass)} of its relevance on edges, which cover {percent(area)} of "
        "the image."
    )
    markers = len(np.unique(truth.effects.marker))
    return Answer(
        subject=input_name(truth.input),
        outcome=all_of((two, on_edges)),
        text=f"The two strongest of up to {markers} markers hold {told}. {on_edges_told}",
        findings=(
            Finding(
                where="each marker put back", compared="share of the two strongest markers", gap=share, outcome=two
            ),
            Finding(
                where="relevance mass",
                compared=f"on edges, less their {percent(area)} of the image",
                value="" if gap is not None else percent(mass),
                gap=gap,
                outcome=on_edges,
            ),
        ),
    )


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
    def judge(faithful: RemovalScores) -> list[Answer]:
        claimants = poly_cams(faithful)
        return [_best_of(faithful, one, claimants, results, rng=rng) for one in claimants]

    return Claim(
        id="most-faithful",
        title="Poly-CAM is the most faithful of the three methods",
        test="Tested by the symmetric relevance gain (SRG): holds under a fill where Poly-CAM's is larger than both "
        "others' and the 95 % interval of each difference leaves zero out.",
        answers=_of_each(results, results.study.faithfulness, judge, why=_UNSCORED),
    )


def _best_of(
    faithful: RemovalScores, method: str, claimants: list[str], results: Results, *, rng: np.random.Generator
) -> Answer:
    findings, by_setting = [], {}
    for fill, unit in settings(faithful):
        own = faithful.curves.get((fill, unit, method))
        others = [one for one in RIVALS if (fill, unit, one) in faithful.curves]
        if own is None or not others:
            continue
        gaps = {one: compare_gain(own, faithful.curves[fill, unit, one], rng=rng) for one in others}
        where = fill_name(fill, unit)
        by_setting[where] = all_of(judge_gap(gap) for gap in gaps.values())
        findings += _judged(where, {f"SRG, {method_name(method)} less {method_name(one)}": gaps[one] for one in gaps})
    if not by_setting:
        return untested(faithful.input, f"{method_name(method)} and another method were not scored together")
    findings += _thesis_score_of_rivals(results, faithful.input, method, rng=rng)
    named = f", {method_name(method)}" if len(claimants) > 1 else ""
    return _over_settings(f"{input_name(faithful.input)}{named}", by_setting, findings)


def _thesis_score_of_rivals(results: Results, name: str, method: str, *, rng: np.random.Generator) -> list[Finding]:
    scored = next((one for (own, _), one in results.scores.items() if own == name), None)
    if scored is None or method not in scored.curves:
        return []
    curves = scored.curves
    named = {f"D, {method_name(method)} less {method_name(one)}": one for one in RIVALS if one in curves}
    pairs = {compared: (curves[method], curves[one]) for compared, one in named.items()}
    return _by_thesis_score(pairs, scored_trials(results, name), rng=rng)


def _claim_grad_cam(results: Results, *, rng: np.random.Generator) -> Claim:
    return Claim(
        id="grad-cam",
        title="Grad-CAM is not faithful",
        test="Tested against maps that know nothing of the network: holds under a fill where Grad-CAM's SRG lies below "
        "chance or below the best control for sure; does not hold where it lies above both for sure.",
        answers=_of_each(
            results, results.study.faithfulness, lambda faithful: [_no_better(faithful, rng=rng)], why=_UNSCORED
        ),
    )


def _no_better(faithful: RemovalScores, *, rng: np.random.Generator) -> Answer:
    findings, by_setting, method = [], {}, "grad-cam"
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
    return _over_settings(input_name(faithful.input), by_setting, findings)


def _judged(where: str, gaps: Mapping[str, Difference | None]) -> list[Finding]:
    return [Finding(where=where, compared=name, gap=gap, outcome=judge_gap(gap)) for name, gap in gaps.items()]


def _of_each(
    results: Results, found: Mapping[str, Record], judge: Callable[[Record], Sequence[Answer]], *, why: str
) -> tuple[Answer, ...]:
    """Answer for each network, difference before raw; one without a result stays open, and why."""
    names = inputs_in_order(results.study.inputs)[::-1]
    return tuple(
        answer for name in names for answer in (judge(found[name]) if name in found else [untested(name, why)])
    )
