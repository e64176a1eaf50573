"""Work on many trials, cut into shards: each is kept as a part that is whole or absent, wherever it is made."""

import errno
import hashlib
import logging
import os
import pickle
import secrets
import signal
import sys
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeAlias, runtime_checkable

import pyarrow as pa

from sliplens.codec import open_table, regrouped, write_tables
from sliplens.errors import InputError, RecordingError, ShardError, SliplensError
from sliplens.extras import Table, require_packages
from sliplens.files import output_folder, require_new_file
from sliplens.parts import (
    Shard,
    claim,
    drafting,
    failed_keys,
    forget_failure,
    forget_plan,
    keep_failure,
    keep_plan,
    look_for,
    parts_folder,
    publish,
    read_failure,
)
from sliplens.progress import OnProgress, ignore, stage

LONGEST = 8192
"""Frames of a shard; a longer trial is cut."""
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
            with claim(folder, given), drafting(folder / given.part) as draft:
                if not all(made for _, made in look_for(folder, [given])):
                    self._make(given.item, draft, on_progress)
                    publish(draft, folder / given.part)
        except Exception as error:  # a bad trial must not end the others
            if not _is_of_all(error):
                why = str(error) if isinstance(error, SliplensError) else f"{type(error).__name__}: {error}"
                keep_failure(folder, given, why, final=isinstance(error, RecordingError))
            return error
        forget_failure(folder, given)
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
                    keep_failure(folder, given, str(error))
                    add_seat()
                    seat = None
                if error is not None and (given is None or _is_of_all(error)):
                    raise error.args[0] if isinstance(error, WorkError) else error
                if given is not None and not tally.settle(given, error) and not read_failure(folder, given).set_aside:
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
            keep_plan(folder, title=title, shards=count, frames=frames, on=workers.on)
            workers.make(chain([first], missing), folder, tally, most=count)
    known = failed_keys(folder)
    if failed := [read_failure(folder, one) for one in shards() if one.key in known]:
        if count == 1 and tally.error is not None:
            forget_plan(folder)
            raise tally.error
        raise ShardError({failure.name: failure.why[-1] for failure in failed}, shards=count)
    with suppress(OSError):
        forget_plan(folder)


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
            part = open_table(folder / one.part)
            if on_rows is None:
                yield from map(part.read_row_group, range(part.num_row_groups))
            else:
                on_rows(table := part.read())
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
        if out is not None and out.exists() and not all(made for _, made in look_for(parts, shards())):
            require_new_file(out, overwrite=overwrite)  # it was made of other parts
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
    known = failed_keys(folder)
    for one, made in look_for(folder, shards()):
        if made:
            if one.key in known:  # whoever made it after all was ended before it could say so
                forget_failure(folder, one)
            tally.add(one)
            continue
        if one.key in known:
            if not retry_failed and read_failure(folder, one).set_aside:
                continue
            if retry_failed:
                forget_failure(folder, one)
        yield one


__all__ = ["make_parts"]
