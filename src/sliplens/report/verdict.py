"""The verdict: can the maps be trusted, which method is ahead of the controls, how well do the networks predict.

The thesis's figures are of real touch on another sensor, so other data.

References
----------
Polak, *Explainable Neural Networks for Incipient Slip Sensing in Robot Tactile Learning*, Tables 1 and 2; Table 2 with
the third digit of the recorded scores, the seconds on an RTX 3060 Ti and without device synchronisation.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import combinations
from pathlib import Path
from typing import Literal

import numpy as np

from sliplens.codec import load_record
from sliplens.intervals import FEWEST_UNITS, Difference, paired_difference
from sliplens.plots import style
from sliplens.progress import number_of
from sliplens.results.evaluation import RegressionScores, ScoredFrames
from sliplens.results.faithfulness import Faithfulness
from sliplens.results.study import CLOSE_TO_LABELS, TABLES, Study, Truth

CITATION = (
    "Max Polak, Explainable Neural Networks for Incipient Slip Sensing in Robot Tactile Learning, Master's thesis, "
    "Delft University of Technology"
)
MARK = "thesis (real touch, other data)"

AS_RUN = "-thesis"
"""Ends the names of the methods that are run as the thesis ran them."""

ACCURACY: dict[tuple[str, str], tuple[float, float]] = {
    ("raw", "dry"): (1.87e-2, 0.85),
    ("raw", "wet"): (5.07e-2, 0.57),
    ("difference", "dry"): (1.44e-2, 0.89),
    ("difference", "wet"): (4.02e-2, 0.66),
}
"""MSE in squared margin units and R2, by input and condition."""

DELETION: dict[tuple[str, str], tuple[float, float]] = {
    ("difference", "grad-cam"): (0.325, 0.106),
    ("difference", "integrated-gradients"): (0.272, 0.158),
    ("difference", "poly-cam"): (0.200, 0.146),
    ("raw", "grad-cam"): (0.539, 0.101),
    ("raw", "integrated-gradients"): (0.677, 0.118),
    ("raw", "poly-cam"): (0.512, 0.203),
}
"""Mean and standard deviation of D_AUC, by input and method."""

SECONDS: dict[str, float] = {"grad-cam": 0.029, "integrated-gradients": 0.27, "poly-cam": 4.9}
"""Seconds an image, by method."""

Outcome = Literal["holds", "does not hold", "undecided"]
Status = Literal["ahead", "tied", "behind", "no verdict"]
LEAST_R2 = 0.7
"""R2 on test trials below which a network's maps get no verdict."""
SHOWN_R2 = 0.5
"""R2 on test trials below which a network's maps are not shown."""


def thesis_row(method: str, among: Collection[str]) -> str:
    """Name the thesis's method that a method stands beside; empty if there is none.

    The thesis's numbers stand beside the methods run as in the thesis, and beside ours only where those were not run.
    """
    return "" if method + AS_RUN in among else method.removesuffix(AS_RUN)


def compare_errors(first: ScoredFrames, second: ScoredFrames, *, rng: np.random.Generator) -> Difference | None:
    """Difference in MSE of two networks, over days and trials; None unless both predicted the same frames."""
    first, second = (rows.where(np.lexsort((rows.frame, rows.trial))) for rows in (first, second))
    same = [np.array_equal(getattr(first, key), getattr(second, key)) for key in ("trial", "frame")]
    if not len(first.trial) or not all(same):
        return None
    errors = [(rows.prediction - rows.safety_margin) ** 2 for rows in (first, second)]
    return paired_difference(errors[0], errors[1], clusters=[first.day, first.trial], rng=rng)


def settings(faithful: Faithfulness) -> list[tuple[str, str]]:
    """Fills and units that were scored, in the order they are read."""
    scored = {(fill, unit) for fill, unit, _ in faithful.curves}
    fills = style.in_order({fill for fill, _ in scored}, style.FILL_NAMES)
    units = style.in_order({unit for _, unit in scored}, style.UNIT_NAMES)
    return [(fill, unit) for unit in units for fill in fills if (fill, unit) in scored]


def voting_settings(faithful: Faithfulness, *truths: Truth | None) -> list[tuple[str, str]]:
    """One setting of each fill, by pixels where it is: a fill tried with several units would vote as often.

    Fills under which a map made from one of the truths does not win for sure cannot judge a map and have no vote.
    """
    scored = settings(faithful)
    units = {fill: (fill, unit) for fill, unit in reversed(scored)}
    unfit = {test.fill for truth in truths if truth is not None for test in truth.meta if not test.holds}
    return [setting for setting in scored if units[setting[0]] == setting and setting[0] not in unfit]


def write_ends(gap: Difference, write: Callable[[float], str]) -> str:
    """Write the ends of a 95 % interval, or that there is none."""
    ends = gap.low is not None and gap.high is not None and (gap.low, gap.high)
    return " to ".join(map(write, ends)) if ends else "no interval of one trial"


def write_gap(gap: Difference | None, *, digits: int = 3) -> str:
    """Write an estimate with its 95 % interval, or a dash."""
    write = partial(style.signed, digits=digits)
    return style.UNKNOWN if gap is None else f"{write(gap.estimate)} ({write_ends(gap, write)})"


@dataclass(frozen=True, kw_only=True)
class MethodRow:
    """A method beside the best control."""

    input: str
    method: str
    score: str
    """Agreement with the neutral truth, or the symmetric gain where the scene cannot be drawn again."""
    control: str
    lead: str
    """Score less that of the strongest control, with its 95 % interval."""
    status: Status
    """Lead above zero for sure, neither, or below zero for sure."""
    stick: str = ""
    shapley: str = ""
    """Agreement with Shapley values of the stick game and of the untouched game; empty where unknown."""


@dataclass(frozen=True, kw_only=True)
class ClaimRow:
    """A claim with its number and what follows, and for claims of the thesis its place and number there."""

    source: str = ""
    """Table or figure of the thesis."""
    claim: str
    subject: str
    thesis: str = ""
    ours: str
    """Estimate and 95 % interval."""
    outcome: Outcome
    why: str


def judge_gap(gap: Difference | None) -> Outcome:
    """Judge a difference: above zero for sure, below zero for sure, or neither."""
    if gap is None or not gap.sure:
        return "undecided"
    return "holds" if gap.estimate > 0 else "does not hold"


def scores_by_condition(results: Study) -> dict[str, dict[str, RegressionScores]]:
    """Scores of the networks on test trials by condition and input, in the order they are read."""
    scores = {name: results.evaluations[name].conditions for name in style.inputs_in_order(results.evaluations)}
    conditions = style.conditions_in_order(condition for each in scores.values() for condition in each)
    return {
        condition: {name: each[condition] for name, each in scores.items() if condition in each}
        for condition in conditions
    }


# can these maps be trusted?


def test_r2(results: Study, name: str) -> float | None:
    """R2 of a network on test trials of the study's condition; None where it was not evaluated."""
    evaluation, condition = results.evaluations.get(name), results.choice.condition if results.choice else "dry"
    score = evaluation and evaluation.conditions.get(condition)
    return score.r2 if score else None


def without_weak(results: Study) -> tuple[Study, tuple[str, ...]]:
    """Leave out maps of networks that predict too badly to be explained, and say so."""
    scores = {name: test_r2(results, name) for name in results.evaluations}
    weak = [name for name, r2 in scores.items() if r2 is not None and r2 < SHOWN_R2]
    if not weak:
        return results, ()
    # real frames may be explained by another network of the same input
    tables = {
        table: {name: record for name, record in getattr(results, table).items() if name not in weak}
        for table in TABLES.values()
        if table != "evaluations"
    }
    strip = None if results.strip is not None and results.strip.input in weak else results.strip
    text = (
        f"The maps of {style.listed([style.input_name(name).lower() for name in weak])} are not shown: a network with "
        f"R² under {SHOWN_R2:g} on test trials has nothing to explain but its errors."
    )
    return replace(results, strip=strip, **tables), (text,)


def why_no_verdict(results: Study, name: str) -> str | None:
    """Reason why the maps of a network get no verdict; None where they may."""
    r2, choice = test_r2(results, name), results.choice
    if r2 is not None and r2 < LEAST_R2:
        return f"the network has R² {r2:.2f} on test trials, and its maps need {LEAST_R2:g}"
    if choice is not None and choice.close < FEWEST_UNITS:
        return (
            f"{number_of(choice.close, 'trial')} of {len(choice.trials)} are predicted within "
            f"{100 * max(choice.tolerance, CLOSE_TO_LABELS):g} points, and {FEWEST_UNITS} are needed: a map of a wrong "
            "prediction explains the error"
        )
    return None


def judge_study(results: Study) -> tuple[MethodRow, ...]:
    """Judge the methods of all networks: by the neutral truth where the scene can be drawn again, else by removal."""
    rows: list[MethodRow] = []
    for name in style.inputs_in_order({*results.truth, *results.faithfulness})[::-1]:
        truth, faithful = results.truth.get(name), results.faithfulness.get(name)
        verdict = why_no_verdict(results, name) is None
        if truth is not None and any(method.neutral is not None for method in truth.methods.values()):
            rows += judge_methods(truth, verdict=verdict)
        elif faithful is not None:
            rows += _judge_by_removal(faithful, truth, verdict=verdict)
    return tuple(rows)


def judge_methods(truth: Truth, *, verdict: bool = True) -> list[MethodRow]:
    """Judge methods by the neutral truth, the best first; without a verdict where there is to be none."""
    rows, write = [], partial(write_gap, digits=2)
    for name, method in truth.methods.items():
        score, lead = method.neutral, method.lead_over_controls
        if score is None or lead is None:
            continue
        control = style.method_name(lead.control).removesuffix(" (control)")
        status: Status = "ahead" if lead.gap.above_zero else "behind" if lead.gap.below_zero else "tied"
        row = MethodRow(
            input=truth.input,
            method=name,
            score=write(score),
            control=f"{control}, {style.signed(abs(score.estimate - lead.gap.estimate), 2)}",
            lead=write(lead.gap),
            stick=write(method.stick),
            shapley=write(method.shapley),
            status=status if verdict and score.units >= FEWEST_UNITS else "no verdict",
        )
        rows.append((score.estimate, row))
    return [row for _, row in sorted(rows, key=lambda item: -item[0])]


def _judge_by_removal(faithful: Faithfulness, truth: Truth | None, *, verdict: bool) -> list[MethodRow]:
    """Judge methods by the fills under which they beat chance and the best control, the best method first."""
    scores, rows = {score.key: score for score in faithful.scores}, []
    for method in style.methods_in_order(score.method for score in faithful.scores if not score.control):
        voting = [scores.get((*setting, method)) for setting in voting_settings(faithful, truth)]
        judged = [(score, score.lead_over_controls) for score in voting if score and score.lead_over_controls]
        gain = float(np.mean([score.srg.estimate for score, _ in judged])) if judged else -np.inf
        ahead = sum(lead.gap.above_zero for _, lead in judged)
        status: Status = "ahead" if 2 * ahead > len(judged) else "tied" if ahead else "behind"
        row = MethodRow(
            input=faithful.input,
            method=method,
            score=style.signed(gain, 3) if judged else style.UNKNOWN,
            control="the best under each fill",
            lead=f"ahead under {ahead} of {number_of(len(judged), 'fill')}",
            status=status if verdict and judged and faithful.trials >= FEWEST_UNITS else "no verdict",
        )
        rows.append((gain, row))
    return [row for _, row in sorted(rows, key=lambda item: -item[0])]


def answer_trust(rows: Sequence[MethodRow], reasons: Iterable[str | None] = ()) -> str:
    """Answer in one sentence an input whether its maps can be trusted."""
    answer = []
    for name in dict.fromkeys(row.input for row in rows):
        judged = {row.method: row.status for row in rows if row.input == name}
        ahead = [style.method_name(method) for method, status in judged.items() if status == "ahead"]
        rest = [style.method_name(method) for method, status in judged.items() if status in {"tied", "behind"}]
        nothing = "a map that uses nothing of the network"
        text = (
            f"yes, {style.listed(ahead)}" if ahead else f"no; no method is ahead of {nothing}" if rest else "not known"
        )
        text += f"; no, {style.listed(rest)}, which do no better than {nothing}" if ahead and rest else ""
        answer.append(f"{style.input_name(name)}: {text}.")
    answer += [f"{reason[:1].upper()}{reason[1:]}." for reason in dict.fromkeys(filter(None, reasons))]
    return " ".join(answer)


def cautions(results: Study) -> tuple[str, ...]:
    """Return what limits every row of the verdict: few trials, an unsound sample."""
    choice, sentences = results.choice, []
    if choice is not None and len(choice.trials) < FEWEST_UNITS:
        sentences.append(
            f"This study explains {number_of(len(choice.trials), 'trial')}, and fewer than {FEWEST_UNITS} decide "
            "nothing: below is how explanations are judged, not yet which one to believe."
        )
    if choice is not None and not choice.sound:
        sentences.append(f"{choice.summary} An explanation of a wrong prediction explains the error.")
    return tuple(sentences)


# networks and real touch


def judge_accuracy(score: RegressionScores) -> Outcome:
    """Judge whether a network predicts better than the mean label, over five trials or more."""
    if score.r2 is None or score.trials < FEWEST_UNITS:  # labels that do not vary have no R²
        return "undecided"
    return "holds" if score.r2 > 0 else "does not hold"


def judge_results(results: Study, *, rng: np.random.Generator) -> Iterator[ClaimRow]:
    """Compare the errors of the networks of a workspace, and judge how they predict real touch."""
    evaluations = results.evaluations
    scores = {name: evaluations[name].conditions for name in style.inputs_in_order(evaluations)}
    for pair in combinations(scores, 2):
        for condition in style.conditions_in_order(set(scores[pair[0]]) & set(scores[pair[1]])):
            better, worse = sorted(pair, key=lambda name: scores[name][condition].mse)
            tables = [evaluations[name].predictions for name in (worse, better)]
            gap = compare_errors(*(table.where(table.condition == condition) for table in tables), rng=rng)
            over = f"over {gap.over}" if gap else "not tested: the networks did not predict the same frames"
            yield ClaimRow(
                claim=f"Smaller error than {style.input_name(worse).lower()} on {condition} objects",
                subject=style.input_name(better),
                outcome=judge_gap(gap),
                why=f"Difference of the MSE, {over}.",
                ours=write_gap(gap, digits=4),
            )
    real = results.real or (results.explanations if results.source == "real" else {})
    for name in style.inputs_in_order(real):
        frames = [frame for frame in real[name].frames if frame.safety_margin is not None]
        trials, number, outcome = len({frame.trial for frame in frames}), style.UNKNOWN, "undecided"
        why = f"None of {number_of(len(real[name].frames), 'frame')} has a label."
        if frames:
            labels = np.array([frame.safety_margin for frame in frames], dtype=np.float64)
            error = 100 * np.abs(labels - [frame.prediction for frame in frames]).mean()
            constant, number = 100 * np.abs(labels - np.median(labels)).mean(), f"{error:.0f} points"
            if trials >= FEWEST_UNITS:
                outcome = "holds" if error < constant else "does not hold"
            of_trials = f"{number_of(len(frames), 'frame')} of {number_of(trials, 'trial')}"
            why = f"Mean error on {of_trials}; the best constant is off by {constant:.0f} points."
        claim = "Predicts real touch better than a constant"
        yield ClaimRow(claim=claim, subject=style.input_name(name), outcome=outcome, why=why, ours=number)


# the claims of the thesis, as they come with the package (`python benchmarks/claims.py`)


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
    return load_record(Path(__file__).with_name("thesis.json"), ThesisRecord, command="python benchmarks/claims.py")
