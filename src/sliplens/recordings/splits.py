"""Which trials train, validate and test: rules followed, trial by trial, never frame by frame."""

import hashlib
import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from fnmatch import fnmatchcase
from fractions import Fraction
from glob import escape
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import msgspec

from sliplens._version import __version__
from sliplens.errors import InputError
from sliplens.files import read_toml, write_json
from sliplens.images import natural_key
from sliplens.recordings.dataset import SPLITS_FILE, Dataset, load_dataset, write_dataset_table
from sliplens.recordings.trial import TrialFacts

FACTS = ("trial", "day", "object", "condition", "sensor")
"""What is known of a trial before it is looked at: what rules ask for, and trials are grouped by."""
Item = TypeVar("Item")
_SPLIT_NAME = re.compile(r"[a-z][a-z0-9_-]*")
# shares are written with few digits: thirds as 0.3333 are to be mended by the one who wrote them
_SUM_TOLERANCE = 1e-6


@dataclass(frozen=True, kw_only=True)
class SplitRule:
    """Which trials a rule fits, and the split they go to, or the splits they are dealt to.

    Texts may hold `*`, `?` and `[a-z]` and are compared with upper and lower case told apart. What is left empty fits
    every trial. It is an `InputError` to name a split and shares too, or neither, or shares that cannot be dealt.
    """

    trial: tuple[str, ...] = ()
    day: tuple[int, ...] = ()
    object: tuple[str, ...] = ()
    condition: tuple[str, ...] = ()
    sensor: tuple[str, ...] = ()
    name: str | None = None
    """The split of every trial the rule fits; None where they are dealt."""
    share: Mapping[str, float] = field(default_factory=dict)
    """Part of the groups that each split gets; empty where all go to one."""
    by: str | None = None
    """What makes a group, one of `FACTS`: trials alike in it stay together."""
    seed: int = 0
    """Another seed deals the groups in another order."""

    def __post_init__(self) -> None:
        if (self.name is None) == (not self.share):
            said = "neither name nor share" if self.name is None else "both name and share"
            raise InputError(f"it has {said}; give the name of a split, or the share of each")
        for split in self.share or (self.name,):
            if not _SPLIT_NAME.fullmatch(str(split)):
                raise InputError(f"a split cannot be named {split!r}; use a lower-case word such as train or test")
        if not self.share and self.by is not None:
            raise InputError("by goes with share; leave it out, or give shares in place of the name")
        if self.share and self.by not in FACTS:
            said = "share needs by" if self.by is None else f"trials cannot be grouped by {self.by!r}"
            raise InputError(f"{said}; choose {', '.join(FACTS[:-1])} or {FACTS[-1]}")
        for split, part in self.share.items():
            if not (math.isfinite(part) and part > 0):
                raise InputError(f"the share of {split} is {part:g}; give more than 0, or leave {split} out")
        total = math.fsum(self.share.values())
        if self.share and abs(total - 1) > _SUM_TOLERANCE:
            raise InputError(f"the shares sum to {total:.6g}; change them so that they sum to 1")

    def fits(self, trial: TrialFacts) -> bool:
        """Tell whether all that the rule asks for is so of a trial."""
        return all(
            any(_alike(str(getattr(trial, fact)), str(pattern)) for pattern in asked)
            for fact in FACTS
            if (asked := getattr(self, fact))
        )

    def __str__(self) -> str:
        """Say what the rule asks for."""
        asked = [f"{fact} {' or '.join(map(str, getattr(self, fact)))}" for fact in FACTS if getattr(self, fact)]
        return ", ".join(asked) or "any trial"


@dataclass(frozen=True, kw_only=True)
class SplitPlan:
    """Rules in order: the first that fits a trial decides; to have none is an `InputError`."""

    rules: tuple[SplitRule, ...]
    source: str = "the plan"
    """The file or preset it comes from, for messages."""

    def __post_init__(self) -> None:
        if not self.rules:
            raise InputError(f"{self.source} has no rule; write one that begins with [[split]]")


def read_splits(path: Path) -> SplitPlan:
    """Read the rules of a TOML file, as described in `docs/splits.md`.

    An `InputError` names what of the file or of which rule, counted from 1, is wrong.
    """
    table = read_toml(path, what="rules")
    other = sorted(set(table) - {"split"})
    if other:
        raise InputError(f"{path} has {other[0]!r} outside of a rule; put it under a line [[split]], or leave it out")
    rows = table.get("split", [])
    if not (isinstance(rows, list) and all(isinstance(row, dict) for row in rows)):
        raise InputError(f"{path} has a split that is no list of rules; begin each rule with [[split]]")
    rules = []
    for number, row in enumerate(rows, start=1):
        try:
            rules.append(_rule(row))
        except InputError as error:
            raise InputError(f"{path}, rule {number}: {error}") from None
    return SplitPlan(rules=tuple(rules), source=str(path))


def _alike(text: str, pattern: str) -> bool:
    # a name that holds brackets fits itself too
    return text == pattern or fnmatchcase(text, pattern)


_CURES = {
    **dict.fromkeys(FACTS, "give a text in quotes, or a list of them"),
    "day": "give a whole number, or a list of them, without quotes",
    "name": "give one text in quotes",
    "share": "write it like { train = 0.8, validation = 0.2 }",
    "by": "give one text in quotes",
    "seed": "give a whole number",
}
"""What to write in place of what a rule cannot hold."""


def _rule(row: Mapping[str, Any]) -> SplitRule:
    unknown = [key for key in row if key not in _CURES]
    if unknown:
        *keys, last = _CURES
        raise InputError(f"{unknown[0]!r} is no key of a rule; use {', '.join(keys)} or {last}")
    if "seed" in row and "share" not in row:
        raise InputError("seed goes with share; leave it out")
    values, kinds = {}, get_type_hints(SplitRule)
    for key, value in row.items():
        if key in FACTS and value == []:
            raise InputError(f"{key} is an empty list, which fits no trial; name some, or leave {key} out")
        several = [value] if key in FACTS and not isinstance(value, list) else value
        try:
            values[key] = msgspec.convert(several, kinds[key])
        except msgspec.ValidationError:
            raise InputError(f"{key} is {value!r}; {_CURES[key]}") from None
    return SplitRule(**values)


def hold_out(candidates: Sequence[Item], share: float) -> list[Item]:
    """Evenly spaced part of a list, one at least if there is any."""
    count = max(1, round(share * len(candidates))) if candidates else 0
    return [candidates[int((index + 0.5) * len(candidates) / count)] for index in range(count)]


def thesis_plan(trials: Sequence[TrialFacts]) -> SplitPlan:
    """Lay out the splits of the thesis for the days there are, as the simulator does.

    The first day trains and the last day tests. Of the dry trials of the days between a quarter validates, evenly
    spaced within each day; all others train. Without such trials the first day gives up a quarter of its dry ones.
    Within a day the trials are in the order of their names, 2 before 10.

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
    held_out = [name for _, _, name in hold_out(candidates, 0.25)]
    rules = [SplitRule(day=(days[-1],), name="test"), SplitRule(name="train")]
    if held_out:
        rules.insert(1, SplitRule(trial=tuple(escape(name) for name in held_out), name="validation"))
    return SplitPlan(rules=tuple(rules), source="preset thesis")


def _dry_of(trials: Sequence[TrialFacts], day: int) -> list[tuple[int, int, str]]:
    """Dry trials of a day: day, place within the day, name."""
    names = [one.trial for one in trials if (one.day, one.condition) == (day, "dry")]
    # a01 and a1 are alike to the natural order
    return [(day, place, name) for place, name in enumerate(sorted(names, key=lambda name: (natural_key(name), name)))]


def _dealt_plan(by: str) -> SplitPlan:
    share = {"train": 0.7, "validation": 0.15, "test": 0.15}
    return SplitPlan(rules=(SplitRule(share=share, by=by),), source=f"preset {by}s")


PRESETS: dict[str, Callable[[Sequence[TrialFacts]], SplitPlan]] = {
    "thesis": thesis_plan,
    "objects": lambda _: _dealt_plan("object"),
    "trials": lambda _: _dealt_plan("trial"),
}
"""Plans worth a name, as functions of the trials there are. `objects` and `trials` deal 70 % to train and 15 % each to
validation and test, by whole objects or by single trials."""


_NAMED = 5  # so many names are told before the rest is counted


@dataclass(frozen=True, kw_only=True)
class SplitResult:
    """The split of every trial, and what is odd about it."""

    splits: tuple[str, ...]
    """In the order of the trials."""
    notes: tuple[str, ...]
    """Sentences for a person: rules that decide nothing, splits without trials, objects or days in train and test."""


def assign_splits(plan: SplitPlan, trials: Sequence[TrialFacts]) -> SplitResult:
    """Give every trial the split that the first rule that fits it says.

    A rule with shares deals whole groups of those trials that no rule before it took. How many groups a split gets is
    its share of them by the method of largest remainders; a split that this leaves without one takes one from the split
    that has the most beyond its share, as long as there are groups enough. Groups are counted, not their frames: what a
    network is tested for is new objects or days, not more frames of them; and trials can be dealt before their frames
    are read. The groups are dealt in the order of the SHA-256 of `SEED:GROUP`: the order of the trials, how many there
    are in a group and the version of a library play no part, and a group that is added later moves few others.

    Raises
    ------
    InputError
        If a trial is listed twice or fits no rule, or trials are to be dealt by what none of them tells.

    Examples
    --------
    Every wet trial tests; the dry ones are dealt by object, three quarters to train:

    >>> from sliplens.recordings.splits import SplitPlan, SplitRule, TrialFacts, assign_splits
    >>> trials = [
    ...     TrialFacts(trial=f"{cup}-{surface}", sensor="tip", day=1, condition=surface, object=cup)
    ...     for cup in ("mug", "jar", "can", "box")
    ...     for surface in ("dry", "wet")
    ... ]
    >>> dealt = SplitRule(share={"train": 0.75, "validation": 0.25}, by="object")
    >>> plan = SplitPlan(rules=(SplitRule(condition=("wet",), name="test"), dealt))
    >>> splits = assign_splits(plan, trials).splits
    >>> splits[1::2], sorted(splits[::2])
    (('test', 'test', 'test', 'test'), ['train', 'train', 'train', 'validation'])
    """
    twice = [name for name, count in Counter(trial.trial for trial in trials).items() if count > 1]
    if twice:
        raise InputError(
            f"{_names(twice)} {_are(twice)} listed more than once; a trial belongs to one split, list it once"
        )
    taken: dict[int, list[TrialFacts]] = {index: [] for index in range(len(plan.rules))}
    left = []
    for trial in trials:
        fitting = next((index for index, rule in enumerate(plan.rules) if rule.fits(trial)), None)
        (left if fitting is None else taken[fitting]).append(trial)
    if left:
        raise InputError(
            f"{_names([trial.trial for trial in left])} {_are(left)} fit by no rule of {plan.source}; add a last rule "
            "that says where all others go"
        )
    splits, notes = {}, []
    for index, rule in enumerate(plan.rules):
        where = f"rule {index + 1} of {plan.source}"
        if rule.name is not None:
            splits |= dict.fromkeys((trial.trial for trial in taken[index]), rule.name)
        elif taken[index]:
            dealt, said = _deal(rule, taken[index], where=where)
            splits |= dealt
            notes += said
        if not taken[index]:
            any_fits = any(rule.fits(trial) for trial in trials)
            cause = "rules before it take every trial it fits" if any_fits else "no trial fits it; check its words"
            notes.append(f"{where} ({rule}) decides nothing: {cause}")
    told = tuple(splits[trial.trial] for trial in trials)
    missing = [split for split in ("train", "validation", "test") if split not in told]
    if missing:
        notes.append(f"no trial is in {' or '.join(missing)}: to train takes train and validation, to evaluate test")
    return SplitResult(splits=told, notes=(*notes, *_shared(trials, told)))


def split_dataset(data: Dataset | Path | str, rules: SplitPlan | Path | str, *, dry_run: bool = False) -> SplitResult:
    """Deal the trials of a data set to splits, and keep the rules beside its table; nothing else of it changes.

    Parameters
    ----------
    data
        Data set, or its folder.
    rules
        Rules, their file (TOML), or the name of a preset (`PRESETS`).
    dry_run
        Say what would be done and write nothing.

    Raises
    ------
    InputError
        If the data set or the rules cannot be read, or a trial fits no rule.
    """
    data = data if isinstance(data, Dataset) else load_dataset(data)
    if isinstance(rules, SplitPlan):
        plan = rules
    else:
        plan = PRESETS[str(rules)](data.trials) if rules in PRESETS else read_splits(Path(rules))
    result = assign_splits(plan, data.trials)
    if not dry_run:
        write_split_record(data.folder, plan, data.trials, result)
        trials = [replace(info, split=split) for info, split in zip(data.trials, result.splits, strict=True)]
        # last: whoever sees the new splits finds the rules too
        write_dataset_table(data.folder, trials, simulated=data.simulated, left_out=data.left_out)
    return result


def write_split_record(folder: Path, plan: SplitPlan, trials: Sequence[TrialFacts], result: SplitResult) -> None:
    """Write `splits.json`: the rules as their file would hold them, their source, and what they made of which trial."""
    splits = dict(zip((trial.trial for trial in trials), result.splits, strict=True))
    unsaid = ((), {}, None)
    record = {
        "source": plan.source,
        "rules": [
            {key: value for key, value in asdict(rule).items() if value not in unsaid and (key != "seed" or rule.share)}
            for rule in plan.rules
        ],
        "splits": splits,
        "notes": result.notes,
        "sliplens": __version__,
    }
    write_json(folder / SPLITS_FILE, record)


def _deal(rule: SplitRule, trials: Sequence[TrialFacts], *, where: str) -> tuple[dict[str, str], list[str]]:
    """Deal trials by whole groups; gives the split of each trial, and notes."""
    assert rule.by is not None
    group_of = {trial.trial: str(getattr(trial, rule.by)) for trial in trials}
    untold = sorted(trial for trial, group in group_of.items() if not group)
    if len(untold) == len(group_of):
        raise InputError(
            f"{where} deals by {rule.by}, but of {_names(untold)} it is not told; tell it on import, or deal by trial"
        )
    groups = sorted(set(group_of.values()), key=lambda name: hashlib.sha256(f"{rule.seed}:{name}".encode()).digest())
    counts = _apportion(len(groups), rule.share)
    order = [split for split, count in counts.items() for _ in range(count)]
    split_of = dict(zip(groups, order, strict=True))
    notes = []
    without = [split for split, count in counts.items() if count == 0]
    if without:
        kind = f"{rule.by}s" if len(groups) > 1 else rule.by
        notes.append(f"{where} has {len(groups)} {kind} to deal to {len(counts)} splits; {_names(without)} got none")
    if untold:
        notes.append(f"{where}: the {rule.by} of {_names(untold)} is not told; dealt as if of one {rule.by}")
    return {trial: split_of[group] for trial, group in group_of.items()}, notes


def _apportion(count: int, share: Mapping[str, float]) -> dict[str, int]:
    """Groups of each split: largest remainders, and none without if there are enough."""
    # the decimals as they were written: 0.15 of 20 is 3, with no rounding error to decide a tie
    parts = {split: Fraction(repr(part)) for split, part in share.items()}
    exact = {split: part * count / sum(parts.values()) for split, part in parts.items()}
    dealt = {split: int(quota) for split, quota in exact.items()}
    # the sort is stable: of equal remainders the split that the rule names first wins
    by_remainder = sorted(exact, key=lambda split: dealt[split] - exact[split])
    for split in by_remainder[: count - sum(dealt.values())]:
        dealt[split] += 1
    while count >= len(dealt) and 0 in dealt.values():
        giver = max((split for split in dealt if dealt[split] > 1), key=lambda split: dealt[split] - exact[split])
        taker = next(split for split, groups in dealt.items() if groups == 0)
        dealt[giver] -= 1
        dealt[taker] += 1
    return dealt


def _shared(trials: Sequence[TrialFacts], splits: Sequence[str]) -> list[str]:
    """Objects and days that lie in both train and test."""
    notes = []
    for fact in ("object", "day"):
        of_split = {
            name: {getattr(trial, fact) for trial, split in zip(trials, splits, strict=True) if split == name}
            for name in ("train", "test")
        }
        both = sorted((of_split["train"] & of_split["test"]) - {""})
        if both:
            those = f"{fact}{'s' if len(both) > 1 else ''} {_names([str(one) for one in both])}"
            notes.append(f"{those} {_are(both)} in train and test: the test does not tell of a new {fact}")
    return notes


def _names(names: Sequence[str]) -> str:
    """Some of the names, and how many more there are."""
    rest = len(names) - _NAMED
    if rest > 1:
        return f"{', '.join(names[:_NAMED])} and {rest} more"
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def _are(things: Sequence[object]) -> str:
    return "are" if len(things) > 1 else "is"


__all__ = [
    "PRESETS", "SPLITS_FILE", "SplitPlan", "SplitResult", "SplitRule", "assign_splits", "read_splits", "split_dataset",
]  # fmt: skip
