"""`sliplens split`."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sliplens.cli.command import Data
from sliplens.cli.console import print_table, say, wrote

if TYPE_CHECKING:
    from sliplens.recordings import TrialInfo

_MOST_NAMES = 6
"""Names in a cell before the rest is counted."""


@dataclass(frozen=True, kw_only=True)
class Split:
    """Deal the trials of a data set to train, validation and test, or assign them by a table.

    Frames of one trial stay together. Shows the content of each split and the trials that move.
    """

    data: Data
    splits: Annotated[Path, tyro.conf.arg(metavar="trial|object|day|TABLE.csv")]
    """Trials that agree in it stay together: trial, object or day. Or a table with columns trial and split (CSV), in
    which a trial may be a pattern such as mug-*."""
    shares: tuple[float, float, float] = (0.7, 0.15, 0.15)
    """Parts of the trials, objects or days that train, validate and test."""
    seed: int = 0
    """Seed of the order in which they are dealt."""
    dry_run: bool = False
    """Show what would be done and write nothing."""

    def run(self) -> None:
        """Split, show and write."""
        from sliplens.recordings.dataset import load_dataset
        from sliplens.recordings.splits import split_dataset

        data = load_dataset(self.data)
        result = split_dataset(data, self.splits, shares=self.shares, seed=self.seed, dry_run=self.dry_run)
        moved = [(info, to) for info, to in zip(data.trials, result.splits, strict=True) if info.split != to]
        _show_splits(data.trials, result.splits)
        _show_moves(moved)
        for note in result.notes:
            say(f"note: {note}")
        if self.dry_run:
            say("nothing is written (--dry-run)")
            return
        wrote(self.data, f"{len(moved)} of {len(data.trials)} trials moved")
        if moved:
            say("networks trained before saw other splits: a trial that tests now may have trained them, train anew")


def _show_splits(trials: "Sequence[TrialInfo]", splits: Sequence[str]) -> None:
    rows = []
    usual = ("train", "validation", "test")
    for name in sorted(set(splits), key=lambda name: (usual.index(name) if name in usual else len(usual), name)):
        infos = [info for info, split in zip(trials, splits, strict=True) if split == name]
        rows.append(
            (
                name,
                str(len(infos)),
                f"{sum(info.frames for info in infos):,}",
                _ranges(info.day for info in infos),
                _some({info.object for info in infos} - {""}),
                _some({info.condition for info in infos}),
            )
        )
    print_table("Splits", ("split", "trials", "frames", "days", "objects", "conditions"), rows)


def _show_moves(moved: "Sequence[tuple[TrialInfo, str]]") -> None:
    if not moved:
        say("every trial is in its split already")
        return
    names = defaultdict(list)
    for info, to in moved:
        names[info.split, to].append(info.trial)
    rows = [(old, to, str(len(those)), _some(those)) for (old, to), those in sorted(names.items())]
    print_table("Moves", ("from", "to", "trials", "which"), rows)


def _some(names: Iterable[str]) -> str:
    from sliplens.images import natural_key

    ordered = sorted(names, key=natural_key)
    rest = len(ordered) - _MOST_NAMES
    names = ordered if rest < 2 else [*ordered[:_MOST_NAMES], f"{rest} more"]
    return ", ".join(names) or "-"


def _ranges(numbers: Iterable[int]) -> str:
    """Numbers with runs drawn together: 1, 3-5."""
    runs = groupby(enumerate(sorted(set(numbers))), key=lambda pair: pair[1] - pair[0])
    ends = [(run[0][1], run[-1][1]) for run in (list(run) for _, run in runs)]
    return ", ".join(str(first) if first == last else f"{first}-{last}" for first, last in ends)
