"""Work on parts that counts its tries, for processes that import it by this module's name."""

import errno
import os
import signal
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

from sliplens.codec import write_tables
from sliplens.errors import InputError, RecordingError
from sliplens.progress import report_progress
from sliplens.runner import MakePart, Part, Work, part

SCHEMA = pa.schema({"trial": pa.string(), "value": pa.int64()})


@dataclass(frozen=True, kw_only=True)
class Count(Work):
    """Writes numbers, and logs each try of a part in a folder."""

    log: Path
    refuse: frozenset[str] = frozenset()
    """Trials that fail."""
    kill: frozenset[str] = frozenset()
    """Trials at whose first try the process is killed."""
    no_room: frozenset[str] = frozenset()
    """Trials for which the disk is full."""
    damaged: frozenset[str] = frozenset()
    """Trials whose recording is damaged."""
    broken: str = ""
    """Error of the preparation."""

    def begin(self) -> MakePart:
        if self.broken:
            raise InputError(self.broken)

        def make(item: str, path: Path) -> None:
            tried = self.log / f"{item}-{len(list(self.log.glob(f'{item}-*')))}"
            tried.write_text(str(os.getpid()))
            path.write_text("half of a p")
            if item in self.kill and tried.name.endswith("-0"):
                os.kill(os.getpid(), signal.SIGKILL)
            if item in self.refuse:
                raise InputError(f"{item} is damaged; record it again")
            if item in self.damaged:
                raise RecordingError(f"{item} ends early; record it again")
            if item in self.no_room:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            report_progress(2, 3)
            rows = {"trial": [item] * 3, "value": [ord(item[-1]) + number for number in range(3)]}
            write_tables([pa.table(rows, SCHEMA)], path, SCHEMA)

        return make

    def tries(self) -> dict[str, int]:
        """Return how often each trial was begun."""
        names = [path.name.rpartition("-")[0] for path in self.log.iterdir()]
        return {name: names.count(name) for name in sorted(set(names))}


class CountInThreads(Count):
    """Count several parts at a time."""

    in_threads = True


def parts(names: str = "abcde", *, recipe: object = 1) -> list[Part]:
    """Return parts of three frames, one for each letter."""
    return [part(name, trial=name, frames=3, recipe=recipe, content=name, suffix=".parquet") for name in names]
