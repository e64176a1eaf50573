"""Parts of a work on shards, in a folder: what is done, being made and failed is read from them.

It stands nowhere else: a part that is there is done, one that a process holds is being made, one that failed has left a
sentence.
"""

import json
import os
import re
import socket
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote

from sliplens._version import __version__
from sliplens.codec import RESULT_FILE, load_record, save_record
from sliplens.errors import InputError
from sliplens.files import (
    StoredPath,
    as_path,
    end_removal,
    hash_json,
    held_folder,
    hold,
    make_and_hold,
    partial_folder,
    remove,
    require_new_file,
    scratch_folder,
)

TRIES = 3
"""How often a shard is tried before it is set aside; once where its recording is at fault."""
_LONGEST_NAME = 200  # of a folder; file systems take 255 bytes
_STATE = "_shards"  # readers of Parquet data sets leave out what begins so
_PART = re.compile(r"(\d{8})-(\d+)-([0-9a-f]{16})(\.\w+)?")


@dataclass(frozen=True, kw_only=True, slots=True)
class Shard:
    """Some frames of a trial, which are worked on together."""

    item: Any
    """What the work has to know of it; it travels, so that it holds names and numbers and no frames."""
    name: str
    """For people."""
    frames: int
    part: str
    """Path of its part in the folder of all."""

    @property
    def key(self) -> str:
        """Hash of all that shapes the part."""
        found = _PART.fullmatch(self.part.rpartition("/")[2])
        assert found is not None
        return found[3]


def shard(
    item: Any,
    *,
    trial: str,
    frames: int,
    recipe: object,
    shown: str,
    first: int = 0,
    suffix: str = "",
    name: str | None = None,
) -> Shard:
    """Shard of a trial whose part is named by all that shapes it.

    `shown` is the hash of its frames, `recipe` what else shapes the part (weights, configuration); `suffix` is the
    part's ending, empty for one that is a folder; `name` is for people, that of the trial if None.
    """
    key = hash_json({"recipe": recipe, "shown": shown, "first": first, "frames": frames, "sliplens": __version__})
    folder = quote(trial, safe="")
    if len(folder) > _LONGEST_NAME:
        folder = re.sub("%[0-9A-F]?$", "", folder[:_LONGEST_NAME]) + f"~{hash_json(trial)}"
    part = f"trial={folder}/{first:08d}-{frames}-{key}{suffix}"
    name = name or (f"{trial} from frame {first}" if first else trial)
    return Shard(item=item, name=name, frames=frames, part=part)


@contextmanager
def parts_folder(target: Path | None) -> Iterator[Path]:
    """Folder for the parts of a file, beside it: gone when all is well, kept for the next try where something is done.

    Without a file it is a temporary one.
    """
    if target is None:
        with scratch_folder() as folder:
            yield folder
        return
    folder = partial_folder(target)
    # a store has no locks; who comes second makes the same parts
    with nullcontext() if isinstance(folder, StoredPath) else held_folder(folder, target):
        try:
            yield folder
        except BaseException:
            if not any(path.is_file() for path in folder.rglob("*")):
                remove(folder)
            raise
        remove(folder)


def require_new_table(out: Path, *, suffix: str | Sequence[str], overwrite: bool = False) -> None:
    """Check that a file can be made of parts under its name.

    One that is newer than the parts beside it was made of them by a process that was killed before it could remove
    them: it is made again by who has the same parts.
    """
    left, begun = partial_folder(out), False
    if not isinstance(out, StoredPath):
        end_removal(left)
        begun = out.is_file() and left.is_dir() and out.stat().st_mtime_ns >= left.stat().st_mtime_ns
    require_new_file(out, suffix=suffix, overwrite=overwrite or begun)


@dataclass(frozen=True, kw_only=True)
class Failure:
    """Why a shard could not be made."""

    name: str
    why: tuple[str, ...]
    """A sentence of each try."""
    final: bool = False
    """Whether its recording is at fault, so that no other try can go better."""

    @property
    def set_aside(self) -> bool:
        """Whether it is not tried again before somebody asks for it."""
        return self.final or len(self.why) >= TRIES


@dataclass(frozen=True, kw_only=True)
class Doing:
    """Shard that is being made, and who makes it."""

    name: str
    host: str
    process: int
    since: str
    """Date and time in UTC, as ISO 8601."""


@dataclass(frozen=True, kw_only=True)
class _Plan:
    title: str
    shards: int
    frames: int
    started_s: float
    on: str


_PLAN = "plan.json"
_COMMAND = "the command that was interrupted"


@dataclass(frozen=True, kw_only=True)
class Status:
    """How far a work is, read from its parts."""

    title: str
    """What is done."""
    on: str
    """Where it was begun last, as `--on` says it."""
    shards: int
    done: int
    """Shards whose part is there."""
    frames: int
    """Frames of all shards, or maps where each is a shard."""
    frames_done: int
    doing: tuple[Doing, ...] | None
    """None where the parts lie in a store, which has no locks to tell."""
    failed: tuple[Failure, ...]
    frames_per_s: float | None
    """Since it was begun last; None where no part is newer."""
    ends: str | None
    """Date and time in UTC at which that rate would end it; None where nobody works on it."""


def read_status(out: Path | str) -> list[Status]:
    """How far each work on a result is that is not complete, read from its parts, from any process or machine.

    `out` is the file or folder that a command is writing, or has written all but for some failures. A complete one has
    nothing to tell: the list is empty.

    Raises
    ------
    InputError
        If nothing of that name was begun.

    Examples
    --------
    >>> from sliplens import read_status
    >>> for work in read_status("runs/mine/margins"):  # doctest: +SKIP
    ...     print(work.title, work.done, work.shards, work.ends)
    Predicting frames (difference) 812 1404 2026-11-23T18:20:11+00:00
    """
    out = as_path(out)
    places = [place for place in (out, partial_folder(out)) if place.exists()]
    if not places:
        raise InputError(f"nothing was begun at {out}; name the file or folder that a command writes")
    plans = [path for place in places if place.is_dir() for path in sorted(place.rglob(f"{_STATE}/{_PLAN}"))]
    return [_read_status(path.parent) for path in plans]


def _read_status(state: Path) -> Status:
    plan = load_record(state / _PLAN, _Plan, command=_COMMAND)
    done = frames_done = new_frames = 0
    last_s = plan.started_s
    for path in state.parent.glob("trial=*/*"):
        if (found := _PART.fullmatch(path.name)) is not None:
            done, frames_done = done + 1, frames_done + int(found[2])
            if (made_s := path.stat().st_mtime) >= plan.started_s:
                new_frames, last_s = new_frames + int(found[2]), max(last_s, made_s)
    doing = None
    if not isinstance(state, StoredPath):
        doing = tuple(one for path in sorted(state.glob("*.doing")) if (one := _doing(path)) is not None)
    rate = new_frames / (last_s - plan.started_s) if new_frames and last_s > plan.started_s else None
    left_s = None if rate is None or doing == () else (plan.frames - frames_done) / rate
    return Status(
        title=plan.title,
        on=plan.on,
        shards=plan.shards,
        done=done,
        frames=plan.frames,
        frames_done=frames_done,
        doing=doing,
        failed=tuple(load_record(path, Failure, command=_COMMAND) for path in sorted(state.glob("*.failed"))),
        frames_per_s=rate,
        ends=None
        if left_s is None
        else (datetime.fromtimestamp(last_s, UTC) + timedelta(seconds=left_s)).isoformat(timespec="seconds"),
    )


def _doing(path: Path) -> Doing | None:
    """What a lock says; None where its owner is gone."""
    with suppress(OSError, ValueError, InputError):
        if (held := hold(path)) is None:
            return Doing(**json.loads(path.read_text()))
        os.close(held)
    return None


def keep_plan(folder: Path, *, title: str, shards: int, frames: int, on: str) -> None:
    """Say what is begun in a folder of parts, for `read_status`."""
    (folder / _STATE).mkdir(parents=True, exist_ok=True)
    plan = _Plan(title=title, shards=shards, frames=frames, started_s=time.time(), on=on)
    save_record(plan, folder / _STATE / _PLAN)


def forget_plan(folder: Path) -> None:
    """Take away all but the parts."""
    remove(folder / _STATE)


def _state(folder: Path, given: Shard, kind: str) -> Path:
    return folder / _STATE / f"{given.key}.{kind}"


def failed_keys(folder: Path) -> set[str]:
    """Keys of the shards that failed."""
    return {path.stem for path in (folder / _STATE).glob("*.failed")}


def read_failure(folder: Path, given: Shard) -> Failure:
    """Why a shard failed so far."""
    path = _state(folder, given, "failed")
    if not path.is_file():
        return Failure(name=given.name, why=())
    return load_record(path, Failure, command=_COMMAND)


def keep_failure(folder: Path, given: Shard, why: str, *, final: bool = False) -> None:
    """Keep why a shard failed now, beside why it did before."""
    known = read_failure(folder, given)
    save_record(replace(known, why=(*known.why, why), final=final), _state(folder, given, "failed"))


def forget_failure(folder: Path, given: Shard) -> None:
    """Let a shard be as if it had never been tried."""
    _state(folder, given, "failed").unlink(missing_ok=True)


@contextmanager
def claim(folder: Path, given: Shard) -> Iterator[None]:
    """Hold a shard against others, who see by whom; whoever comes second waits."""
    if isinstance(folder, StoredPath):  # no locks: two that make a part write the same bytes
        yield
        return
    path = _state(folder, given, "doing")

    def make() -> Path:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        return path

    while (held := make_and_hold(make)[1]) is None:  # by a process whose driver was killed a moment ago
        time.sleep(0.05)
    now = datetime.now(UTC).isoformat(timespec="seconds")
    path.write_text(
        json.dumps({"name": given.name, "host": socket.gethostname(), "process": os.getpid(), "since": now})
    )
    try:
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(held)


@contextmanager
def drafting(part: Path) -> Iterator[Path]:
    """Where a part is written: beside its place, or on this machine if that is in a store."""
    if isinstance(part, StoredPath):
        with scratch_folder() as folder:
            yield folder / part.name
        return
    part.parent.mkdir(parents=True, exist_ok=True)
    draft = part.with_name(f".{part.name}.draft")
    remove(draft)  # of one that was killed
    try:
        yield draft
    finally:
        remove(draft)


def publish(draft: Path, part: Path) -> None:
    """Give a part its name when all of it is there."""
    if isinstance(part, StoredPath):
        part.upload(draft, last=RESULT_FILE)
        return
    draft.replace(part)


_ASKED = 256
"""Parts that a store is asked for at once."""


def look_for(folder: Path, shards: Iterable[Shard]) -> Iterator[tuple[Shard, bool]]:
    """Each shard, and whether its part is there."""
    if not isinstance(folder, StoredPath):
        yield from ((one, (folder / one.part).exists()) for one in shards)
        return
    every = iter(shards)
    while group := list(islice(every, _ASKED)):
        paths = (PurePosixPath(one.part) for one in group)  # a part that is a folder has its record last
        made = folder.are_files([str(path if path.suffix else path / RESULT_FILE) for path in paths])
        yield from zip(group, made, strict=True)


__all__ = ["Doing", "Failure", "Shard", "Status", "read_status"]
