"""Work on shards, for processes that import it by this module's name."""

import errno
import os
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

from sliplens.codec import write_tables
from sliplens.errors import InputError, RecordingError
from sliplens.parts import Shard, shard
from sliplens.progress import OnProgress
from sliplens.shards import MakePart, Work, WorkError

SCHEMA = pa.schema({"trial": pa.string(), "value": pa.int64()})


@dataclass(frozen=True, kw_only=True)
class Count(Work):
    """Writes numbers, and remembers in a folder how often each shard was begun."""

    log: Path
    refuse: frozenset[str] = frozenset()
    """Trials that fail."""
    kill: frozenset[str] = frozenset()
    """Trials at whose first try the process is killed, as for want of memory."""
    no_room: frozenset[str] = frozenset()
    """Trials for which the disk has no room."""
    damaged: frozenset[str] = frozenset()
    """Trials whose recording is at fault."""
    unready: frozenset[str] = frozenset()
    """Trials that need what cannot be loaded."""
    broken: str = ""
    """What is wrong with all of it."""

    def begin(self) -> MakePart:
        if self.broken:
            raise InputError(self.broken)

        def make(item: str, path: Path, on_progress: OnProgress) -> None:
            tried = self.log / f"{item}-{len(list(self.log.glob(f'{item}-*')))}"
            tried.write_text(str(os.getpid()))
            path.write_text("half of a p")
            if item in self.kill and tried.name.endswith("-0"):
                os.kill(os.getpid(), signal.SIGKILL)
            if item in self.refuse:
                raise InputError(f"{item} is damaged; record it again")
            if item in self.damaged:
                raise RecordingError(f"{item} ends in its midst; record it again")
            if item in self.unready:
                raise WorkError(InputError(f"the network of {item} is gone"))
            if item in self.no_room:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            on_progress(2, 3)
            rows = {"trial": [item] * 3, "value": [ord(item[-1]) + number for number in range(3)]}
            write_tables([pa.table(rows, SCHEMA)], path, SCHEMA)

        return make

    def tries(self) -> dict[str, int]:
        """How often each trial was begun."""
        names = [path.name.rpartition("-")[0] for path in self.log.iterdir()]
        return {name: names.count(name) for name in sorted(set(names))}


class CountInThreads(Count):
    """The same, several shards side by side."""

    in_threads = True


def shards(names: str = "abcde", *, recipe: object = 1) -> Iterator[Shard]:
    """Shards of three frames, one of each letter."""
    for name in names:
        yield shard(name, trial=name, frames=3, recipe=recipe, shown=name, suffix=".parquet")
