"""Ways to split a data set that are worth a name."""

from collections.abc import Callable, Sequence
from glob import escape

from sliplens.errors import InputError
from sliplens.images.files import natural_key
from sliplens.recordings.split_rules import SplitPlan, SplitRule, TrialLike

_VALIDATION_SHARE = 0.25


def thesis_plan(trials: Sequence[TrialLike]) -> SplitPlan:
    """Lay out the splits of the thesis for the days there are, as the simulator does.

    The first day trains and the last day tests. Of the dry trials of the days between a quarter validates, evenly
    spaced in the list of the first trial of each of these days, then the second of each, and so on; all others train.
    Without such trials the first day gives up a quarter of its dry ones.

    Parameters
    ----------
    trials
        What is known of each trial; within a day their names tell their order, 2 before 10.

    Raises
    ------
    InputError
        If they are all of one day.

    References
    ----------
    Polak, *Explainable Neural Networks for Incipient Slip Sensing in Robot Tactile Learning*.
    """
    days = sorted({trial.day for trial in trials})
    if len(days) < 2:
        raise InputError(
            f"preset thesis tests on the last day, but there is only {f'day {days[0]}' if days else 'no trial'}; "
            "split by another preset, or record a second day"
        )
    first = _dry_of(trials, days[0])
    # a first day of one dry trial has none to give up
    spare = first if len(first) > 1 else []
    candidates = sorted([one for day in days[1:-1] for one in _dry_of(trials, day)] or spare)
    count = max(1, round(_VALIDATION_SHARE * len(candidates))) if candidates else 0
    held_out = [candidates[int((index + 0.5) * len(candidates) / count)][2] for index in range(count)]
    rules = [SplitRule(day=(days[-1],), name="test"), SplitRule(name="train")]
    if held_out:
        rules.insert(1, SplitRule(trial=tuple(escape(name) for name in held_out), name="validation"))
    return SplitPlan(rules=tuple(rules), source="preset thesis")


def _dry_of(trials: Sequence[TrialLike], day: int) -> list[tuple[int, int, str]]:
    """Dry trials of a day: place within the day, day, name."""
    names = [one.trial for one in trials if (one.day, one.condition) == (day, "dry")]
    # a01 and a1 are alike to the natural order
    return [(place, day, name) for place, name in enumerate(sorted(names, key=lambda name: (natural_key(name), name)))]


def _dealt(by: str, *, source: str) -> Callable[[Sequence[TrialLike]], SplitPlan]:
    share = {"train": 0.7, "validation": 0.15, "test": 0.15}
    plan = SplitPlan(rules=(SplitRule(share=share, by=by),), source=source)
    return lambda _: plan


PRESETS: dict[str, Callable[[Sequence[TrialLike]], SplitPlan]] = {
    "thesis": thesis_plan,
    "objects": _dealt("object", source="preset objects"),
    "trials": _dealt("trial", source="preset trials"),
}
"""Plans worth a name, as functions of the trials there are. `objects` and `trials` deal 70 % to train and 15 % each to
validation and test, by whole objects or by single trials."""
