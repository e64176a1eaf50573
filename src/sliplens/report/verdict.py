"""The verdict: can the maps be trusted, which method is ahead of the controls, how well do the networks predict."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from importlib.resources import as_file, files
from itertools import combinations
from typing import ClassVar, Literal

import numpy as np
from scipy.stats import binomtest

from sliplens.codec import load_record
from sliplens.intervals import FEWEST_UNITS, Difference
from sliplens.plots.style import (
    UNKNOWN,
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
from sliplens.report.comparisons import compare_errors, voting_settings, write_ends, write_gap, write_sample
from sliplens.report.results import Results
from sliplens.results.faithfulness import Faithfulness
from sliplens.results.study import CLOSE_TO_LABELS, Truth

Outcome = Literal["holds", "does not hold", "undecided"]
Status = Literal["ahead", "tied", "behind", "no verdict"]
LEAST_R2 = 0.7
"""R2 on test trials below which a network's maps get no verdict."""


@dataclass(frozen=True, kw_only=True)
class MethodRow:
    """A method beside the best control."""

    input: str
    method: str
    score: str
    """Agreement with the neutral truth, or the symmetric gain where the scene cannot be drawn anew."""
    control: str
    lead: str
    """Score less that of the strongest control, with its 95 % interval."""
    status: Status
    """Lead above zero for sure, neither, or below zero for sure."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """Claim about a network or grip with its evidence."""

    claim: str
    subject: str
    outcome: Outcome | None
    """None where the number is reported but nothing is claimed."""
    sentence: str
    number: str = ""
    interval: str = ""
    """Ends of the 95 % interval."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Table of claims that were tested alike."""

    layout: ClassVar[str] = "verdict"

    id: str
    title: str
    test: str
    """Meaning of the number, and when a claim holds."""
    rows: tuple[Row, ...]


def judge_results(results: Results, *, rng: np.random.Generator) -> tuple[Verdict, ...]:
    """Judge networks, real touch and grip of a workspace; tables without a row are left out."""
    tables: tuple[tuple[str, str, str, Iterable[Row]], ...] = (
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
            "Frames of a real sensor. Holds where it beats the best constant prediction on five trials or more.",
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


# can these maps be trusted?


def test_r2(results: Results, name: str) -> float | None:
    """R2 of a network on test trials of the study's condition; None where it was not evaluated."""
    evaluation, choice = results.evaluations.get(name), results.study.choice
    score = evaluation and evaluation.conditions.get(choice.condition if choice else "dry")
    return score.r2 if score else None


def why_no_verdict(results: Results, name: str) -> str | None:
    """Reason why the maps of a network get no verdict; None where they may."""
    r2, choice = test_r2(results, name), results.study.choice
    if r2 is not None and r2 < LEAST_R2:
        return f"the network has R² {r2:.2f} on test trials, and its maps need {LEAST_R2:g}"
    if choice is not None and choice.close < FEWEST_UNITS:
        return (
            f"{number_of(choice.close, 'trial')} of {len(choice.trials)} are predicted within "
            f"{100 * max(choice.tolerance, CLOSE_TO_LABELS):g} points, and {FEWEST_UNITS} are needed: a map of a wrong "
            "prediction explains the error"
        )
    return None


def judge_study(results: Results) -> tuple[MethodRow, ...]:
    """Judge the methods of all networks: by the neutral truth where the scene can be drawn anew, else by removal."""
    rows: list[MethodRow] = []
    for name in inputs_in_order(results.study.inputs)[::-1]:
        truth, faithful = results.study.truth.get(name), results.study.faithfulness.get(name)
        reason = why_no_verdict(results, name)
        if truth is not None and any(method.neutral is not None for method in truth.methods.values()):
            rows += judge_methods(truth, verdict=reason is None)
        elif faithful is not None:
            rows += _judge_by_removal(name, faithful, truth, verdict=reason is None)
    return tuple(rows)


def judge_methods(truth: Truth, *, verdict: bool = True) -> list[MethodRow]:
    """Judge methods by the neutral truth, the best first; without a verdict where there is to be none."""
    compared = [
        (method.neutral, name, method.lead_over_controls)
        for name, method in truth.methods.items()
        if method.neutral is not None and method.lead_over_controls is not None
    ]
    write = partial(write_gap, digits=2)
    return [
        MethodRow(
            input=truth.input,
            method=name,
            score=write(score),
            control=f"{method_name(lead.control).removesuffix(' (control)')}, "
            f"{signed(abs(score.estimate - lead.gap.estimate), 2)}",
            lead=write(lead.gap),
            status=_status(lead.gap) if verdict and score.units >= FEWEST_UNITS else "no verdict",
        )
        for score, name, lead in sorted(compared, key=lambda item: -item[0].estimate)
    ]


def _status(gap: Difference) -> Status:
    return "ahead" if gap.above_zero else "behind" if gap.below_zero else "tied"


def _judge_by_removal(name: str, faithful: Faithfulness, truth: Truth | None, *, verdict: bool) -> list[MethodRow]:
    """Judge methods by the fills under which they beat chance and the best control, the best method first."""
    scores = {score.key: score for score in faithful.scores}
    ranked: list[tuple[float, MethodRow]] = []
    for method in methods_in_order(score.method for score in faithful.scores if not score.control):
        leads = {
            setting: lead
            for setting in voting_settings(faithful, truth)
            if (score := scores.get((*setting, method))) and (lead := score.lead_over_controls) is not None
        }
        gain = float(np.mean([scores[*setting, method].srg.estimate for setting in leads])) if leads else -np.inf
        ahead = [fill_name(*setting) for setting, lead in leads.items() if lead.shows_something]
        status: Status = "ahead" if 2 * len(ahead) > len(leads) else "tied" if ahead else "behind"
        row = MethodRow(
            input=name,
            method=method,
            score=signed(gain, 3) if leads else UNKNOWN,
            control="the best under each fill",
            lead=f"ahead under {len(ahead)} of {number_of(len(leads), 'fill')}",
            status=status if verdict and leads and faithful.trials >= FEWEST_UNITS else "no verdict",
        )
        ranked.append((gain, row))
    return [row for _, row in sorted(ranked, key=lambda item: -item[0])]


def answer_trust(rows: Sequence[MethodRow], reasons: Sequence[str | None]) -> str:
    """Answer in one sentence an input whether its maps can be trusted."""
    sentences = []
    for name in dict.fromkeys(row.input for row in rows):
        of_input = [row for row in rows if row.input == name]
        ahead = [method_name(row.method) for row in of_input if row.status == "ahead"]
        rest = [method_name(row.method) for row in of_input if row.status in {"tied", "behind"}]
        subject = input_name(name)
        if ahead:
            sentences.append(
                f"{subject}: yes, {listed(ahead)}"
                + (
                    f"; no, {listed(rest)}, which do no better than a map that knows nothing of the network"
                    if rest
                    else ""
                )
            )
        elif rest:
            sentences.append(f"{subject}: no; no method is ahead of a map that knows nothing of the network")
        else:
            sentences.append(f"{subject}: not known")
    because = [f"{reason[:1].upper()}{reason[1:]}." for reason in dict.fromkeys(filter(None, reasons))]
    return " ".join([f"{sentence}." for sentence in sentences] + because)


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


# networks, real touch and the grip


def _judge_networks(results: Results, *, rng: np.random.Generator) -> Iterator[Row]:
    evaluations = results.evaluations
    scores = {name: evaluations[name].conditions for name in inputs_in_order(evaluations)}
    # the network of the smallest error first
    for name in sorted(scores, key=lambda name: np.mean([score.mse for score in scores[name].values()])):
        predictions = evaluations[name].predictions
        for condition in conditions_in_order(scores[name]):
            score, of_condition = scores[name][condition], predictions.condition == condition
            trials, days = (len(np.unique(every[of_condition])) for every in (predictions.trial, predictions.day))
            useless = score.r2 is not None and score.r2 <= 0
            outcome, worth = ("does not hold", ", no better than the mean label") if useless else ("holds", "")
            yield Row(
                claim=f"Predicts the margin on {condition} objects",
                subject=input_name(name),
                # of labels that do not vary there is no R²
                outcome=outcome if score.r2 is not None and trials >= FEWEST_UNITS else "undecided",
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
        trials = len({frame.trial for frame in frames})
        worth = "holds" if error < constant else "does not hold"
        yield Row(
            claim=claim,
            subject=subject,
            outcome="undecided" if trials < FEWEST_UNITS else worth,
            sentence=f"Mean error on {number_of(len(frames), 'frame')} of {number_of(trials, 'trial')}; the best "
            f"constant is off by {100 * constant:.0f} points.",
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


# the claims of the thesis, as they come with the package (`python benchmarks/claims.py`)


@dataclass(frozen=True, kw_only=True)
class ClaimRow:
    """A claim of the thesis with its number, ours, and what follows."""

    source: str
    """Table or figure of the thesis."""
    claim: str
    subject: str
    thesis: str
    ours: str
    """Estimate and 95 % interval."""
    outcome: Outcome
    why: str


@dataclass(frozen=True, kw_only=True)
class ShiftPoint:
    """R2 of the networks on test trials seen by a shifted camera."""

    shift_px: float
    r2: dict[str, tuple[float, float, float]]
    """Estimate and ends of the 95 % interval, by input."""


@dataclass(frozen=True, kw_only=True)
class ThesisRecord:
    """Results on the networks of the thesis that come with the package."""

    sample: str
    claims: tuple[ClaimRow, ...]
    methods: tuple[MethodRow, ...]
    """Of the test trials."""
    shift: tuple[ShiftPoint, ...]
    shift_frames: str


@cache
def load_thesis() -> ThesisRecord:
    """Load the record that comes with the package."""
    with as_file(files("sliplens.report") / "thesis.json") as path:
        return load_record(path, ThesisRecord, command="python benchmarks/claims.py")
