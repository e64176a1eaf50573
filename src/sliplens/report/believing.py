"""Which explanation to believe here, and why: the verdict that a study comes to."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from sliplens.intervals import FEWEST_UNITS, Difference, paired_difference
from sliplens.plots.style import (
    CONTROLS,
    FILL_NAMES,
    UNIT_NAMES,
    fill_name,
    in_order,
    input_name,
    inputs_in_order,
    listed,
    method_name,
    methods_in_order,
    signed,
)
from sliplens.report.verdict import Statement, judge_accuracy, tell_scale
from sliplens.report.workspace import Results
from sliplens.results.faithfulness import DeletionCurve, RemovalCurve, RemovalScores
from sliplens.results.study import MarkerEffects, Truth


def compare_gain(first: RemovalCurve, second: RemovalCurve, *, rng: np.random.Generator) -> Difference | None:
    """Symmetric relevance gain of the first less that of the second, over the frames both have; None without any."""
    _, here, there = np.intersect1d(first.frame_ids, second.frame_ids, return_indices=True)
    if len(here) == 0:
        return None
    return paired_difference(first.srg[here], second.srg[there], trials=first.trials[here], rng=rng)


def compare_mean_gain(
    firsts: Sequence[RemovalCurve], seconds: Sequence[RemovalCurve], *, rng: np.random.Generator
) -> Difference | None:
    """Compare as `compare_gain` does, the gain of each frame averaged over several methods first.

    Parameters
    ----------
    firsts, seconds
        Curves of the same methods in the same order, of one network and of another.
    """
    shared = sorted(set.intersection(*(set(curve.frame_ids) for curve in (*firsts, *seconds))))
    if not shared:
        return None
    means = [
        np.mean([curve.srg[np.searchsorted(curve.frame_ids, shared)] for curve in curves], axis=0)
        for curves in (firsts, seconds)
    ]
    trials = firsts[0].trials[np.searchsorted(firsts[0].frame_ids, shared)]
    return paired_difference(means[0], means[1], trials=trials, rng=rng)


def gain_over_chance(curve: RemovalCurve, *, rng: np.random.Generator) -> Difference:
    """Symmetric relevance gain with its interval: a map that tells nothing has 0."""
    return paired_difference(curve.srg, np.zeros(len(curve.frame_ids)), trials=curve.trials, rng=rng)


def compare_thesis_score(
    first: DeletionCurve, second: DeletionCurve, trials: dict[str, str], *, rng: np.random.Generator
) -> Difference | None:
    """Deletion score of the first less that of the second, over the frames whose trial is known; None without any.

    Parameters
    ----------
    first, second
        Of two methods, or of two inputs.
    trials
        Trial of each frame that counts.
    """
    ids, here, there = np.intersect1d(first.frame_ids, second.frame_ids, return_indices=True)
    known = np.array([name in trials for name in ids], dtype=bool)
    if not known.any():
        return None
    means = [one.scores.mean(axis=1)[rows[known]] for one, rows in ((first, here), (second, there))]
    names = np.array([trials[name] for name in ids[known]])
    return paired_difference(means[0], means[1], trials=names, rng=rng)


def share_of_strongest(effects: MarkerEffects, *, count: int, rng: np.random.Generator) -> Difference | None:
    """Share of a network's effects, in size, that its strongest markers hold; trials are resampled.

    None where no marker has any effect.

    Parameters
    ----------
    effects
        Of every marker, in margin units.
    count
        How many markers are the strongest.
    """
    ids, first, member = np.unique(effects.frame_id, return_index=True, return_inverse=True)
    shares, kept = [], []
    for frame in range(len(ids)):
        sizes = np.sort(np.abs(effects.network[member == frame]))[::-1]
        if sizes.sum() > 0:
            shares.append(sizes[:count].sum() / sizes.sum())
            kept.append(effects.trial[first[frame]])
    if not shares:
        return None
    return paired_difference(np.array(shares), np.zeros(len(shares)), trials=np.array(kept), rng=rng)


def settings(faithful: RemovalScores) -> list[tuple[str, str]]:
    """Fills and units that were scored, in the order they are read."""
    found = {(fill, unit) for fill, unit, _ in faithful.curves}
    fills = in_order({fill for fill, _ in found}, FILL_NAMES)
    units = in_order({unit for _, unit in found}, UNIT_NAMES)
    return [(fill, unit) for unit in units for fill in fills if (fill, unit) in found]


def controls(faithful: RemovalScores) -> set[str]:
    """Names of the maps that know nothing of the network."""
    return {score.method for score in faithful.scores if score.control}


def best_control(faithful: RemovalScores, fill: str, unit: str) -> str | None:
    """Name the control with the highest gain under a fill and unit."""
    gains = {
        name: faithful.curves[key]
        for name in sorted(controls(faithful))
        if (key := (fill, unit, name)) in faithful.curves
    }
    return max(gains, key=lambda name: float(gains[name].srg.mean()), default=None)


def mean_at(curve: RemovalCurve, area: float) -> tuple[float, float]:
    """Mean change where a share of the image is gone: most influential first, and in random order."""
    places: Float64[np.ndarray, " areas"] = curve.areas
    most, chance = (float(np.interp(area, places, values.mean(axis=0))) for values in (curve.most_first, curve.random))
    return most, chance


def tell_interval(gap: Difference, *, digits: int = 3, scale: float = 1.0) -> str:
    """Write an estimate with its 95 % interval."""
    values: Float[np.ndarray, 3] = scale * np.array([gap.estimate, gap.low, gap.high])
    return f"{signed(values[0], digits)} ({signed(values[1], digits)} to {signed(values[2], digits)})"


def tell_bounds(gap: Difference, *, digits: int = 3) -> str:
    """Write the ends of a 95 % interval."""
    return f"{signed(gap.low, digits)} to {signed(gap.high, digits)}"


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


def rank_methods(faithful: RemovalScores, truth: Truth | None = None) -> list[Standing]:
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


def _believe(faithful: RemovalScores, results: Results) -> Statement:
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


def _tell_lead(faithful: RemovalScores, best: Standing, others: list[Standing]) -> str:
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


def _against(faithful: RemovalScores, method: str, rival: str) -> dict[tuple[str, str], Difference]:
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


def _votes(faithful: RemovalScores, method: str) -> list[tuple[str, str]]:
    """One setting a fill: by pixels where that was done, or a fill tried with several units would count twice."""
    chosen: dict[str, tuple[str, str]] = {}
    for fill, unit in settings(faithful):
        if (fill, unit, method) in faithful.curves:
            chosen.setdefault(fill, (fill, unit))
    return list(chosen.values())


def _gains(gap: Difference) -> bool:
    return gap.sure and gap.estimate > 0
