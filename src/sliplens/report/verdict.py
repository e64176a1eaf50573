"""The verdict: tables of claims about methods and networks, each with its number, interval and outcome."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
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
)
from sliplens.progress import number_of
from sliplens.report.comparisons import (
    compare_errors,
    voting_settings,
    write_ends,
    write_gap,
    write_sample,
)
from sliplens.report.results import Results
from sliplens.results.faithfulness import Faithfulness, Lead
from sliplens.results.study import Truth

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


def judge_results(results: Results, *, claims: Sequence[Verdict] = (), rng: np.random.Generator) -> tuple[Verdict, ...]:
    """Judge everything that a workspace holds, with the claims of the thesis; tables without a row are left out."""
    thesis = [row for claim in claims for row in claim.rows]
    tables: tuple[tuple[str, str, str, Iterable[Row]], ...] = (
        (
            "believe",
            "Which explanation to believe",
            "Number, where the scene can be drawn anew: correlation of a map's sums over groups of markers with the "
            "change of this network's prediction as the group is moved to another margin of the trial; else the mean "
            "symmetric gain of removal, in margin units. A method holds where it beats every map that knows nothing of "
            "what the network learned, "
            f"beyond the 95 % interval over days and trials, of which {FEWEST_UNITS} trials or more are needed.",
            _judge_methods(results) if results.study else (),
        ),
        (
            "thesis",
            "The claims of the thesis",
            "Tested with its methods as published, on networks and data of our own: its network and most of its "
            "data are not here, so that a claim may fail for those reasons too. All comparisons stand below.",
            thesis,
        ),
        (
            "networks",
            "How well each network predicts the margin",
            "Predictions on test trials. R² above zero is better than always predicting the mean label. Each input "
            "stands for one trained network: another seed may change the order.",
            _judge_networks(results, rng=rng),
        ),
        (
            "real-touch",
            "Does it carry over to real touch?",
            "Frames of a real sensor. Holds where the mean error is below that of the best constant prediction.",
            _judge_real_touch(results),
        ),
        (
            "grip-verdict",
            "What the margin holds",
            "Simulated episodes that end in a fall. Run another controller on the same seed to compare the two.",
            _judge_grip(results),
        ),
    )
    judged = [Verdict(id=key, title=title, test=test, rows=tuple(rows)) for key, title, test, rows in tables]
    return tuple(table for table in judged if table.rows)


def cautions(results: Results) -> tuple[str, ...]:
    """Return what limits every row of the verdict: few trials, an unsound sample."""
    choice, sentences = results.study.choice, []
    if choice is not None and len(choice.trials) < FEWEST_UNITS:
        sentences.append(
            f"This study explains {number_of(len(choice.trials), 'trial')}, and fewer than {FEWEST_UNITS} decide "
            "nothing: below is how explanations are judged, not yet which one to believe."
        )
    if choice is not None and not choice.sound:
        sentences.append(f"{write_sample(choice)} An explanation of a wrong prediction explains the error.")
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


# which explanation to believe


@dataclass(frozen=True, kw_only=True)
class Recommended:
    """Method whose map agrees best with the neutral judge, and whether it may be recommended."""

    method: str
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
    """Return the method with the best correlation under the neutral judge; None where there is none."""
    compared = _compared(truth)
    if not compared:
        return None
    name, _, lead = compared[0]
    over = truth.methods[name].lead_over_methods
    tied = sorted((other for other, gap in over.items() if not gap.above_zero), key=lambda other: over[other].estimate)
    return Recommended(method=name, lead=lead, lead_over_methods=over, tied=tuple(tied))


def _compared(truth: Truth) -> list[tuple[str, Difference, Lead]]:
    """Methods with their correlation and lead, the best first."""
    compared = [
        (name, method.neutral, method.lead_over_controls)
        for name, method in truth.methods.items()
        if method.neutral is not None and method.lead_over_controls is not None
    ]
    return sorted(compared, key=lambda item: -item[1].estimate)


def _judge_methods(results: Results) -> Iterator[Row]:
    for name in inputs_in_order(results.study.inputs)[::-1]:
        truth, faithful = results.study.truth.get(name), results.study.faithfulness.get(name)
        if truth is not None and _compared(truth):
            yield from _judge_by_truth(name, truth)
        elif faithful is not None:
            yield from _judge_by_removal(name, faithful, truth)
        else:
            sentence = "Not scored yet; `sliplens study` does that."
            yield Row(claim="Any method", subject=input_name(name), outcome="undecided", sentence=sentence)


def _judge_by_truth(name: str, truth: Truth) -> Iterator[Row]:
    best = recommend(truth)
    assert best is not None
    for method, correlation, lead in _compared(truth):
        outcome, sentence = _compare_by_truth(method, lead, best)
        if correlation.units < FEWEST_UNITS:
            outcome, sentence = "undecided", _too_few(correlation.units)
        yield Row(
            claim=method_name(method),
            subject=input_name(name),
            outcome=outcome,
            sentence=sentence + _scope(correlation),
            number=signed(correlation.estimate, 2),
            interval=write_ends(correlation, digits=2),
        )


def _scope(correlation: Difference) -> str:
    """Say what an interval of one network leaves out."""
    days = "this day" if correlation.days == 1 else "these days"
    return f" For this network on {days}." if correlation.networks == 1 else ""


def _compare_by_truth(method: str, lead: Lead, best: Recommended) -> tuple[Outcome, str]:
    """Judge a method against the strongest control and the other methods."""
    write, control = partial(write_gap, digits=2), method_name(lead.control).removesuffix(" (control)")
    if not lead.shows_something:
        outcome = "does not hold" if lead.gap.below_zero else "undecided"
        return outcome, f"Not shown to beat every control: its lead over {control} is {write(lead.gap)}."
    if method != best.method:
        behind = "Ties with" if method in best.tied else "Behind"
        return "holds", f"{behind} {method_name(best.method)}, by {write(best.lead_over_methods[method])}."
    over, ahead = best.lead_over_methods, f"it leads {control}, the strongest control, by {write(lead.gap)}"
    if best.tied:
        return "holds", f"First, but not shown to be best: {ahead}, and ties with {listed(_titles(best.tied))}."
    if over:
        rival = min(over, key=lambda other: over[other].estimate)
        ahead += f", and {method_name(rival)}, the next method, by {write(over[rival])}"
    return "holds", f"Believe it: {ahead}."


def _titles(methods: Iterable[str]) -> list[str]:
    return [method_name(method) for method in methods]


def _too_few(trials: int) -> str:
    few = "one trial is" if trials == 1 else f"{trials} trials are"
    return f"Not known: {few} too few to tell a method from chance; {FEWEST_UNITS} or more are needed."


def _judge_by_removal(name: str, faithful: Faithfulness, truth: Truth | None) -> Iterator[Row]:
    """Judge methods by the fills under which they beat chance and the best control, the best method first."""
    scores = {score.key: score for score in faithful.scores}
    ranked: list[tuple[bool, float, str, list[str], list[str]]] = []
    for method in methods_in_order(score.method for score in faithful.scores if not score.control):
        leads = {
            setting: lead
            for setting in voting_settings(faithful, truth)
            if (score := scores.get((*setting, method))) and (lead := score.lead_over_controls) is not None
        }
        gain = float(np.mean([scores[*setting, method].srg.estimate for setting in leads])) if leads else -np.inf
        beaten = [fill_name(*setting) for setting, lead in leads.items() if lead.shows_something]
        unbeaten = [fill_name(*setting) for setting, lead in leads.items() if not lead.shows_something]
        ranked.append((len(beaten) > len(unbeaten), gain, method, beaten, unbeaten))
    ranked.sort(key=lambda item: (not item[0], -item[1]))
    for place, (most, gain, method, beaten, unbeaten) in enumerate(ranked):
        outcome: Outcome = "undecided"
        if faithful.trials < FEWEST_UNITS:
            sentence = _too_few(faithful.trials)
        elif not beaten + unbeaten:
            sentence = "Not known: it was compared with a control under no fill that can judge it."
        else:
            outcome = "holds" if most else "undecided" if beaten else "does not hold"
            best = "Believe it: it beats" if place == 0 and most else "Beats"
            fills = f"{len(beaten)} of {len(beaten + unbeaten)} fills"
            except_for = f", not under {listed(unbeaten)}" if unbeaten else ""
            sentence = f"{best} chance and every control under {fills}{except_for}."
        number = signed(gain, 3) if np.isfinite(gain) else ""
        yield Row(
            claim=method_name(method), subject=input_name(name), outcome=outcome, sentence=sentence, number=number
        )


# networks, real touch and the grip


def _judge_networks(results: Results, *, rng: np.random.Generator) -> Iterator[Row]:
    evaluations = results.evaluations
    scores = {name: evaluations[name].conditions for name in inputs_in_order(evaluations)}
    # the network of the smallest error first
    for name in sorted(scores, key=lambda name: np.mean([score.mse for score in scores[name].values()])):
        predictions = evaluations[name].predictions
        trials, days = (len(np.unique(labels)) for labels in (predictions.trial, predictions.day))
        for condition in conditions_in_order(scores[name]):
            score = scores[name][condition]
            useless = score.r2 is not None and score.r2 <= 0
            worth = ", no better than the mean label" if useless else ""
            yield Row(
                claim=f"Predicts the margin on {condition} objects",
                subject=input_name(name),
                # of labels that do not vary there is no R²
                outcome="undecided" if score.r2 is None else "does not hold" if useless else "holds",
                sentence=f"Off by {decimals(100 * score.mae, 1)} percentage points on average{worth}; of one "
                f"network, over {number_of(trials, 'trial')} of {number_of(days, 'day')}.",
                number=f"R² {decimals(score.r2, 2)}",
            )
    for pair in combinations(scores, 2):
        for condition in conditions_in_order(set(scores[pair[0]]) & set(scores[pair[1]])):
            mse = {name: scores[name][condition].mse for name in pair}
            better, worse = sorted(pair, key=lambda name: mse[name])
            tables = [evaluations[name].predictions for name in (worse, better)]
            frames = [table.where(table.condition == condition) for table in tables]
            gap = compare_errors(frames[0], frames[1], rng=rng)
            over = f"over {gap.over}" if gap else "not tested: the networks did not predict the same frames"
            yield Row(
                claim=f"Smaller error than {input_name(worse).lower()} on {condition} objects",
                subject=input_name(better),
                outcome=judge_gap(gap),
                sentence=f"MSE {mse[better]:.4f} against {mse[worse]:.4f}; the number is their difference, {over}.",
                number=decimals(mse[worse] - mse[better], 4),
                interval=write_ends(gap, digits=4),
            )


def _judge_real_touch(results: Results) -> Iterator[Row]:
    real = {name: record for (name, source), record in results.explanations.items() if source == "real"}
    for name in inputs_in_order(real):
        claim, subject = "Predicts real touch better than a constant", input_name(name)
        frames = [frame for frame in real[name].frames if frame.safety_margin is not None]
        if not frames:
            sentence = f"Not known: none of {number_of(len(real[name].frames), 'real frame')} has a label."
            yield Row(claim=claim, subject=subject, outcome="undecided", sentence=sentence)
            continue
        labels = np.array([frame.safety_margin for frame in frames], dtype=np.float64)
        error = np.abs(labels - [frame.prediction for frame in frames]).mean()
        constant = np.abs(labels - np.median(labels)).mean()
        trials = number_of(len({frame.trial for frame in frames}), "trial")
        yield Row(
            claim=claim,
            subject=subject,
            outcome="holds" if error < constant else "does not hold",
            sentence=f"Mean error on {number_of(len(frames), 'frame')} of {trials}; the best constant is off by "
            f"{100 * constant:.0f} points.",
            number=f"{100 * error:.0f} points",
        )


def _judge_grip(results: Results) -> Iterator[Row]:
    if results.grip is None:
        return
    table, setup = results.grip.episodes, results.grip.setup
    count, dropped = len(table), int(table.dropped.sum())
    low, high = binomtest(dropped, count).proportion_ci(method="wilson")
    yield Row(
        claim=f"{setup.object}, {setup.condition}, controller {setup.controller}",
        subject=number_of(count, "episode"),
        outcome=None,
        sentence=f"Pressed {percent(float(table.force_excess.mean()))} harder than the least force that holds.",
        number=f"{percent(dropped / count, digits=1)} fell",
        interval="" if count == 1 else f"{percent(low, digits=1)} to {percent(high, digits=1)}",
    )
