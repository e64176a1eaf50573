"""Which trials train, validate and test: rules followed, trial by trial, never frame by frame."""

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

from sliplens._version import __version__
from sliplens.errors import InputError
from sliplens.provenance import read_json, write_json
from sliplens.recordings.dataset import DATASET_FILE, Dataset
from sliplens.recordings.split_presets import PRESETS, thesis_plan
from sliplens.recordings.split_rules import SplitPlan, SplitRule, TrialFacts, TrialLike, read_splits

__all__ = [
    "PRESETS",
    "SPLITS_FILE",
    "SplitPlan",
    "SplitResult",
    "SplitRule",
    "TrialFacts",
    "TrialLike",
    "assign_splits",
    "read_splits",
    "store_splits",
    "thesis_plan",
    "write_split_record",
]

SPLITS_FILE = "splits.json"
"""Keeps, in the folder of a data set, the rules that its splits come from."""
_NEEDED = ("train", "validation", "test")
_NAMED = 5
"""So many names are told before the rest is counted."""


@dataclass(frozen=True, kw_only=True)
class SplitResult:
    """The split of every trial, and what is odd about it."""

    splits: tuple[str, ...]
    """In the order of the trials."""
    notes: tuple[str, ...]
    """Sentences for a person: rules that decide nothing, splits without trials, objects or days in train and test."""


def assign_splits(plan: SplitPlan, trials: Sequence[TrialLike]) -> SplitResult:
    """Give every trial the split that the first rule that fits it says.

    A rule with shares deals whole groups of those trials that no rule before it took. How many groups a split gets is
    its share of them by the method of largest remainders; a split that this leaves without one takes one from the split
    that has the most beyond its share, as long as there are groups enough. Groups are counted, not their frames: what a
    network is tested for is new objects or days, not more frames of them; and trials can be dealt before their frames
    are read. The groups are dealt in the order of the SHA-256 of `SEED:GROUP`: the order of the trials, how many there
    are in a group and the version of a library play no part, and a group that is added later moves few others.

    Parameters
    ----------
    plan
        The rules.
    trials
        What is known of each trial; no two have one name.

    Raises
    ------
    InputError
        If a trial is listed twice or fits no rule, or trials are to be dealt by what none of them tells.
    """
    twice = [name for name, count in Counter(trial.trial for trial in trials).items() if count > 1]
    if twice:
        raise InputError(
            f"{_names(twice)} {_are(twice)} listed more than once; a trial belongs to one split, list it once"
        )
    taken: dict[int, list[TrialLike]] = {index: [] for index in range(len(plan.rules))}
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
    return SplitResult(splits=told, notes=(*notes, *_missing(told), *_shared(trials, told)))


def store_splits(data: Dataset, plan: SplitPlan, result: SplitResult) -> None:
    """Write splits into the table of a data set, and beside it the rules they come from.

    Parameters
    ----------
    data
        The data set; nothing of its table changes but the splits.
    plan
        The rules.
    result
        What `assign_splits` made of them for the trials of the data set, in their order.
    """
    write_split_record(data.folder, plan, data.trials, result)
    splits = dict(zip((info.trial for info in data.trials), result.splits, strict=True))
    _recount(data, result.splits)
    table = read_json(data.folder / DATASET_FILE)
    for row in table["trials"]:
        row["split"] = splits[row["trial"]]
    # last: whoever sees the new splits finds the rules too
    write_json(data.folder / DATASET_FILE, table)


def write_split_record(folder: Path, plan: SplitPlan, trials: Sequence[TrialLike], result: SplitResult) -> None:
    """Write `splits.json`: the rules, where they come from, and what they made of which trial.

    Parameters
    ----------
    folder
        Folder of the data set.
    plan, trials, result
        The rules, the trials, and what `assign_splits` made of them.
    """
    splits = dict(zip((trial.trial for trial in trials), result.splits, strict=True))
    record = {
        "source": plan.source,
        "rules": [rule.as_table() for rule in plan.rules],
        "splits": splits,
        "notes": result.notes,
        "sliplens": __version__,
    }
    write_json(folder / SPLITS_FILE, record)


def _recount(data: Dataset, splits: Sequence[str]) -> None:
    """Mend what `sliplens simulate` counted, which the report shows."""
    path = data.folder / "result.json"
    counted = read_json(path) if path.is_file() else {}
    if "by_split" in counted:
        frames: dict[str, list[int]] = {}
        for info, split in zip(data.trials, splits, strict=True):
            frames.setdefault(split, []).append(info.frames)
        counted["by_split"] = {split: {"trials": len(of), "frames": sum(of)} for split, of in frames.items()}
        write_json(path, counted)


def _deal(rule: SplitRule, trials: Sequence[TrialLike], *, where: str) -> tuple[dict[str, str], list[str]]:
    """Deal trials by whole groups; gives the split of each trial, and notes."""
    assert rule.by is not None
    group_of = {trial.trial: str(getattr(trial, rule.by)) for trial in trials}
    untold = sorted(trial for trial, group in group_of.items() if not group)
    if len(untold) == len(group_of):
        raise InputError(
            f"{where} deals by {rule.by}, but of {_names(untold)} it is not told; tell it on import, or deal by trial"
        )
    groups = sorted(set(group_of.values()), key=lambda name: _hash(rule.seed, name))
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


def _hash(seed: int, name: str) -> str:
    return hashlib.sha256(f"{seed}:{name}".encode()).hexdigest()


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


def _missing(splits: Sequence[str]) -> list[str]:
    missing = [split for split in _NEEDED if split not in splits]
    if not missing:
        return []
    return [f"no trial is in {' or '.join(missing)}: to train takes train and validation, to evaluate test"]


def _shared(trials: Sequence[TrialLike], splits: Sequence[str]) -> list[str]:
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
