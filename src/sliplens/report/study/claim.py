"""A claim of the thesis held against this data: what was compared, and what follows."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

from sliplens.intervals import Difference
from sliplens.report.study.evidence import tell_interval
from sliplens.report.style import input_name, listed

Outcome = Literal["holds", "does not hold", "undecided"]
OUTCOMES: tuple[Outcome, ...] = ("holds", "does not hold", "undecided")


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One comparison: where, of what, its number with an interval if there is one, and what it says of the claim.

    Attributes
    ----------
    where
        Fill and unit, or the score.
    value
        Number where no interval is kept.
    outcome
        None where the comparison is told but does not decide.
    """

    where: str
    compared: str
    gap: Difference | None = None
    value: str = ""
    outcome: Outcome | None = None


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
    parts = []
    for outcome in OUTCOMES:
        names = [name for name, found in by_setting.items() if found == outcome]
        if names:
            parts.append(f"{outcome} under {listed(names)}")
    text = "; ".join(parts)
    return f"{text[:1].upper()}{text[1:]}."


def tell_first(findings: list[Finding]) -> str:
    """Write the intervals of the first setting."""
    told = [one for one in findings if one.gap is not None and one.where == findings[0].where]
    parts = [f"{one.compared}: {tell_interval(one.gap)}" for one in told if one.gap is not None]
    return f"Under {findings[0].where}, {'; '.join(parts)}." if parts else ""


def untested(name: str, why: str = "its explanations were not scored; `sliplens study` does that") -> Answer:
    """Answer that stays open, and why; the name is that of an input, or empty for both networks."""
    subject = input_name(name) if name else "Both networks"
    return Answer(subject=subject, outcome="undecided", text=f"Not tested: {why}.")
