"""What a trial is and what its labels rest on, as text of the Rerun viewer."""

import re
from collections.abc import Mapping
from typing import Any

from sliplens.recordings import Recording, TrialInfo
from sliplens.report.audit_facts import Fact, audit_facts

_MARKS = re.compile(r"([\\`*_{}\[\]<>#|~])")


def describe_trial(trial: Recording, info: TrialInfo, labelling: Mapping[str, Any] | None, *, truth: str | None) -> str:
    """Tell in Markdown what a trial is, and what its labels rest on.

    Parameters
    ----------
    trial
        Its labels; frames are not looked at.
    info
        What the data set says of it.
    labelling
        What `import_trial` kept of its labels; None where nothing is kept.
    truth
        Which model moved the markers of a simulated trial; None of any other.
    """
    span = float(trial.time_s[-1] - trial.time_s[0])
    told = {
        "sensor": info.sensor,
        "object": info.object,
        "condition": info.condition,
        "day": str(info.day),
        "split": info.split,
        "frames": f"{info.frames:,} of {info.width} × {info.height} pixels in {span:.2f} s",  # noqa: RUF001 (times is meant)
    }
    about = [f"- {name}: {_plain(value)}" for name, value in told.items() if value]
    facts = _facts(trial, labelling, truth=truth)
    return "\n".join([f"# {_plain(info.trial)}", *about, "", "## What its labels rest on", *map(_paragraph, facts)])


def _facts(trial: Recording, labelling: Mapping[str, Any] | None, *, truth: str | None) -> list[Fact]:
    if truth is not None:
        nominal = "nominal" if truth == "calibrated" else "exact"
        words = [
            "labels are the mechanics' own, without error",
            f"markers moved as {truth}: the stick zone is {nominal}",
        ]
        return [Fact("Simulated", words)]
    if labelling is None:
        return [Fact("Not told", ["nothing is kept of where they come from"], doubtful=True)]
    sources = [str(labelling[name]) for name in ("source", "forces") if labelling[name]]
    recorded = [Fact("Recorded", sources)]
    return [*recorded, *audit_facts(trial, labelling)]


def _paragraph(fact: Fact) -> str:
    mark = "▲ " if fact.doubtful else ""
    return "\n".join([f"\n**{mark}{_plain(fact.head)}**\n", *(f"- {_plain(words)}" for words in fact.words if words)])


def _plain(words: str) -> str:
    """Escape what Markdown would read as its own."""
    return _MARKS.sub(r"\\\1", words.removeprefix("• "))
