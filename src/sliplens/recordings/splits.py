"""Splits of a data set: whole trials assigned to train, validation and test, by group or by a table."""

import hashlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from fractions import Fraction
from pathlib import Path
from typing import Literal, TypeAlias, get_args

import pyarrow as pa

from sliplens.codec import Result
from sliplens.errors import InputError, RecordingError
from sliplens.files import MOST_TEXT, require_file
from sliplens.recordings.dataset import Dataset, load_dataset, write_dataset_table
from sliplens.recordings.manifest import read_csv
from sliplens.recordings.trial import TrialFacts

SPLITS = ("train", "validation", "test")  #: Splits that trials are assigned to.
Group: TypeAlias = Literal["trial", "object", "day"]  #: Facts by which trials are grouped.
_MOST_NAMES = 5  # names in a message before the rest is counted


@dataclass(frozen=True, kw_only=True)
class SplitResult(Result):
    """Split of every trial, and remarks on it."""

    trials: tuple[str, ...]
    splits: tuple[str, ...]  #: In the order of the trials.
    notes: tuple[str, ...]
    """Sentences about rows without effect, splits without trials, objects or days in both train and test."""

    def to_arrow(self) -> pa.Table:
        """Return a row for each trial: its name and its split."""
        return pa.table({"trial": self.trials, "split": self.splits})


def read_split_table(path: Path) -> dict[str, str]:
    """Read a table (CSV) with the columns `trial` and `split`."""
    require_file(path, missing="name trial, object or day, or write a table: trial,split (CSV)", most=MOST_TEXT)
    table: dict[str, str] = {}
    for where, cells in read_csv(path, ("trial", "split"), what="a table of splits", needed="trial"):
        trial, split = cells["trial"], cells.get("split", "")
        if not re.fullmatch(r"[a-z][a-z0-9_-]*", split):
            raise RecordingError(f"{where}: split is {split!r}; use a lower-case word such as train or test")
        table[trial] = split
    if not table:
        raise RecordingError(f"{path} lists no trial; write a row for each below the header")
    return table


def assign_splits(trials: Sequence[TrialFacts], table: Mapping[str, str]) -> SplitResult:
    """Assign to every trial the split of the first row of a table that matches its name.

    Examples
    --------
    >>> from sliplens.recordings.splits import TrialFacts, assign_splits
    >>> trials = [TrialFacts(trial=name) for name in ("mug-1", "mug-2", "jar-1")]
    >>> assign_splits(trials, {"mug-2": "validation", "mug-*": "train", "*": "test"}).splits
    ('train', 'validation', 'test')
    """
    names = [trial.trial for trial in trials]
    rows = [next((row for row in table if row == name or fnmatchcase(name, row)), "") for name in names]
    if unmatched := [name for name, row in zip(names, rows, strict=True) if not row]:
        raise InputError(f"no row of the table of splits matches {_list(unmatched)}; add rows, or a last row for *")
    splits = tuple(table[row] for row in rows)
    unused = [row for row in table if row not in rows]
    notes = [f"without effect in the table of splits: {_list(unused)}"] if unused else []
    return SplitResult(trials=tuple(names), splits=splits, notes=(*notes, *_remarks(trials, splits)))


def split_by_group(
    trials: Sequence[TrialFacts], *, by: Group, shares: tuple[float, float, float] = (0.7, 0.15, 0.15), seed: int = 0
) -> SplitResult:
    """Assign trials to train, validation and test, keeping trials of one group together.

    Each split gets its share of the groups by the method of largest remainders; a split without a group takes one from
    the split with most beyond its share, as long as there are groups enough. Groups are assigned in the order of the
    SHA-256 of `SEED:GROUP`: independent of the order and number of trials, so that a new group moves few others.

    Examples
    --------
    >>> from sliplens.recordings.splits import TrialFacts, split_by_group
    >>> trials = [TrialFacts(trial=f"{cup}-{i}", object=cup) for cup in ("mug", "jar", "can") for i in (1, 2)]
    >>> splits = split_by_group(trials, by="object").splits
    >>> splits[::2] == splits[1::2], sorted(splits[::2])
    (True, ['test', 'train', 'validation'])
    """
    names = [trial.trial for trial in trials]
    if by not in get_args(Group):
        raise InputError(f"trials cannot be split by {by!r}; choose {', '.join(get_args(Group))}")
    # thirds as 0.3333 should be corrected by whoever wrote them
    if any(not (math.isfinite(share) and share >= 0) for share in shares) or abs(sum(shares) - 1) > 1e-6:
        raise InputError(f"the shares are {', '.join(map(str, shares))}; give three, none below 0, that sum to 1")
    group_of = [str(getattr(trial, by)) for trial in trials]
    unknown = sorted(name for name, group in zip(names, group_of, strict=True) if not group)
    if len(unknown) == len(trials):
        raise InputError(f"the {by} of {_list(unknown)} is unknown; name it on import, or split by trial")
    groups = sorted(set(group_of), key=lambda name: hashlib.sha256(f"{seed}:{name}".encode()).digest())
    # the decimals as they were written: 0.15 of 20 is 3, with no rounding error to decide a tie
    parts = {split: Fraction(repr(share)) for split, share in zip(SPLITS, shares, strict=True) if share}
    exact = {split: part * len(groups) / sum(parts.values()) for split, part in parts.items()}
    counts = {split: int(quota) for split, quota in exact.items()}
    # both searches are stable: of equal remainders the first split wins
    for _ in range(len(groups) - sum(counts.values())):
        counts[min(exact, key=lambda split: counts[split] - exact[split])] += 1
    while len(groups) >= len(counts) and 0 in counts.values():
        counts[next(split for split in counts if not counts[split])] += 1
        counts[max((each for each in counts if counts[each] > 1), key=lambda each: counts[each] - exact[each])] -= 1
    split_of = dict(zip(groups, (split for split in counts for _ in range(counts[split])), strict=True))
    splits = tuple(split_of[group] for group in group_of)
    notes = [f"the {by} of {_list(unknown)} is unknown; split as one {by}"] if unknown else []
    return SplitResult(trials=tuple(names), splits=splits, notes=(*notes, *_remarks(trials, splits)))


def load_splits(splits: Mapping[str, str] | Path | str) -> Mapping[str, str] | Group:
    """Read the table of splits if one is named; a group and a table in memory stay as they are."""
    groups: dict[object, Group] = {group: group for group in get_args(Group)}
    return splits if isinstance(splits, Mapping) else groups.get(str(splits)) or read_split_table(Path(splits))


def split_dataset(
    data: Dataset | Path | str,
    splits: Mapping[str, str] | Path | str,
    *,
    shares: tuple[float, float, float] = (0.7, 0.15, 0.15),
    seed: int = 0,
    dry_run: bool = False,
) -> SplitResult:
    """Assign the trials of a data set to train, validation and test; only the splits in its table change.

    Parameters
    ----------
    data
        Data set, or its folder.
    splits
        `trial`, `object` or `day`: trials that agree in it stay together (`split_by_group`). Or the split of each trial
        by its name, or a table of them (CSV, `read_split_table`).
    shares
        Parts of the groups that train, validate and test.
    seed
        Seed of the order in which groups are assigned.
    dry_run
        If True, nothing is written.

    See Also
    --------
    import_recordings : Import and split in one call.
    train : Train on a split data set.

    Examples
    --------
    >>> import sliplens as sl
    >>> sorted(set(sl.split_dataset("data", "object", dry_run=True).splits))  # doctest: +SKIP
    ['test', 'train', 'validation']
    """
    data = load_dataset(data)
    splits = load_splits(splits)
    if isinstance(splits, Mapping):
        result = assign_splits(data.trials, splits)
    else:
        result = split_by_group(data.trials, by=splits, shares=shares, seed=seed)
    if not dry_run:
        trials = [replace(info, split=split) for info, split in zip(data.trials, result.splits, strict=True)]
        write_dataset_table(data.folder, trials, simulated=data.simulated, left_out=data.left_out)
    return result


def _remarks(trials: Sequence[TrialFacts], splits: Sequence[str]) -> list[str]:
    """Note splits without trials, and objects and days in both train and test."""
    notes = []
    if missing := [split for split in SPLITS if split not in splits]:
        notes.append(f"no trial is in {' or '.join(missing)}: to train takes train and validation, to evaluate test")
    for fact in ("object", "day"):
        pairs = {(str(getattr(trial, fact)), split) for trial, split in zip(trials, splits, strict=True)}
        if both := sorted(value for value, split in pairs if value and split == "train" and (value, "test") in pairs):
            unseen = f"the test does not show how well a new {fact} is predicted"
            notes.append(f"{fact} {_list(both)} in both train and test: {unseen}")
    return notes


def _list(names: Sequence[str]) -> str:
    """Join names, the first few and the number of the others."""
    if (rest := len(names) - _MOST_NAMES) > 1:
        return f"{', '.join(names[:_MOST_NAMES])} and {rest} more"
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))
