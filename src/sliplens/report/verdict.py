"""The verdict: what to believe about these networks, on which evidence, and what would overturn it."""

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np
from scipy.stats import binomtest

from sliplens.grip.records import Grip
from sliplens.intervals import FEWEST_UNITS, Difference
from sliplens.plots.style import (
    FILL_NAMES,
    conditions_in_order,
    decimals,
    fill_name,
    input_name,
    inputs_in_order,
    listed,
    method_name,
    methods_in_order,
    name_methods,
    percent,
    short_input_name,
    signed,
    source_name,
)
from sliplens.progress import number_of
from sliplens.report.claims import POLY_CAM, Claim
from sliplens.report.comparisons import (
    NETWORK_PIXELS,
    against_control,
    compare_errors,
    gap_from,
    sentence,
    tell_interval,
    tell_sample,
    unfit_fills,
    voting_settings,
)
from sliplens.report.results import Results
from sliplens.results.explanation import Explanation
from sliplens.results.faithfulness import CHANCE, DeletionScores, Lead, RemovalScores
from sliplens.results.study import Localisation, Truth

Tone = Literal["good", "plain", "caution"]


@dataclass(frozen=True, kw_only=True)
class Statement:
    """One finding: its topic, what is said, and whether it carries, is plain, or warns."""

    topic: str
    text: str
    tone: Tone = "plain"

    @property
    def parts(self) -> tuple[str, str]:
        """The first sentence, which carries the finding, and the others."""
        first, _, others = re.sub(r"(?<=[.:]) ", "\n", self.text, count=1).partition("\n")
        return first, others


def judge(results: Results, *, claims: Sequence[Claim] = (), rng: np.random.Generator) -> tuple[Statement, ...]:
    """State what the results show: which explanation to look at, which claims of the thesis hold, who reads how well.

    What carries comes first, then what warns, each in that order; what was not run is left out. Where the sample holds
    trials that do not qualify, nothing carries for sure: an explanation of a wrong answer explains the error.
    """
    study, statements = results.study, []
    for name in inputs_in_order(study.inputs)[::-1] if study else ():
        truth, faithful = study.truth.get(name), study.faithfulness.get(name)
        topic = f"What to believe, {input_name(name).lower()}"
        if truth is not None and (choice := recommend(truth)) is not None:
            found = _tell_recommended(topic, choice, truth, faithful)
        elif faithful is not None:
            found = replace(_believe(faithful, results), topic=topic)
        else:
            text = "Not known: the explanations were not scored; `sliplens study` does that."
            found = Statement(topic=topic, text=text, tone="caution")
        sample = "" if study.choice is None else f" {tell_sample(study.choice, name)}"
        statements.append(replace(found, text=found.text + sample))
    statements += _tell_claims(claims, results)
    statements += _accuracy(results)
    statements += _winners(results, rng=rng)
    # a study's sound scores say more than deletion does
    if not study:
        statements += [
            _faithfulness(results.scores[key], rng=rng)
            for key in sorted(results.scores, key=lambda key: (key[1] == "real", key[0] != "raw", key))
        ]
        if results.scores:
            statements.append(_what_deletion_measures(results))
    real = {name: one for (name, source), one in results.explanations.items() if source == "real"}
    statements += [_real_touch(real[name]) for name in inputs_in_order(real)]
    statements += [_tell_grip(results.grip)] if results.grip is not None else []
    statements += _tell_scale(results)
    if study.choice is not None and not study.choice.sound:
        statements = [replace(one, tone="plain") if one.tone == "good" else one for one in statements]
    return tuple(sorted(statements, key=lambda one: one.tone == "caution"))


def _tell_grip(grip: Grip) -> Statement:
    """What became of what was held, and how much harder than needed it was pressed."""
    table, setup, count = grip.episodes, grip.setup, len(grip.episodes)
    excess = f"{percent(float(table.force_excess.mean()))} harder than the least force that holds"
    if count == 1:
        fate = f"fell, pressed {excess}" if table.dropped[0] else f"was held, pressed {excess}"
        text = f"The {setup.object} {fate}. One simulated episode ({setup.condition}): more of them tell how often."
        return Statement(topic="The grip", text=text)
    fell = int(table.dropped.sum())
    low, high = binomtest(fell, count).proportion_ci(method="wilson")
    text = (
        f"Of {count:,} episodes ({setup.object}, {setup.condition}) {percent(fell / count, digits=1)} ended in a fall "
        f"({percent(low, digits=1)} to {percent(high, digits=1)}); the controller {setup.controller} pressed {excess}."
        " All are simulated; another controller has to be run on the same seed to be compared."
    )
    return Statement(topic="The grip", text=text)


def tell_too_few(results: Results) -> str:
    """Say of how few trials a study is where they decide nothing; empty where they may."""
    trials = FEWEST_UNITS if results.study.choice is None else len(results.study.choice.trials)
    if trials >= FEWEST_UNITS:
        return ""
    return (
        f"This study explains {number_of(trials, 'trial')}, and fewer than {FEWEST_UNITS} decide "
        "nothing: below is how explanations are judged, not yet which one to believe."
    )


@dataclass(frozen=True, kw_only=True)
class Recommended:
    """Method whose map ranks the markers most like their Shapley values, and whether it may be recommended."""

    method: str
    found: Localisation
    correlation: Difference
    lead: Lead
    """Over the strongest control."""
    tied: tuple[str, ...]
    """Other methods from which it is not told apart, the nearest first."""

    @property
    def shown(self) -> bool:
        """Whether its lead over every control and over every other method is off zero."""
        return self.lead.shows_something and not self.tied


def recommend(truth: Truth) -> Recommended | None:
    """Method with the best signed correlation with the Shapley values; None where no method was held against them."""
    known = {
        name: (own.shapley.estimate, own.shapley, own.lead_over_controls)
        for name, own in truth.methods.items()
        if own.shapley is not None and own.lead_over_controls is not None
    }
    if not known:
        return None
    best = max(known, key=lambda name: known[name][0])
    over = truth.methods[best].lead_over_methods
    return Recommended(
        method=best,
        found=truth.methods[best],
        correlation=known[best][1],
        lead=known[best][2],
        tied=tuple(
            sorted((one for one, gap in over.items() if not gap.above_zero), key=lambda one: over[one].estimate)
        ),
    )


_KIN = ("shapley-marker", "shapley", "integrated-gradients", "integrated-gradients-thesis", "expected-gradients")


def _tell_recommended(topic: str, best: Recommended, truth: Truth, faithful: RemovalScores | None) -> Statement:
    name, over = method_name(best.method), best.found.lead_over_methods
    control = method_name(best.lead.control).removesuffix(" (control)")
    if best.correlation.units < FEWEST_UNITS:
        return _too_few(topic, best.correlation.units)
    evidence = (
        "its map ranks the markers by what each adds to the answer (its Shapley value, found by drawing the scene anew "
        f"without its motion) with a signed correlation of {tell_interval(best.correlation, digits=2)}, 1 being perfect"
    )
    ahead = (
        f"its lead over the strongest map that knows nothing of what the network learned ({control}) is "
        f"{tell_interval(best.lead.gap, digits=2)}"
    )
    if best.shown:
        text = (
            f"Believe {name}: of {number_of(len(over) + 1, 'method')} its map tells best what each marker "
            "adds to this answer. "
        )
        text += sentence(f"{evidence}, {ahead}")
        if over:
            near = min(over, key=lambda one: over[one].estimate)
            text += f" It leads the next method, {method_name(near)}, by {tell_interval(over[near], digits=2)}."
    elif best.lead.shows_something:
        tied = [f"{method_name(one)} ({tell_interval(over[one], digits=2)})" for one in best.tied]
        text = f"No method is shown to be best: {name} comes first, and {len(tied)} of {len(over)} others tie with it. "
        text += sentence(f"{evidence}, {ahead}")
        text += f" Not told apart from it, by the lead over each: {listed(tied)}."
    else:
        text = f"None: no map is shown to tell what this network uses; the first, {name}, does not beat every control. "
        text += sentence(f"{evidence}, but {ahead}, not off zero")
    if truth.reliability is not None:
        most = decimals(max(truth.reliability.estimate, 0.0) ** 0.5, 2)
        text += f" These values are themselves estimates: even a perfect map would reach {most}."
    if best.method in _KIN:
        text += " It is kin to that truth by construction: both share the answer out by the rule of Shapley."
    standing = (
        next((one for one in rank_methods(faithful, truth) if one.method == best.method), None) if faithful else None
    )
    if standing is not None and standing.tested:
        text += (
            " When parts of the frame are removed in its order, it beats every such map under "
            f"{len(standing.beaten)} of {len(standing.tested)} ways to fill them that can tell."
        )
    other = "its lead is not off zero" if best.shown else "one method leads every other and every control for sure"
    text += _tell_limits(
        best.correlation, f"a study of other trials, or of a second seed of the network, in which {other}"
    )
    tone: Tone = "good" if best.shown else "plain" if best.lead.shows_something else "caution"
    return Statement(topic=topic, text=text, tone=tone)


def _too_few(topic: str, trials: int) -> Statement:
    few = "one trial is" if trials == 1 else f"{trials} trials are"
    text = f"Not known: {few} too few to tell a method from chance; {FEWEST_UNITS} or more are needed."
    return Statement(topic=topic, text=text, tone="caution")


def _tell_limits(gap: Difference, overturned_by: str) -> str:
    """Say over what it was found, and what it would take to change it."""
    single = [what for what, count in (("network", gap.networks), ("day", gap.days)) if count == 1]
    text = f" Found over {gap.over}"
    if single:
        text += f": another {' or '.join(single)} may say otherwise"
    return f"{text}. It would be overturned by {overturned_by}."


def _tell_claims(claims: Sequence[Claim], results: Results) -> list[Statement]:
    if not claims:
        return []
    outcomes = {claim.title: {answer.outcome for answer in claim.answers} for claim in claims}
    kinds = {
        ("holds", "hold"): [f"“{title}”" for title, own in outcomes.items() if own == {"holds"}],
        ("does not hold", "do not hold"): [f"“{title}”" for title, own in outcomes.items() if own == {"does not hold"}],
        ("is undecided", "are undecided"): [f"“{title}”" for title, own in outcomes.items() if own == {"undecided"}],
        ("differs between the networks", "differ between the networks"): [
            f"“{title}”" for title, own in outcomes.items() if len(own) > 1
        ],
    }
    told = {f"{len(titles)} {words[len(titles) > 1]}": listed(titles) for words, titles in kinds.items() if titles}
    text = f"Of the thesis's {len(claims)} claims {listed([*told])}."
    text += "".join(f" {count}: {titles}." for count, titles in told.items())
    for name in inputs_in_order(results.study.truth)[::-1]:
        best = recommend(results.study.truth[name])
        gap = None if best is None else best.found.lead_over_methods.get(POLY_CAM)
        if best is not None and gap is not None and gap.above_zero:
            text += (
                f" Its recommendation, Poly-CAM as it ran it, is not borne out on {input_name(name).lower()}: "
                f"{method_name(best.method)} leads that map by {tell_interval(gap, digits=2)}, ranking the markers."
            )
    text += (
        " Tested with its methods as published, on networks and data of our own: its network and most of its data are "
        "not here, so that a claim may fail for those reasons too."
    )
    if results.study.choice is not None:
        text += f" {tell_sample(results.study.choice)}"
    return [Statement(topic="The thesis's claims", text=text)]


def _accuracy(results: Results) -> list[Statement]:
    statements = []
    read = {name: results.evaluations[name].conditions for name in inputs_in_order(results.evaluations)}
    # the network that reads best first
    for name, scores in sorted(read.items(), key=lambda own: np.mean([one.mse for one in own[1].values()])):
        conditions = conditions_in_order(scores)
        r2 = [f"{decimals(scores[condition].r2, 2)} on {condition}" for condition in conditions]
        mae = [decimals(100 * scores[condition].mae, 1) for condition in conditions]
        asked = results.evaluations[name].predictions
        trials, days = (len(np.unique(labels)) for labels in (asked.trial, asked.day))
        text = (
            f"The network reads the safety margin with R² {listed(r2)} objects of test trials; on average it is off by "
            f"{listed(mae)} percentage points. That is of one network, over {number_of(trials, 'trial')} of "
            f"{'one day' if days == 1 else f'{days} days'}."
        )
        # of labels that do not vary there is no R²
        poor = [condition for condition in conditions if (value := scores[condition].r2) is not None and value <= 0]
        if poor:
            text += f" On {listed(poor)} objects that is no better than always answering the mean label."
        tone: Tone = "caution" if poor else "plain"
        statements.append(Statement(topic=f"Accuracy, {input_name(name).lower()}", text=text, tone=tone))
    return statements


def _winners(results: Results, *, rng: np.random.Generator) -> list[Statement]:
    evaluations, statements = results.evaluations, []
    pairs = [
        (condition, *names)
        for names in combinations(inputs_in_order(evaluations), 2)
        for condition in conditions_in_order(set.intersection(*(set(evaluations[one].conditions) for one in names)))
    ]
    for condition, *names in pairs:
        both = {name: evaluations[name] for name in names}
        mse = {name: one.conditions[condition].mse for name, one in both.items()}
        better, worse = sorted(mse, key=lambda name: mse[name])
        less = 1 - mse[better] / mse[worse] if mse[worse] > 0 else 0.0
        text = (
            f"On {condition} objects {input_name(better).lower()} have the lower error: MSE {mse[better]:.4f} against "
            f"{mse[worse]:.4f}, {percent(less)} less."
        )
        shown = [one.predictions.where(one.predictions.condition == condition) for one in both.values()]
        gap = compare_errors(shown[0], shown[1], rng=rng)
        sure = gap is not None and gap.sure
        if gap is None:
            text += " The two networks did not answer the same frames, so whether that is chance was not tested."
        elif gap.units < FEWEST_UNITS:
            text += f" With {number_of(gap.units, 'test trial')}, that can be chance."
        elif sure:
            text += f" That holds beyond the 95 % interval over {gap.over}."
        else:
            text += f" The 95 % interval over {gap.over} does not rule out chance."
        tone: Tone = "good" if sure else "caution"
        first, second = map(short_input_name, names)
        statements.append(Statement(topic=f"{first} or {second.lower()}, {condition}", text=text, tone=tone))
    if statements:
        seeds = "Each input stands for one trained network: another seed may change the order."
        statements[-1] = replace(statements[-1], text=f"{statements[-1].text} {seeds}")
    return statements


def _faithfulness(scored: DeletionScores, *, rng: np.random.Generator) -> Statement:
    topic = f"Faithfulness, {input_name(scored.input).lower()}"
    if scored.source != "simulated":
        topic += f", {source_name(scored.source)}"
    methods = {name: score for name, score in scored.methods.items() if name != CHANCE}
    if not methods:
        return Statement(topic=topic, text="No method was scored.", tone="caution")
    best = min(methods, key=lambda name: methods[name].mean)
    text = f"{method_name(best)} has the lowest deletion score, {methods[best].mean:.3f} ± {methods[best].sd:.3f}"
    control = scored.methods.get(CHANCE)
    if control is None:
        text += "; no random control was scored, so whether that is better than chance is not known."
        return Statement(topic=topic, text=text, tone="caution")
    text += f"; removing pixels in random order gives {control.mean:.3f} ± {control.sd:.3f}."
    gaps = {name: against_control(scored, name, rng=rng) for name in methods}
    beating = [name for name, gap in gaps.items() if gap is not None and gap.below_zero]
    failing = [method_name(name) for name in methods if name not in beating]
    if best not in beating:
        if methods[best].mean < control.mean:
            text += " That is lower than chance, but not by enough to rule chance out."
        else:
            text += " It does not beat the control: by this score no map tells more than chance."
    elif failing:
        text += f" It beats the control; {listed(failing)} {'does' if len(failing) == 1 else 'do'} not."
    else:
        text += " It beats the control, as does every other method." if len(methods) > 1 else " It beats the control."
    return Statement(topic=topic, text=text, tone="good" if best in beating else "caution")


def _what_deletion_measures(results: Results) -> Statement:
    last = []
    for (name, source), scored in sorted(results.scores.items(), key=lambda item: (item[0][1] == "real", item[0])):
        mean = float(np.mean([one.last_step_mean for one in scored.methods.values()]))
        last.append(f"{decimals(mean, 2)} ({input_name(name).lower()}, {source_name(source)}, {scored.fill})")
    text = (
        "The deletion score depends on what a removed pixel becomes. It says how far the answer moves, not that the "
        "map shows what slip is, and its sign is lost. With every pixel filled, where no map has a part, D is "
        f"{listed(last)}: a score near that tells of the fill."
    )
    return Statement(topic="How far to trust D", text=text, tone="caution")


def _real_touch(explained: Explanation) -> Statement:
    topic = f"Real touch, {input_name(explained.input).lower()}"
    labelled = [(one.safety_margin, one.prediction) for one in explained.frames if one.safety_margin is not None]
    trials = len({one.trial for one in explained.frames if one.safety_margin is not None})
    if not labelled:
        text = (
            f"Of {number_of(len(explained.frames), 'real frame')} no label is known, so nothing can be said "
            "of the answers on them."
        )
        return Statement(topic=topic, text=text, tone="caution")
    labels, answers = np.array(labelled, dtype=np.float64).T
    error = np.abs(answers - labels).mean()
    # that of the best constant: a network that cannot beat it has read nothing
    constant = np.abs(labels - np.median(labels)).mean()
    useful = error < constant
    text = (
        f"On {number_of(len(labels), 'frame')} of {'one trial' if trials == 1 else f'{trials} trials'} of real "
        f"touch the network is off by {100 * error:.0f} percentage points on average; the best constant answer "
        "would be off by "
        f"{100 * constant:.0f}."
    )
    # frames with equal labels have no order
    pairs = [(first, second) for first, second in combinations(labelled, 2) if first[0] != second[0]]
    right = sum((first[0] - second[0]) * (first[1] - second[1]) > 0 for first, second in pairs)
    if pairs:
        chance = "all of them" if right == len(pairs) else "chance gives half"
        text += f" It puts {right} of {number_of(len(pairs), 'pair')} of frames in the right order ({chance})."
    if not useful:
        text += " So its values do not carry over to real touch."
    return Statement(topic=topic, text=text, tone="plain" if useful else "caution")


def _tell_scale(results: Results) -> list[Statement]:
    """State how little or much each network was trained on."""
    if not results.trainings:
        return []
    told = []
    for one in (results.trainings[name] for name in inputs_in_order(results.trainings)):
        told.append(f"{number_of(one.train_frames, 'frame')} of {one.image_size} px")
        if max(one.frame_size) > one.image_size:
            told[-1] += f", shrunk from {one.frame_size[0]} x {one.frame_size[1]},"
        told[-1] += f" for {decimals(one.minutes, 1)} minutes ({input_name(one.input).lower()})"
    text = f"Trained on {listed(told)}"
    if any(one.image_size != NETWORK_PIXELS for one in results.trainings.values()):
        text += f"; the thesis took images of {NETWORK_PIXELS} px"
    text += (
        ". The thesis measured a real sensor, so its figures beside these show the scale of such errors, not a contest."
    )
    return [Statement(topic="What this run is", text=text)]


@dataclass(frozen=True, kw_only=True)
class Standing:
    """How a method stands: settings (fill, unit) in which it gains for sure, against chance and the best control."""

    method: str
    beaten: tuple[tuple[str, str], ...]
    """Settings in which it does."""
    tested: tuple[tuple[str, str], ...]
    """Settings in which it was compared with a control."""
    mean_gain: float
    """Symmetric relevance gain, mean over those settings, in margin units."""

    @property
    def qualifies(self) -> bool:
        """Whether it does so in most settings."""
        return 2 * len(self.beaten) > len(self.tested)


def rank_methods(faithful: RemovalScores, truth: Truth | None = None) -> list[Standing]:
    """Rank the methods: those that beat the best control in most settings first, by their gain.

    A fill counts once. Fills under which a map made from the truth does not win for sure are left out.
    """
    scores = {score.key: score for score in faithful.scores}
    leads = {key: score.lead_over_controls for key, score in scores.items()}
    standings = []
    for method in methods_in_order(score.method for score in faithful.scores if not score.control):
        tested = [one for one in voting_settings(faithful, truth) if leads.get((*one, method))]
        beaten = [one for one in tested if (lead := leads[*one, method]) is not None and lead.shows_something]
        gains = [scores[*one, method].srg.estimate for one in tested]
        mean = float(np.mean(gains)) if gains else float("-inf")
        standings.append(Standing(method=method, beaten=tuple(beaten), tested=tuple(tested), mean_gain=mean))
    return sorted(standings, key=lambda one: (not one.qualifies, -one.mean_gain))


def _believe(faithful: RemovalScores, results: Results) -> Statement:
    topic = f"Which to believe, {input_name(faithful.input).lower()}"
    truth = results.study.truth.get(faithful.input)
    ranked = rank_methods(faithful, truth)
    if faithful.trials < FEWEST_UNITS:
        return _too_few(topic, faithful.trials)
    fills = [FILL_NAMES.get(fill, fill) for fill in unfit_fills(truth)]
    unfit = f" Left out: {listed(fills)}, where even a map made from the truth does not win for sure." if fills else ""
    if not any(one.tested for one in ranked):
        why = "no method was compared with a control under a fill that can judge it"
        return Statement(topic=topic, text=f"Not known: {why}.{unfit}", tone="caution")
    best = ranked[0]
    if not best.qualifies:
        nearest = max(ranked, key=lambda one: (len(one.beaten), one.mean_gain))
        text = (
            "None: no method beats both chance and the best control under most fills. "
            f"{method_name(nearest.method)} comes nearest, under {len(nearest.beaten)} of {len(nearest.tested)}, its "
            f"mean gain {signed(nearest.mean_gain, 3)} in margin units. Maps of this network show where a method "
            f"looked, not what the network used.{unfit}"
        )
        return Statement(topic=topic, text=text, tone="caution")
    score = next(one for one in faithful.scores if one.key == (*best.beaten[0], best.method))
    others = [one for one in ranked[1:] if one.qualifies]
    lost = [fill_name(*one) for one in best.tested if one not in best.beaten]
    but = f", but not under {listed(lost)}" if lost else ""
    text = (
        f"Believe {method_name(best.method)}. Under {len(best.beaten)} of {len(best.tested)} fills it finds what "
        "the answer rests on, better than chance and than the best map that knows nothing of the network, beyond the "
        f"95 % interval{but}. "
        f"Under {fill_name(score.fill, score.unit)} its symmetric gain is {tell_interval(score.srg)} in margin units."
    )
    text += _tell_lead(faithful, best, others)
    failing = [method_name(one.method) for one in ranked if not one.qualifies]
    if failing:
        text += f" {listed(failing)} {'does' if len(failing) == 1 else 'do'} not beat the controls under most fills."
    text += unfit
    if faithful.alarms:
        count = len(faithful.alarms)
        text += f" {count} {'alarm' if count == 1 else 'alarms'} about these scores: see beside their table."
    text += " Without the scene to draw anew, no truth tells whether it also shows how much each part adds."
    text += _tell_limits(score.srg, "a study of other trials in which it beats the controls under fewer fills")
    return Statement(topic=topic, text=text, tone="good")


def _tell_lead(faithful: RemovalScores, best: Standing, others: list[Standing]) -> str:
    if not others:
        return ""
    rival = others[0]
    pair = {best.method, rival.method}
    gaps = {
        (one.fill, one.unit): gap_from(one, best.method)
        for one in faithful.comparisons
        if {one.first, one.second} == pair
    }
    ahead, behind = (
        [fill_name(*one) for one, gap in gaps.items() if one in best.tested and getattr(gap, side)]
        for side in ("above_zero", "below_zero")
    )
    name = method_name(rival.method)
    means = f"their mean gains are {signed(best.mean_gain, 3)} and {signed(rival.mean_gain, 3)}"
    if not ahead and not behind:
        return f" {name}, next by its mean gain, is not told apart from it under any fill."
    if not ahead:
        return f" {name}, next by its mean gain, is ahead of it under {listed(behind)}; {means}."
    but = f", and behind it under {listed(behind)}; {means}" if behind else ""
    return f" It is ahead of {name}, the next, under {listed(ahead)}{but}."


_KINDS = {
    r"does not beat a random order": "Methods that do not beat a random order",
    r"no more than the control": "Methods that gain no more than a map that knows nothing of the network",
    r"fill decides|filled image is answered": "Frames in which the fill decides, rather than the map",
    r"rank the methods differently": "Fills that rank the methods differently",
    r"correlates with its last step": "Scores that measure the fill rather than the map",
    r"at an end of the margin": "Answers at an end of the margin, which can move one way only",
    r"still correlates": "Maps that stay alike when all weights are new",
    r"rank nothing|NaN": "Maps that rank nothing",
    r"unexplained, more than": "Maps that do not add up to the change that they explain",
    r"next to nothing to explain": "Frames with next to nothing to explain",
    r"is saturated there": "Frames where the network is saturated, so that gradients say little",
    r"masked passes chose nothing": "Layers in which the passes of Poly-CAM chose nothing: activity only",
    r"so the map is zero": "Maps in which nothing speaks for the answer",
    r"expected to correlate": "Maps from some of the channels that may differ from the exact ones",
    r"hardly surer than they differ": "Maps whose contributions are hardly surer than they differ, for want of pairs",
    r"so small that rounding": "Maps so faint that another engine or machine may give another",
}


def group_alarms(alarms: Iterable[str]) -> dict[str, list[str]]:
    """Group alarms by the kind of what they warn of; one of no known kind stands for itself."""
    groups = defaultdict(list)
    for alarm in alarms:
        shown = name_methods(alarm)
        sentence = f"{shown[:1].upper()}{shown[1:].rstrip('.')}."
        kind = next((kind for pattern, kind in _KINDS.items() if re.search(pattern, alarm)), sentence)
        # the same fill can be found wanting by two scores
        if sentence not in groups[kind]:
            groups[kind].append(sentence)
    return dict(groups)


def alarms_of(results: Results, name: str, stage: str) -> tuple[str, ...]:
    """Alarms of one network's `faithfulness`, `remedies`, `randomisation`, `score` or `explain`."""
    if stage == "explain":
        return tuple(
            f"{method_name(method)}, {source_name(source)}: {warning}"
            for (own, source), explained in results.explanations.items()
            if own == name
            for method, notes in explained.methods.items()
            for warning in notes.warnings
        )
    if stage == "score":
        return tuple(
            alarm if source == results.study.source else f"{source_name(source)}: {alarm}"
            for (own, source), scored in results.scores.items()
            if own == name
            for alarm in scored.alarms
        )
    found = getattr(results.study, stage).get(name)
    return () if found is None else found.alarms


def count_alarms(results: Results) -> tuple[str, ...]:
    """Write a line for each kind of alarm: how often, and of which networks."""
    counts: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for name in inputs_in_order(results.inputs)[::-1]:
        for stage in ("score", "remedies", "faithfulness", "randomisation", "explain"):
            for kind, sentences in group_alarms(alarms_of(results, name, stage)).items():
                counts[kind][input_name(name).lower()] += len(sentences)
    told = {kind: listed([f"{name} {count}" for name, count in own.items()]) for kind, own in counts.items()}
    return tuple(f"{kind.rstrip('.')}: {own.total()} ({told[kind]})" for kind, own in counts.items())
