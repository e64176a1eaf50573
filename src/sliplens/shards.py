"""Work on many trials, cut into shards: each is kept as a part that is whole or absent, wherever it is made.

What is done, doing and failed is read from the folder of the parts, and stands nowhere else: a part that is there is
done, one that a process holds is being made, one that failed has left a sentence.
"""

import errno
import hashlib
import json
import logging
import os
import pickle
import re
import secrets
import signal
import socket
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import partial
from itertools import chain, islice
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar, Protocol, TypeAlias, runtime_checkable
from urllib.parse import quote

import pyarrow as pa

from sliplens._version import __version__
from sliplens.codec import RESULT_FILE, load_record, open_table, regrouped, save_record, write_tables
from sliplens.errors import InputError, RecordingError, ShardError, SliplensError
from sliplens.extras import Table, require_packages
from sliplens.files import (
    StoredPath,
    as_path,
    hash_json,
    held_folder,
    hold,
    make_and_hold,
    output_folder,
    partial_folder,
    remove,
    scratch_folder,
)
from sliplens.progress import OnProgress, ignore, stage

TRIES = 3
"""How often a shard is tried before it is set aside; once where its recording is at fault."""
LONGEST = 8192
"""Frames of a shard; a longer trial is cut."""
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


MakePart: TypeAlias = Callable[[Any, Path, OnProgress], None]
"""Takes the item of a shard, the path where its part is to be written, and what is told the frames done."""


class Work(ABC):
    """What is done with every shard; it travels to other processes, so that it holds paths and settings."""

    in_threads: ClassVar[bool] = False
    """Whether one process does best with a shard for each of its cores at a time, in threads."""

    @property
    def on_gpu(self) -> bool:
        """Whether each worker needs a graphics card."""
        return False

    @abstractmethod
    def begin(self) -> MakePart:
        """Load what all shards need; called once for each worker."""


class WorkError(Exception):
    """What shards need cannot be loaded, for the error that is given: none of them is at fault, and all would fail."""


class Worker:
    """One that makes parts, one after another, in whatever process."""

    def __init__(self, work: Work | bytes, *, folder: str | None = None, threads: int | None = None) -> None:
        self._work, self._folder, self._threads = work, folder, threads

    def start(self) -> Exception | None:
        """Load what all shards need; what is wrong with it is given back."""
        try:
            if self._folder is not None:
                os.chdir(self._folder)  # paths count from there
            # bytes that this program packed for a process of its own
            work = pickle.loads(self._work) if isinstance(self._work, bytes) else self._work  # noqa: S301
            if self._threads is not None and "torch" in sys.modules:
                sys.modules["torch"].set_num_threads(self._threads)
            self._make = work.begin()
        except Exception as error:  # raised again where the work was asked for
            return error
        return None

    def attempt(self, folder: Path, given: Shard, on_progress: OnProgress = ignore) -> Any:
        """Make a part unless it is there; why that failed is kept beside the parts, and given back."""
        try:
            with _claim(folder, given), _draft(folder / given.part) as draft:
                if not all(_are_made(folder, [given])):
                    self._make(given.item, draft, on_progress)
                    _publish(draft, folder / given.part)
        except Exception as error:  # a bad trial must not end the others
            if not _is_of_all(error):
                why = str(error) if isinstance(error, SliplensError) else f"{type(error).__name__}: {error}"
                _keep_failure(folder, given, why, final=isinstance(error, RecordingError))
            return error
        _state(folder, given, "failed").unlink(missing_ok=True)
        return None


def _is_of_all(error: Exception) -> bool:
    """Whether no other part could be made either: for the work's sake, or since there is no room, or none to write."""
    full = isinstance(error, OSError) and error.errno in {errno.ENOSPC, errno.EDQUOT, errno.EROFS}
    return full or isinstance(error, WorkError)


@runtime_checkable
class Seat(Protocol):
    """Place of one worker; a future that raises `Lost` says that it is gone."""

    def start(self) -> Future:
        """Begin `Worker.start`."""
        ...

    def submit(self, folder: Path, given: Shard, on_progress: OnProgress) -> Future:
        """Begin `Worker.attempt`."""
        ...

    def close(self) -> None:
        """End the worker, whatever it does."""
        ...


class _Here:
    """The process that asks for the work."""

    def __init__(self, work: Work) -> None:
        self._worker = Worker(work)

    def start(self) -> Future:
        return _settled(self._worker.start())

    def submit(self, folder: Path, given: Shard, on_progress: OnProgress) -> Future:
        return _settled(self._worker.attempt(folder, given, on_progress))

    def close(self) -> None:
        """Nothing is left behind."""


class _Thread:
    """A thread of the process that asks for the work."""

    def __init__(self, work: Work) -> None:
        self._worker, self._pool, self._ended = Worker(work), ThreadPoolExecutor(1), threading.Event()

    def start(self) -> Future:
        return self._pool.submit(self._worker.start)

    def submit(self, folder: Path, given: Shard, on_progress: OnProgress) -> Future:
        def tell(done: int, total: int) -> None:
            if self._ended.is_set():
                raise KeyboardInterrupt
            on_progress(done, total)

        return self._pool.submit(self._worker.attempt, folder, given, tell)

    def close(self) -> None:
        self._ended.set()
        self._pool.shutdown(cancel_futures=True)


def _settled(result: Exception | None) -> Future:
    future: Future = Future()
    future.set_result(result)
    return future


class _Process:
    """A process of its own on this machine."""

    def __init__(self, work: bytes, *, threads: int) -> None:
        context = get_context("spawn")  # a fork would inherit locks of torch's threads
        alive, self._life = context.Pipe(duplex=False)
        self._pool = ProcessPoolExecutor(1, mp_context=context, initializer=_enter, initargs=(alive,))
        self._work, self._threads = work, threads

    def start(self) -> Future:
        # not as the process is made: that would wait until it has imported the main module, one after another
        return self._pool.submit(_start, self._work, self._threads)

    def submit(self, folder: Path, given: Shard, on_progress: OnProgress) -> Future:  # noqa: ARG002 (of whole shards)
        return self._pool.submit(_attempt, folder, given)

    def close(self) -> None:
        self._life.close()
        self._pool.shutdown(cancel_futures=True)


_HERE: list[Worker] = []
"""Worker of a process that was made for one."""


def _enter(alive: Connection) -> None:
    # an interruption reaches every process of a terminal; the first of them ends the others
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(alive,), daemon=True).start()


def _end_with(alive: Connection) -> None:
    alive.poll(None)  # until the process that began this one closes its end, or is gone
    os._exit(1)


def _start(work: bytes, threads: int) -> Exception | None:
    os.environ["OMP_NUM_THREADS"] = str(threads)  # also for what unpacking the work imports first
    _HERE.append(Worker(work, threads=threads))
    return _HERE[0].start()


def _attempt(folder: Path, given: Shard) -> Any:
    return _HERE[0].attempt(folder, given)


Seats: TypeAlias = tuple[int, Callable[[], Seat], type[Exception]]
"""How many workers there are, what makes one, and what a future raises when its worker is gone."""


@contextmanager
def _serial(work: Work, _: str, most: int) -> Iterator[Seats]:
    kind, places = (_Thread, min(_cores(), most)) if work.in_threads else (_Here, 1)
    yield places, lambda: kind(work), BrokenProcessPool


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def _processes(work: Work, number: str, most: int) -> Iterator[Seats]:
    cores = _cores()
    if number and not (number.isdigit() and int(number)):
        raise InputError(f"--on processes={number} is no number of processes; say processes or processes=2")
    count, packed = min(int(number or cores), most), pickle.dumps(work)
    yield count, lambda: _Process(packed, threads=max(1, cores // count)), BrokenProcessPool


class _Actor:
    """An actor of Ray, wherever its cluster has a core for it."""

    def __init__(self, actor: Any, kill: Callable[[Any], None]) -> None:
        self._actor, self._kill = actor, kill

    def start(self) -> Future:
        return self._actor.start.remote().future()

    def submit(self, folder: Path, given: Shard, on_progress: OnProgress) -> Future:  # noqa: ARG002 (of whole shards)
        return self._actor.attempt.remote(folder, given).future()

    def close(self) -> None:
        self._kill(self._actor)


@contextmanager
def _ray(work: Work, address: str, most: int) -> Iterator[Seats]:
    require_packages("ray", extra="ray", purpose="--on ray")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # else it reports its use to its makers
    import ray  # noqa: PLC0415 (an extra)  # pyright: ignore[reportMissingImports]
    from ray.exceptions import RayError  # noqa: PLC0415  # pyright: ignore[reportMissingImports]

    connected = ray.is_initialized()
    if not connected:
        # without a word Ray looks for a cluster that was here before, which a kill may have left the address of
        where: dict[str, Any] = {"address": address} if address else {"address": "local", "include_dashboard": False}
        try:
            ray.init(**where, log_to_driver=False, logging_level=logging.ERROR)
        except Exception as error:  # it raises just that of a node that takes more than 30 s to start
            told, named = " ".join(str(error).split())[:200], f"ray={address}" if address else "ray"
            raise InputError(f"--on {named} has no cluster of Ray ({told}); start it, check it, or try again") from None
    try:
        unit = "GPU" if work.on_gpu else "CPU"
        if (count := int(ray.cluster_resources().get(unit, 0))) < 1:
            raise InputError(f"the cluster of Ray has no {unit}; start a node that has one")
        packed = ray.put(pickle.dumps(work))  # once a node, not once a worker
        kind: Any = ray.remote(num_cpus=1, num_gpus=int(work.on_gpu), scheduling_strategy="SPREAD")(Worker)
        here = os.getcwd()  # noqa: PTH109 (a worker elsewhere has another)
        yield min(count, most), lambda: _Actor(kind.remote(packed, folder=here), ray.kill), RayError
    finally:
        if not connected:
            ray.shutdown()


EXECUTORS = Table("place to work", "sliplens.executors", {"serial": _serial, "processes": _processes, "ray": _ray})
"""Where shards are worked on: each row takes the work, what follows `=` and the number of shards,
and opens its `Seats`."""


class Crew(ExitStack):
    """Workers that stay from one call of `make_parts` to the next, so that each loads only once what its work needs.

    `on` is a row of `EXECUTORS` with its argument, `most` how many workers are of use. None begins before it is needed.

    Raises
    ------
    InputError
        If the place to work is unknown.
    """

    def __init__(self, work: Work, *, on: str = "serial", most: int) -> None:
        super().__init__()
        name, _, argument = on.partition("=")
        self.on = on
        self._open_seats = partial(EXECUTORS.pick(name), work, argument, most)
        self._seats: Seats | None = None
        self._busy: dict[Future, tuple[Seat, Shard | None]] = {}

    def make(self, shards: Iterator[Shard], folder: Path, tally: "_Tally", *, most: int) -> None:
        """Hand shards to workers until none is left; a worker that is lost is replaced."""
        if self._seats is None:
            self._seats = self.enter_context(self._open_seats())
        places, make_seat, lost = self._seats
        again: list[Shard] = []
        busy, idle, more = self._busy, [], True

        def add_seat() -> None:
            seat = make_seat()
            self.callback(seat.close)
            busy[seat.start()] = seat, None

        while len(busy) < min(places, most):
            add_seat()
        # a worker that has not begun when all is done was never needed: a cluster may have lost the node for it
        while more or again or any(given is not None for _, given in busy.values()):
            for future in wait(busy, return_when=FIRST_COMPLETED).done:
                seat, given = busy.pop(future)
                try:
                    error = future.result()
                except lost:
                    if given is None:
                        raise SliplensError(
                            "a process was ended from outside as it began, perhaps for want of memory; "
                            "give the same command again with fewer of them"
                        ) from None
                    error = SliplensError("the process was ended from outside, perhaps for want of memory")
                    _keep_failure(folder, given, str(error))
                    add_seat()
                    seat = None
                if error is not None and (given is None or _is_of_all(error)):
                    raise error.args[0] if isinstance(error, WorkError) else error
                if given is not None and not tally.settle(given, error) and not _failure(folder, given).set_aside:
                    again.append(given)
                if seat is None:
                    continue
                if (given := again.pop() if again else next(shards, None)) is None:
                    idle.append(seat)
                    more = False
                    continue
                try:
                    busy[seat.submit(folder, given, partial(tally.within, given))] = seat, given
                except lost:  # since it did its last
                    again.append(given)
                    add_seat()
        busy.update((_settled(None), (seat, None)) for seat in idle)


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


def make_parts(
    work: Work | Crew,
    shards: Callable[[], Iterable[Shard]],
    folder: Path,
    *,
    title: str,
    on: str = "serial",
    retry_failed: bool = False,
    on_part: Callable[[Shard], None] | None = None,
    on_progress: OnProgress | None = None,
) -> None:
    """Make the parts that are not there yet.

    A shard that fails three times, or once for a `RecordingError`, is set aside with its sentence, and the rest goes
    on. The driver holds as many shards as there are workers, however many come.

    Parameters
    ----------
    work
        What is done with each shard, or those who do it and other work too; `on` is then theirs.
    shards
        Gives all shards, anew at every call.
    folder
        Where the parts are kept.
    title
        What is done, for `read_status`.
    on
        Row of `EXECUTORS`, with its argument: `serial`, `processes`, `processes=4`.
    retry_failed
        Try those again that were set aside before.
    on_part
        Called with each shard whose part is there, in the order in which they become so.

    Raises
    ------
    ShardError
        If shards were set aside, when all others are done; of a single one its own error.
    InputError
        If the place to work is unknown.
    """
    count = frames = 0
    for one in shards():
        count, frames = count + 1, frames + one.frames
    crew = nullcontext(work) if isinstance(work, Crew) else Crew(work, on=on, most=count)
    tally = _Tally(total=frames, on_part=on_part, on_progress=on_progress or ignore)
    missing = _missing(shards, folder, tally, retry_failed=retry_failed)
    first = next(missing, None)
    if first is not None:
        with crew as workers:
            plan = _Plan(title=title, shards=count, frames=frames, started_s=time.time(), on=workers.on)
            (folder / _STATE).mkdir(parents=True, exist_ok=True)
            save_record(plan, folder / _STATE / _PLAN)
            workers.make(chain([first], missing), folder, tally, most=count)
    failed_keys = _failed_keys(folder)
    if failed := [_failure(folder, one) for one in shards() if one.key in failed_keys]:
        if count == 1 and tally.error is not None:
            remove(folder / _STATE)
            raise tally.error
        raise ShardError({failure.name: failure.why[-1] for failure in failed}, shards=count)
    with suppress(OSError):
        remove(folder / _STATE)


def make_table(
    work: Work,
    shards: Callable[[], Iterable[Shard]],
    out: Path | None,
    *,
    title: str,
    recipe: object,
    resumable: bool = True,
    on: str = "serial",
    retry_failed: bool = False,
    overwrite: bool = False,
    on_rows: Callable[[pa.Table], None] | None = None,
    on_progress: OnProgress | None = None,
) -> tuple[pa.Schema, pa.Table | None]:
    """Make the parts, Parquet files, and join them: into a file by its ending, or in memory without one.

    Without an ending `out` is a folder, and the parts stay what they are: a Parquet data set with a folder a trial.
    Gives the columns, and the rows where they are in memory; `on_rows` is called with those of each part in turn.
    """

    def make(folder: Path) -> pa.Schema:
        with stage(on_progress, title) as count:
            make_parts(work, shards, folder, title=title, on=on, retry_failed=retry_failed, on_progress=count)
        return open_table(folder / next(iter(shards())).part).schema_arrow

    def read(folder: Path) -> Iterator[pa.Table]:
        for one in shards():
            table = open_table(folder / one.part).read()
            if on_rows is not None:
                on_rows(table)
            yield table

    if out is not None and not out.suffix:
        every = hashlib.sha256()
        for one in shards():  # frames that changed make another result
            every.update(one.part.encode())
        config = {"recipe": recipe, "shards_sha256": every.hexdigest()}
        if not resumable:  # nobody knows whether frames in memory are those that were
            config["made"] = secrets.token_hex(8)
        with output_folder(out, stage=title, config=config, overwrite=overwrite) as output:
            schema = make(output.parts)
            if on_rows is not None:
                deque(read(output.parts), maxlen=0)
            return schema, None
    with parts_folder(out if resumable else None) as parts:
        schema = make(parts)
        return schema, write_tables(regrouped(read(parts), rows=LONGEST), out, schema)


@dataclass(kw_only=True)
class _Tally:
    """Frames that are done, told as they become so."""

    total: int
    on_part: Callable[[Shard], None] | None
    on_progress: OnProgress
    shown: int = 0
    error: Exception | None = None
    done: int = 0
    within_key: dict[str, int] = field(default_factory=dict)
    """Frames of the shards that are being made, by their keys."""
    lock: threading.Lock = field(default_factory=threading.Lock)

    def settle(self, given: Shard, error: Exception | None) -> bool:
        """Count a shard that was tried; whether it is done."""
        if error is None:
            self.add(given)
        else:
            self.error = error
            self.within_key.pop(given.key, None)
        return error is None

    def add(self, given: Shard) -> None:
        with self.lock:
            self.within_key.pop(given.key, None)
            self.done += given.frames
            self._show()
        if self.on_part is not None:
            self.on_part(given)

    def within(self, given: Shard, done: int, _: int) -> None:
        with self.lock:
            self.within_key[given.key] = done
            self._show()

    def _show(self) -> None:
        if (done := self.done + sum(self.within_key.values())) != self.shown:
            self.shown = done
            self.on_progress(done, self.total)


def _missing(
    shards: Callable[[], Iterable[Shard]], folder: Path, tally: _Tally, *, retry_failed: bool
) -> Iterator[Shard]:
    failed_keys, every = _failed_keys(folder), iter(shards())
    while group := list(islice(every, _ASKED if isinstance(folder, StoredPath) else 1)):
        for one, made in zip(group, _are_made(folder, group), strict=True):
            if made:
                if one.key in failed_keys:  # whoever made it after all was ended before it could say so
                    _state(folder, one, "failed").unlink(missing_ok=True)
                tally.add(one)
            elif one.key in failed_keys and not retry_failed and _failure(folder, one).set_aside:
                continue
            else:
                if retry_failed and one.key in failed_keys:
                    _state(folder, one, "failed").unlink(missing_ok=True)
                yield one


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


def _state(folder: Path, given: Shard, kind: str) -> Path:
    return folder / _STATE / f"{given.key}.{kind}"


def _failed_keys(folder: Path) -> set[str]:
    return {path.stem for path in (folder / _STATE).glob("*.failed")}


def _failure(folder: Path, given: Shard) -> Failure:
    """Why a shard failed so far."""
    path = _state(folder, given, "failed")
    if not path.is_file():
        return Failure(name=given.name, why=())
    return load_record(path, Failure, command=_COMMAND)


def _keep_failure(folder: Path, given: Shard, why: str, *, final: bool = False) -> None:
    known = _failure(folder, given)
    save_record(replace(known, why=(*known.why, why), final=final), _state(folder, given, "failed"))


@contextmanager
def _claim(folder: Path, given: Shard) -> Iterator[None]:
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
def _draft(part: Path) -> Iterator[Path]:
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


def _publish(draft: Path, part: Path) -> None:
    """Give a part its name when all of it is there."""
    if isinstance(part, StoredPath):
        part.upload(draft, last=RESULT_FILE)
        return
    draft.replace(part)


_ASKED = 256
"""Parts that a store is asked for at once."""


def _are_made(folder: Path, shards: Sequence[Shard]) -> list[bool]:
    """Which parts are there."""
    if isinstance(folder, StoredPath):  # a part that is a folder has its record last
        paths = (PurePosixPath(one.part) for one in shards)
        return folder.are_files([str(path if path.suffix else path / RESULT_FILE) for path in paths])
    return [(folder / one.part).exists() for one in shards]


__all__ = ["Doing", "Failure", "Shard", "Status", "make_parts", "read_status"]
