"""The verdict: tables of claims about methods and networks, each with its number, interval and outcome."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import ClassVar, Literal

import numpy as np
from scipy.stats import binomtest

from sliplens.intervals import FEWEST_UNITS, Difference
from sliplens.plots.style import (
    conditions_in_order,
    decimals,
    fill_name,
    input_name,
    inputs_in_order,
    listed,
    method_name,
    methods_in_order,
    percent,
    signed,
    source_name,
    tell_ends,
)
from sliplens.progress import number_of
from sliplens.report.comparisons import (
    against_control,
    compare_errors,
    tell_interval,
    tell_sample,
    voting_settings,
)
from sliplens.report.results import Results
from sliplens.results.faithfulness import CHANCE, Faithfulness, Lead
from sliplens.results.study import Localisation, Truth

Outcome = Literal["holds", "does not hold", "undecided"]
OPPOSITE: dict[Outcome, Outcome] = {"holds": "does not hold", "does not hold": "holds"}
"""Outcome of the opposite claim, where one is decided."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Comparison behind a row of the verdict."""

    where: str
    """Fill and unit, or the score."""
    compared: str
    gap: Difference | None = None
    outcome: Outcome | None = None
    """None where the comparison does not decide."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """Claim about a method or network with its evidence."""

    claim: str
    subject: str
    """Network, or networks, by their inputs."""
    outcome: Outcome | None
    """None where the number is reported but nothing is claimed."""
    sentence: str
    number: str = ""
    interval: str = ""
    """Ends of the 95 % interval."""
    findings: tuple[Finding, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Table of claims that were tested alike."""

    layout: ClassVar[str] = "claim"

    id: str
    title: str
    test: str
    """Meaning of the number, and when a claim holds."""
    rows: tuple[Row, ...]


def judge(results: Results, *, claims: Sequence[Verdict] = (), rng: np.random.Generator) -> tuple[Verdict, ...]:
    """Judge everything that a workspace holds, with the claims of the thesis; tables without a row are left out."""
    study = results.study
    tables = [_judge_methods(results)] if study else []
    tables.append(
        Verdict(
            id="thesis",
            title="The claims of the thesis",
            test="Tested with its methods as published, on networks and data of our own: its network and most of its "
            "data are not here, so that a claim may fail for those reasons too. All comparisons stand below.",
            rows=tuple(row for claim in claims for row in claim.rows),
        )
    )
    tables += [_judge_networks(results, rng=rng), _judge_real_touch(results)]
    # the removal curves of a study say more than deletion does
    tables += [] if study else [_judge_deletion(results, rng=rng)]
    tables += [] if results.grip is None else [_judge_grip(results)]
    return tuple(table for table in tables if table.rows)


def cautions(results: Results) -> tuple[str, ...]:
    """Return what limits every row of the verdict: few trials, an unsound sample, the fill, the scale."""
    choice, sentences = results.study.choice, []
    if choice is not None and len(choice.trials) < FEWEST_UNITS:
        sentences.append(
            f"This study explains {number_of(len(choice.trials), 'trial')}, and fewer than {FEWEST_UNITS} decide "
            "nothing: below is how explanations are judged, not yet which one to believe."
        )
    if choice is not None and not choice.sound:
        sentences.append(f"{tell_sample(choice)} An explanation of a wrong prediction explains the error.")
    if results.scores and not results.study:
        last = [
            f"{np.mean([score.last_step_mean for score in scored.methods.values()]):.2f} "
            f"({input_name(name).lower()}, {source_name(source)}, {scored.fill})"
            for (name, source), scored in sorted(results.scores.items())
        ]
        sentences.append(
            "The deletion score depends on the fill of a removed pixel, and its sign is lost. With every pixel filled, "
            f"where no map has a part, D is {listed(last)}: a score near that measures the fill."
        )
    return tuple(sentences)


def judge_gap(gap: Difference | None) -> Outcome:
    """Judge a difference: above zero for sure, below zero for sure, or neither."""
    if gap is None or not gap.sure:
        return "undecided"
    return "holds" if gap.estimate > 0 else "does not hold"


def all_of(outcomes: Iterable[Outcome]) -> Outcome:
    """Join parts that must all hold: one that does not is enough."""
    distinct = set(outcomes)
    if "does not hold" in distinct:
        return "does not hold"
    return "holds" if distinct == {"holds"} else "undecided"


def most_of(outcomes: Sequence[Outcome]) -> Outcome:
    """Join settings: more than half of them agree, and none says the opposite."""
    for outcome, opposite in OPPOSITE.items():
        if 2 * outcomes.count(outcome) > len(outcomes) and opposite not in outcomes:
            return outcome
    return "undecided"


def write_ends(gap: Difference | None, *, digits: int = 3) -> str:
    """Write the ends of an interval with signs; nothing where there is none."""
    return "" if gap is None else tell_ends(gap, partial(signed, digits=digits))


def _names(names: Iterable[str]) -> list[str]:
    """Sort inputs: difference before raw, and before both what the thesis did not have."""
    return inputs_in_order(names)[::-1]


# which explanation to believe


@dataclass(frozen=True, kw_only=True)
class Recommended:
    """Method whose map ranks the markers most like their Shapley values, and whether it may be recommended."""

    method: str
    correlation: Difference
    lead: Lead
    """Over the strongest control."""
    lead_over_methods: Mapping[str, Difference]
    tied: tuple[str, ...]
    """Other methods that it does not lead for sure, the nearest first."""

    @property
    def shown(self) -> bool:
        """True where its lead over every control and over every other method is off zero."""
        return self.lead.shows_something and not self.tied


def recommend(truth: Truth) -> Recommended | None:
    """Return the method with the best correlation with the Shapley values; None where there is none."""
    compared = _compared(truth)
    if not compared:
        return None
    name, (correlation, lead) = compared[0]
    over = truth.methods[name].lead_over_methods
    tied = sorted((other for other, gap in over.items() if not gap.above_zero), key=lambda other: over[other].estimate)
    return Recommended(method=name, correlation=correlation, lead=lead, lead_over_methods=over, tied=tuple(tied))


def _compared(truth: Truth) -> list[tuple[str, tuple[Difference, Lead]]]:
    """Methods with their correlation and lead, the best first."""
    compared = {
        name: (method.shapley, method.lead_over_controls)
        for name, method in truth.methods.items()
        if method.shapley is not None and method.lead_over_controls is not None
    }
    return sorted(compared.items(), key=lambda item: -item[1][0].estimate)


def _judge_methods(results: Results) -> Verdict:
    rows: list[Row] = []
    for name in _names(results.study.inputs):
        truth, faithful = results.study.truth.get(name), results.study.faithfulness.get(name)
        if truth is not None and _compared(truth):
            rows += _judge_by_truth(name, truth)
        elif faithful is not None:
            rows += _judge_by_removal(name, faithful, truth)
        else:
            sentence = "Not scored yet; `sliplens study` does that."
            rows.append(Row(claim="Any method", subject=input_name(name), outcome="undecided", sentence=sentence))
    return Verdict(
        id="believe",
        title="Which explanation to believe",
        test="Number, where the scene can be drawn anew: signed rank correlation of a map's means over the markers "
        "with their Shapley values in this network's prediction; else the mean symmetric gain of removal, in margin "
        "units. A method holds where it beats every map that knows nothing of what the network learned, beyond the "
        f"95 % interval over days and trials, of which {FEWEST_UNITS} trials or more are needed.",
        rows=tuple(rows),
    )


_KIN = ("shapley-marker", "shapley", "integrated-gradients", "integrated-gradients-thesis", "expected-gradients")
"""Methods that share out the prediction by the rule of Shapley, as the truth does."""


def _judge_by_truth(name: str, truth: Truth) -> list[Row]:
    best, rows = recommend(truth), []
    assert best is not None
    few = best.correlation.units < FEWEST_UNITS
    for method, (correlation, lead) in _compared(truth):
        control = method_name(lead.control).removesuffix(" (control)")
        if few:
            outcome, sentence = "undecided", f"Not known: {_too_few(correlation.units)}."
        else:
            outcome = "holds" if lead.shows_something else "does not hold" if lead.gap.below_zero else "undecided"
            sentence = _sentence_by_truth(method, best, truth.methods[method], control)
        kin = " Kin to this truth by construction." if method in _KIN else ""
        rows.append(
            Row(
                claim=method_name(method),
                subject=input_name(name),
                outcome=outcome,
                sentence=f"{sentence}{kin}",
                number=signed(correlation.estimate, 2),
                interval=write_ends(correlation, digits=2),
            )
        )
    return rows


def _sentence_by_truth(method: str, best: Recommended, record: Localisation, control: str) -> str:
    lead = record.lead_over_controls
    assert lead is not None
    interval = partial(tell_interval, digits=2)
    if not lead.shows_something:
        return f"Not shown to beat every control: its lead over {control} is {interval(lead.gap)}."
    if method != best.method:
        behind = "Ties with" if method in best.tied else "Behind"
        return f"{behind} {method_name(best.method)}, by {interval(best.lead_over_methods[method])}."
    over = best.lead_over_methods
    ahead = f"it leads {control}, the strongest control, by {interval(lead.gap)}"
    if best.tied:
        tied = listed([method_name(other) for other in best.tied])
        return f"First, but not shown to be best: {ahead}, and ties with {tied}."
    if not over:
        return f"Believe it: {ahead}."
    rival = min(over, key=lambda other: over[other].estimate)
    return f"Believe it: {ahead}, and {method_name(rival)}, the next method, by {interval(over[rival])}."


def _too_few(trials: int) -> str:
    few = "one trial is" if trials == 1 else f"{trials} trials are"
    return f"{few} too few to tell a method from chance; {FEWEST_UNITS} or more are needed"


@dataclass(frozen=True, kw_only=True)
class Standing:
    """Settings (fill, unit) in which a method gains for sure, against chance and the best control."""

    method: str
    beaten: tuple[tuple[str, str], ...]
    tested: tuple[tuple[str, str], ...]
    """Settings in which it was compared with a control."""
    mean_gain: float
    """Symmetric relevance gain, mean over those settings, in margin units."""

    @property
    def qualifies(self) -> bool:
        """True where it beats the controls in most settings."""
        return 2 * len(self.beaten) > len(self.tested)


def rank_methods(faithful: Faithfulness, truth: Truth | None = None) -> list[Standing]:
    """Rank the methods: those that beat the best control in most settings first, by their gain.

    A fill counts once. Fills under which a map made from the truth does not win for sure are left out.
    """
    scores = {score.key: score for score in faithful.scores}
    standings = []
    for method in methods_in_order(score.method for score in faithful.scores if not score.control):
        leads = {
            setting: lead
            for setting in voting_settings(faithful, truth)
            if (*setting, method) in scores and (lead := scores[*setting, method].lead_over_controls) is not None
        }
        gains = [scores[*setting, method].srg.estimate for setting in leads]
        standings.append(
            Standing(
                method=method,
                beaten=tuple(setting for setting, lead in leads.items() if lead.shows_something),
                tested=tuple(leads),
                mean_gain=float(np.mean(gains)) if gains else float("-inf"),
            )
        )
    return sorted(standings, key=lambda standing: (not standing.qualifies, -standing.mean_gain))


def _judge_by_removal(name: str, faithful: Faithfulness, truth: Truth | None) -> list[Row]:
    ranked, rows = rank_methods(faithful, truth), []
    for place, standing in enumerate(ranked):
        outcome: Outcome = "undecided"
        if faithful.trials < FEWEST_UNITS:
            sentence = f"Not known: {_too_few(faithful.trials)}."
        elif not standing.tested:
            sentence = "Not known: it was compared with a control under no fill that can judge it."
        else:
            outcome = "holds" if standing.qualifies else "does not hold" if not standing.beaten else "undecided"
            lost = [fill_name(*setting) for setting in standing.tested if setting not in standing.beaten]
            but = f", not under {listed(lost)}" if lost else ""
            best = "Believe it: it beats" if place == 0 and standing.qualifies else "Beats"
            sentence = (
                f"{best} chance and every control under {len(standing.beaten)} of {len(standing.tested)} fills{but}."
            )
        rows.append(
            Row(
                claim=method_name(standing.method),
                subject=input_name(name),
                outcome=outcome,
                sentence=sentence,
                number=signed(standing.mean_gain, 3) if standing.tested else "",
            )
        )
    return rows


# networks, deletion without a study, real touch and the grip


def _judge_networks(results: Results, *, rng: np.random.Generator) -> Verdict:
    evaluations, rows = results.evaluations, []
    scores = {name: evaluations[name].conditions for name in inputs_in_order(evaluations)}
    # the network of the smallest error first
    for name in sorted(scores, key=lambda name: np.mean([score.mse for score in scores[name].values()])):
        predictions = evaluations[name].predictions
        trials, days = (len(np.unique(labels)) for labels in (predictions.trial, predictions.day))
        for condition in conditions_in_order(scores[name]):
            score = scores[name][condition]
            useless = score.r2 is not None and score.r2 <= 0
            worth = ", no better than the mean label" if useless else ""
            rows.append(
                Row(
                    claim=f"Predicts the margin on {condition} objects",
                    subject=input_name(name),
                    # of labels that do not vary there is no R²
                    outcome="undecided" if score.r2 is None else "does not hold" if useless else "holds",
                    sentence=f"Off by {decimals(100 * score.mae, 1)} percentage points on average{worth}; of one "
                    f"network, over {number_of(trials, 'trial')} of {number_of(days, 'day')}.",
                    number=f"R² {decimals(score.r2, 2)}",
                )
            )
    rows += [
        _compare_networks(results, (first, second), condition, rng=rng)
        for first, second in combinations(scores, 2)
        for condition in conditions_in_order(set(scores[first]) & set(scores[second]))
    ]
    return Verdict(
        id="networks",
        title="How well each network predicts the margin",
        test="Predictions on test trials. R² above zero is better than always predicting the mean label. Each input "
        "stands for one trained network: another seed may change the order.",
        rows=tuple(rows),
    )


def _compare_networks(results: Results, names: tuple[str, str], condition: str, *, rng: np.random.Generator) -> Row:
    both = {name: results.evaluations[name] for name in names}
    mse = {name: evaluation.conditions[condition].mse for name, evaluation in both.items()}
    better, worse = sorted(mse, key=lambda name: mse[name])
    frames = [both[name].predictions.where(both[name].predictions.condition == condition) for name in (worse, better)]
    gap = compare_errors(frames[0], frames[1], rng=rng)
    over = "not tested: the networks did not predict the same frames" if gap is None else f"over {gap.over}"
    return Row(
        claim=f"Smaller error than {input_name(worse).lower()} on {condition} objects",
        subject=input_name(better),
        outcome=judge_gap(gap),
        sentence=f"MSE {mse[better]:.4f} against {mse[worse]:.4f}; the number is their difference, {over}.",
        number=decimals(mse[worse] - mse[better], 4),
        interval=write_ends(gap, digits=4),
    )


def _judge_deletion(results: Results, *, rng: np.random.Generator) -> Verdict:
    rows = []
    for key in sorted(results.scores, key=lambda key: (key[1] == "real", key[0] != "raw", key)):
        scored = results.scores[key]
        source = "" if scored.source == "simulated" else f", {source_name(scored.source)}"
        methods = {name: score for name, score in scored.methods.items() if name != CHANCE}
        for name in sorted(methods, key=lambda name: methods[name].mean):
            chance = scored.methods.get(CHANCE)
            gap = None if chance is None else against_control(scored, name, rng=rng)
            against = (
                "no random control was scored, so that chance is not ruled out"
                if chance is None or gap is None
                else f"a random order has {chance.mean:.3f} ± {chance.sd:.3f}, and the difference is "
                f"{tell_interval(gap)}"
            )
            rows.append(
                Row(
                    claim=f"{method_name(name)} beats a random order",
                    subject=f"{input_name(scored.input)}{source}",
                    outcome=OPPOSITE.get(judge_gap(gap), "undecided"),
                    sentence=f"Deletion score D; {against}.",
                    number=f"{methods[name].mean:.3f} ± {methods[name].sd:.3f}",
                )
            )
    return Verdict(
        id="deletion-verdict",
        title="Which explanation scores best by deletion",
        test="Mean ± standard deviation of D over frames, lower is better; holds where D lies below that of a random "
        "order, beyond the 95 % interval.",
        rows=tuple(rows),
    )


def _judge_real_touch(results: Results) -> Verdict:
    real = {name: record for (name, source), record in results.explanations.items() if source == "real"}
    rows = []
    for name in inputs_in_order(real):
        frames = [frame for frame in real[name].frames if frame.safety_margin is not None]
        claim, subject = "Predicts real touch better than a constant", input_name(name)
        if not frames:
            sentence = f"Not known: none of {number_of(len(real[name].frames), 'real frame')} has a label."
            rows.append(Row(claim=claim, subject=subject, outcome="undecided", sentence=sentence))
            continue
        labelled = [(frame.safety_margin or 0.0, frame.prediction) for frame in frames]
        labels, predictions = np.array(labelled, dtype=np.float64).T
        error, constant = np.abs(predictions - labels).mean(), np.abs(labels - np.median(labels)).mean()
        # frames with equal labels have no order
        pairs = [(first, second) for first, second in combinations(labelled, 2) if first[0] != second[0]]
        right = sum((first[0] - second[0]) * (first[1] - second[1]) > 0 for first, second in pairs)
        order = f"; {right} of {number_of(len(pairs), 'pair')} of frames are in order (chance: half)" if pairs else ""
        trials = number_of(len({frame.trial for frame in frames}), "trial")
        rows.append(
            Row(
                claim=claim,
                subject=subject,
                outcome="holds" if error < constant else "does not hold",
                sentence=f"Mean error on {number_of(len(frames), 'frame')} of {trials}; the best constant is off by "
                f"{100 * constant:.0f} points{order}.",
                number=f"{100 * error:.0f} points",
            )
        )
    return Verdict(
        id="real-touch",
        title="Does it carry over to real touch?",
        test="Frames of a real sensor. Holds where the mean error is below that of the best constant prediction.",
        rows=tuple(rows),
    )


def _judge_grip(results: Results) -> Verdict:
    grip = results.grip
    assert grip is not None
    table, setup, count = grip.episodes, grip.setup, len(grip.episodes)
    excess = percent(float(table.force_excess.mean()))
    dropped = int(table.dropped.sum())
    low, high = binomtest(dropped, count).proportion_ci(method="wilson")
    return Verdict(
        id="grip-verdict",
        title="What the margin holds",
        test="Simulated episodes that end in a fall. Another controller has to be run on the same seed to be compared.",
        rows=(
            Row(
                claim=f"{setup.object}, {setup.condition}, controller {setup.controller}",
                subject=number_of(count, "episode"),
                outcome=None,
                sentence=f"Pressed {excess} harder than the least force that holds.",
                number=f"{percent(dropped / count, digits=1)} fell",
                interval="" if count == 1 else f"{percent(low, digits=1)} to {percent(high, digits=1)}",
            ),
        ),
    )
