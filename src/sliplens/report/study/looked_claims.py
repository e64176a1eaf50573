"""Claims about what maps look like and where networks look."""

from collections.abc import Iterable

import numpy as np

from sliplens.intervals import Difference
from sliplens.report.study.claim import Answer, Claim, Finding, Outcome, all_of, judge_gap
from sliplens.report.study.evidence import share_of_strongest
from sliplens.report.study.localised import Truth
from sliplens.report.study.records import Looks
from sliplens.report.style import CONTROLS, decimals, input_name, inputs_in_order, listed, method_name, percent
from sliplens.report.thesis import THESIS_POLY_CAM
from sliplens.report.workspace import Results

_NOISY = "integrated-gradients"
_MEASURES = {"total_variation": 1, "noise_stability": -1}  # sign: noisier is more of it, or less
_MEASURE_NAMES = {"total_variation": "total variation", "noise_stability": "stability under sensor noise"}
_LOOKERS = ("poly-cam", THESIS_POLY_CAM)  # the finer of the two first: edges are finer than its coarse map
_TWO = 2


def claim_noisy(results: Results) -> Claim:
    """Integrated Gradients is noisy: rougher than the other methods, and less stable under sensor noise."""
    answers = []
    for name in inputs_in_order(results.study.inputs)[::-1]:
        looks = results.study.looks.get(name)
        answers.append(
            Answer(
                subject=input_name(name),
                outcome="undecided",
                text="Not tested: the looks of the maps were not measured; `sliplens study` does that.",
            )
            if looks is None
            else _noisiest(looks)
        )
    return Claim(
        id="noisy",
        title="Integrated Gradients is noisy",
        test="Tested by numbers: holds where its maps have a larger total variation than those of every other method, "
        "beyond the 95 % interval, and are the least stable under sensor noise (means over few frames, no interval).",
        answers=tuple(answers),
    )


def _noisiest(looks: Looks) -> Answer:
    subject = input_name(looks.input)
    findings, outcomes, parts = [], [], []
    for measure, sign in _MEASURES.items():
        values = {
            name: value
            for name, found in looks.methods.items()
            if name not in CONTROLS and (value := found[measure]) is not None
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
            findings += [
                Finding(
                    where=_MEASURE_NAMES[measure],
                    compared=f"{method_name(_NOISY)} less {method_name(name)}",
                    gap=gap,
                    outcome=judge_gap(gap),
                )
                for name, gap in gaps.items()
            ]
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
    text = listed(parts)
    return Answer(
        subject=subject, outcome=all_of(outcomes), text=f"{text[:1].upper()}{text[1:]}.", findings=tuple(findings)
    )


def _rougher(looks: Looks, others: Iterable[str]) -> dict[str, Difference]:
    """How much rougher its maps are than those of the others, where that was compared."""
    gaps = {}
    for name in others:
        if (_NOISY, name) in looks.rougher:
            gaps[name] = looks.rougher[_NOISY, name]
        elif (name, _NOISY) in looks.rougher:
            gap = looks.rougher[name, _NOISY]
            gaps[name] = Difference(estimate=-gap.estimate, low=-gap.high, high=-gap.low, units=gap.units)
    return gaps


def claim_edges(results: Results, *, rng: np.random.Generator) -> Claim:
    """The network looks at the edges of two markers: they hold most of its effects, and maps lie on edges."""
    answers = []
    for name in inputs_in_order(results.study.inputs)[::-1]:
        truth = results.study.truth.get(name)
        answers.append(
            Answer(
                subject=input_name(name),
                outcome="undecided",
                text="Not tested: only simulated touch tells what each marker does, and no such result is here.",
            )
            if truth is None
            else _looks_at_two(truth, rng=rng)
        )
    return Claim(
        id="two-markers",
        title="The network looks at the edges of two markers",
        test="Tested on simulated touch in two parts, both needed: putting back a marker at a time, the strongest two "
        "hold more than half of all change of the answer; and Poly-CAM's relevance lies on marker edges more than "
        "their share of the image.",
        answers=tuple(answers),
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
                where="each marker put back",
                compared="share of the two strongest markers",
                gap=share,
                outcome=two,
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
