"""Alarms and warnings of a workspace, grouped by their kind."""

import re
from collections import Counter, defaultdict
from collections.abc import Iterable

from sliplens.plots.style import input_name, inputs_in_order, listed, method_name, name_methods, source_name
from sliplens.report.results import Results

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
        text = name_methods(alarm)
        sentence = f"{text[:1].upper()}{text[1:].rstrip('.')}."
        kind = next((kind for pattern, kind in _KINDS.items() if re.search(pattern, alarm)), sentence)
        # the same fill can be found wanting by two scores
        if sentence not in groups[kind]:
            groups[kind].append(sentence)
    return dict(groups)


def alarms_of(results: Results, name: str, stage: str) -> tuple[str, ...]:
    """Alarms of one network's `faithfulness`, `randomisation`, `score` or `explain`."""
    if stage == "explain":
        return tuple(
            f"{method_name(method)}, {source_name(source)}: {warning}"
            for (key, source), explained in results.explanations.items()
            if key == name
            for method, notes in explained.methods.items()
            for warning in notes.warnings
        )
    if stage == "score":
        return tuple(
            alarm if source == results.study.source else f"{source_name(source)}: {alarm}"
            for (key, source), scored in results.scores.items()
            if key == name
            for alarm in scored.alarms
        )
    record = getattr(results.study, stage).get(name)
    return () if record is None else record.alarms


def count_alarms(results: Results) -> tuple[str, ...]:
    """Write a line for each kind of alarm: how often, and of which networks."""
    counts: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for name in inputs_in_order(results.inputs)[::-1]:
        for stage in ("score", "faithfulness", "randomisation", "explain"):
            for kind, sentences in group_alarms(alarms_of(results, name, stage)).items():
                counts[kind][input_name(name).lower()] += len(sentences)
    return tuple(
        f"{kind.rstrip('.')}: {networks.total()} ({listed([f'{name} {count}' for name, count in networks.items()])})"
        for kind, networks in counts.items()
    )
