"""Which explanation to believe here, and why: the verdict that a study comes to."""

from dataclasses import dataclass

import numpy as np

from sliplens.intervals import FEWEST_UNITS, Difference
from sliplens.report.study.evidence import controls, settings, tell_interval
from sliplens.report.study.localised import Truth
from sliplens.report.study.scored import Faithful
from sliplens.report.style import (
    CONTROLS,
    FILL_NAMES,
    fill_name,
    input_name,
    inputs_in_order,
    listed,
    method_name,
    methods_in_order,
    signed,
)
from sliplens.report.verdict import Statement, judge_accuracy, tell_scale
from sliplens.report.workspace import Results


@dataclass(frozen=True, kw_only=True)
class Standing:
    """How a method stands: settings (fill, unit) in which it gains for sure, against chance and the best control.

    Attributes
    ----------
    beaten
        Settings in which it does.
    tested
        Settings in which it was compared with a control.
    mean_gain
        Symmetric relevance gain, mean over those settings, in margin units.
    """

    method: str
    beaten: tuple[tuple[str, str], ...]
    tested: tuple[tuple[str, str], ...]
    mean_gain: float

    @property
    def qualifies(self) -> bool:
        """Whether it does so in most settings."""
        return 2 * len(self.beaten) > len(self.tested)


def rank_methods(faithful: Faithful, truth: Truth | None = None) -> list[Standing]:
    """Rank the methods: those that beat the best control in most settings first, by their gain.

    Parameters
    ----------
    faithful
        Scores of the methods.
    truth
        What the simulation tells: fills under which even a map made from the truth does not win are left out.
    """
    unfit = _unfit_fills(truth)
    known = controls(faithful)
    gaps = {(one.fill, one.unit, one.first): one.gap for one in faithful.comparisons if one.second in known}
    scores = {score.key: score for score in faithful.scores}
    standings = []
    for method in methods_in_order(score.method for score in faithful.scores if not score.control):
        if method in CONTROLS:
            continue
        tested = [one for one in _votes(faithful, method) if (*one, method) in gaps and one[0] not in unfit]
        beaten = [one for one in tested if _gains(gaps[*one, method]) and _gains(scores[*one, method].srg)]
        gains = [scores[*one, method].srg.estimate for one in tested]
        standings.append(
            Standing(
                method=method,
                beaten=tuple(beaten),
                tested=tuple(tested),
                mean_gain=float(np.mean(gains)) if gains else float("-inf"),
            )
        )
    return sorted(standings, key=lambda one: (not one.qualifies, -one.mean_gain))


def judge_study(results: Results, *, rng: np.random.Generator) -> tuple[Statement, ...]:
    """State which explanation to believe for each network, and how well the networks read the margin."""
    study = results.study
    names = inputs_in_order(study.inputs)[::-1]
    statements = [
        _believe(study.faithfulness[name], results)
        if name in study.faithfulness
        else Statement(
            topic=f"Which to believe, {input_name(name).lower()}",
            text="Not known: the explanations were not scored; `sliplens study` does that.",
            tone="caution",
        )
        for name in names
    ]
    return (*statements, *judge_accuracy(results, rng=rng), *tell_scale(results))


def _believe(faithful: Faithful, results: Results) -> Statement:
    topic = f"Which to believe, {input_name(faithful.input).lower()}"
    truth = results.study.truth.get(faithful.input)
    ranked = rank_methods(faithful, truth)
    if not any(one.tested for one in ranked):
        return Statement(topic=topic, text="Not known: no method was compared with a control.", tone="caution")
    best = ranked[0]
    if faithful.trials < FEWEST_UNITS:
        trials = f"{faithful.trials} trials are too few to tell a method from chance; {FEWEST_UNITS} or more are needed"
        return Statement(topic=topic, text=f"Not known: {trials}.", tone="caution")
    if not best.qualifies:
        return Statement(topic=topic, text=_tell_none(ranked) + _tell_unfit(truth), tone="caution")
    score = next(one for one in faithful.scores if one.key == (*best.beaten[0], best.method))
    others = [one for one in ranked[1:] if one.qualifies]
    text = (
        f"Believe {method_name(best.method)}. Under {len(best.beaten)} of {len(best.tested)} fills it finds what "
        "the answer rests on, better than chance and than the best map that knows nothing of the network, beyond the "
        f"95 % interval{_tell_open(best)}. "
        f"Under {fill_name(score.fill, score.unit)} its symmetric gain is {tell_interval(score.srg)} in margin units."
    )
    text += _tell_lead(faithful, best, others) + _tell_truth(results, faithful.input, best.method)
    failing = [method_name(one.method) for one in ranked if not one.qualifies]
    if failing:
        text += f" {listed(failing)} {'does' if len(failing) == 1 else 'do'} not beat the controls under most fills."
    text += _tell_unfit(truth)
    if faithful.alarms:
        count = len(faithful.alarms)
        text += f" {count} {'alarm' if count == 1 else 'alarms'} about these scores: see beside their table."
    return Statement(topic=topic, text=text, tone="good")


def _tell_none(ranked: list[Standing]) -> str:
    nearest = max(ranked, key=lambda one: (len(one.beaten), one.mean_gain))
    return (
        "None: no method beats both chance and the best control under most fills. "
        f"{method_name(nearest.method)} comes nearest, under {len(nearest.beaten)} of {len(nearest.tested)}, its mean "
        f"gain {signed(nearest.mean_gain, 3)} in margin units. Maps of this network show where a method looked, "
        "not what the network used."
    )


def _tell_lead(faithful: Faithful, best: Standing, others: list[Standing]) -> str:
    if not others:
        return ""
    rival = others[0]
    gaps = _against(faithful, best.method, rival.method)
    ahead, behind = (
        [fill_name(*one) for one, gap in gaps.items() if one in best.tested and told(gap)]
        for told in (_gains, lambda gap: gap.high < 0)
    )
    name = method_name(rival.method)
    means = f"their mean gains are {signed(best.mean_gain, 3)} and {signed(rival.mean_gain, 3)}"
    if not ahead and not behind:
        return f" {name}, next by its mean gain, is not told apart from it under any fill."
    if not ahead:
        return f" {name}, next by its mean gain, is ahead of it under {listed(behind)}; {means}."
    but = f", and behind it under {listed(behind)}; {means}" if behind else ""
    return f" It is ahead of {name}, the next, under {listed(ahead)}{but}."


def _against(faithful: Faithful, method: str, rival: str) -> dict[tuple[str, str], Difference]:
    gaps = {}
    for one in faithful.comparisons:
        if (one.first, one.second) == (method, rival):
            gaps[one.fill, one.unit] = one.gap
        elif (one.first, one.second) == (rival, method):
            gap = one.gap
            gaps[one.fill, one.unit] = Difference(estimate=-gap.estimate, low=-gap.high, high=-gap.low, units=gap.units)
    return gaps


def _tell_open(best: Standing) -> str:
    lost = [fill_name(*one) for one in best.tested if one not in best.beaten]
    return f", but not under {listed(lost)}" if lost else ""


def _unfit_fills(truth: Truth | None) -> list[str]:
    return [] if truth is None else [one.fill for one in truth.meta if not one.holds]


def _tell_unfit(truth: Truth | None) -> str:
    unfit = [FILL_NAMES.get(fill, fill) for fill in _unfit_fills(truth)]
    if not unfit:
        return ""
    return f" Left out: {listed(unfit)}, where even a map made from the truth does not win."


def _tell_truth(results: Results, name: str, method: str) -> str:
    truth = results.study.truth.get(name)
    found = None if truth is None else truth.methods.get(method)
    if found is None or found.network is None:
        return ""
    return (
        f" Its map ranks the markers by what they do to the answer with a Spearman correlation of "
        f"{tell_interval(found.network, digits=2)}, as the simulation tells (1 = alike, 0 = chance)."
    )


def _votes(faithful: Faithful, method: str) -> list[tuple[str, str]]:
    """One setting a fill: by pixels where that was done, or a fill tried with several units would count twice."""
    chosen: dict[str, tuple[str, str]] = {}
    for fill, unit in settings(faithful):
        if (fill, unit, method) in faithful.curves:
            chosen.setdefault(fill, (fill, unit))
    return list(chosen.values())


def _gains(gap: Difference) -> bool:
    return gap.sure and gap.estimate > 0
