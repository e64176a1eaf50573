"""Runs a function over the parts of a work: on disk or in memory, resumed, in this process, in several, or on Ray.

A part is a file or a folder that is complete or absent. Its name holds a hash of everything that shapes it, so that an
interrupted work continues with the parts that are missing, and changed frames or settings make other parts.
"""

import errno
import hashlib
import logging
import os
import pickle
import re
import secrets
import signal
import sys
import threading
import time
import warnings
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import copy_context
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, ClassVar, TypeAlias
from urllib.parse import quote

import pyarrow as pa
from loky import get_reusable_executor
from loky.process_executor import BrokenProcessPool

from sliplens._version import __version__
from sliplens.codec import open_table, regrouped, save_result, write_tables
from sliplens.errors import InputError, PartError, SliplensError
from sliplens.extras import pick, require_packages
from sliplens.files import hash_json, locked, output_folder, partial_folder, remove, require_new_file, scratch_folder
from sliplens.progress import OnProgress, counting, current_reporter, open_stage, report_file

LONGEST = 8192
"""Largest number of frames of a part; a longer trial is divided."""
_LONGEST_NAME = 200  # of a folder; file systems take 255 bytes

MakePart: TypeAlias = Callable[[Any, Path], None]
"""Takes the item of a part and the path to write; reports its frames by `progress.report_progress`."""


class Work(ABC):
    """Function over parts with its settings; pickled for other processes, so that it holds paths and settings."""

    in_threads: ClassVar[bool] = False
    """True if one process makes several parts at a time in threads."""

    @property
    def on_gpu(self) -> bool:
        """True if each worker needs a graphics card."""
        return False

    @abstractmethod
    def begin(self) -> MakePart:
        """Load what all parts need, once in each process, and return the function that makes one."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Part:
    """Some frames of a trial that are processed together."""

    item: Any
    """Argument of the function that makes the part; pickled, so that it holds names and numbers, no frames."""
    name: str
    """Name in messages, such as `trial-012 from frame 8192`."""
    frames: int
    path: str
    """Path in the folder of all parts, with a hash of everything that shapes the part."""


def part(
    item: Any,
    *,
    trial: str,
    frames: int,
    recipe: object,
    content: str,
    first: int = 0,
    suffix: str = "",
    name: str | None = None,
) -> Part:
    """Return a part of a trial, named by everything that shapes it.

    `content` is the hash of the trial's frames, `recipe` what else shapes the part (weights, settings). The part is a
    folder if `suffix` is empty. `name` is the trial's if None.
    """
    key = hash_json({"recipe": recipe, "shown": content, "first": first, "frames": frames, "sliplens": __version__})
    folder = quote(trial, safe="")
    if len(folder) > _LONGEST_NAME:
        folder = re.sub("%[0-9A-F]?$", "", folder[:_LONGEST_NAME]) + f"~{hash_json(trial)}"
    name = name or (f"{trial} from frame {first}" if first else trial)
    return Part(item=item, name=name, frames=frames, path=f"trial={folder}/{first:08d}-{frames}-{key}{suffix}")


def run_parts(
    work: Work,
    parts: Sequence[Part],
    folder: Path,
    *,
    on: str = "serial",
) -> None:
    """Make the parts that are missing in a folder; one that fails does not stop the others.

    A part whose process ended is tried once more, by itself.

    Parameters
    ----------
    on
        Name of an executor with its argument: `serial`, `processes`, `processes=4`, `ray`, `ray=ADDRESS`.

    Raises
    ------
    PartError
        If parts failed, after all others were made; the error of the part itself if there is only one.
    InputError
        If the executor is unknown, or the work cannot be prepared.
    """
    name, _, argument = on.partition("=")
    executor = pick(EXECUTORS, name, noun="executor")
    total, done, shares = sum(each.frames for each in parts), 0, dict[str, int]()
    report, lock, missing = current_reporter(), threading.Lock(), deque[Part]()

    def count(each: Part, made: int, of: int) -> None:
        """Report that a share of a part is done; 0 again if it failed."""
        nonlocal done
        with lock:
            frames = each.frames * made // max(of, 1)
            more = frames - shares.get(each.path, 0)
            shares[each.path], done = frames, done + more
            if more > 0:
                report(done, total)

    for each in parts:
        if (folder / each.path).exists():
            count(each, 1, 1)
        else:
            missing.append(each)
    errors: dict[str, Exception] = {}
    if missing:
        for draft in folder.glob("trial=*/.*.draft*"):  # of processes that were killed, perhaps while writing
            remove(draft)
        folder.mkdir(parents=True, exist_ok=True)
        with executor(work, argument, len(missing)) as pool:
            errors = _run(pool, missing, folder, count)
    for error in errors.values() if len(parts) == 1 else ():
        raise error
    if errors:
        sentences = {
            name: str(error) if isinstance(error, SliplensError) else f"{type(error).__name__}: {error}"
            for name, error in errors.items()
        }
        raise PartError(sentences, parts=len(parts))


def _run(
    pool: "_Pool", missing: deque[Part], folder: Path, count: Callable[[Part, int, int], None]
) -> dict[str, Exception]:
    """Submit parts until none is missing; return the errors by the name of the part."""
    running: dict[Future, Part] = {}
    alone: deque[Part] = deque()  # a process ended while they were made: which of them is at fault shows one by one
    lost, errors = set[str](), dict[str, Exception]()
    while missing or alone or running:
        waiting, most = (alone, 1) if alone else (missing, pool.workers)
        while waiting and len(running) < most:
            each = waiting.popleft()
            try:
                running[pool.submit(folder, each, partial(count, each))] = each
            except pool.lost:
                alone.append(each)
                break
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            each = running.pop(future)
            try:
                error = future.result()
            except pool.lost:
                error = SliplensError("its process was ended from outside, perhaps for want of memory")
                if each.path not in lost:
                    lost.add(each.path)
                    alone.append(each)
                    continue
            if error is None:
                count(each, 1, 1)
                continue
            if isinstance(error, _PreparationError):
                raise error.args[0]
            if isinstance(error, OSError) and error.errno in {errno.ENOSPC, errno.EDQUOT, errno.EROFS}:
                raise error  # no other part could be written either
            errors[each.name] = error
            count(each, 0, 1)
    return errors


class _PreparationError(Exception):
    """Error of `Work.begin`: every part would fail with it."""


def _make(prepare: Callable[[], MakePart], folder: Path, each: Part) -> Exception | None:
    """Make a part under a draft's name and rename it; return the error, if any."""
    path = folder / each.path
    draft = path.with_name(f".{path.name}.{os.getpid()}.draft")
    try:
        try:
            make = prepare()
        except Exception as error:  # raised again by the driver
            return _PreparationError(error)
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            make(each.item, draft)
            draft.replace(path)
    except Exception as error:  # a damaged trial must not end the others
        return error
    finally:
        remove(draft)
    return None


@dataclass(frozen=True, kw_only=True)
class _Pool:
    """Workers of an executor."""

    workers: int
    submit: Callable[[Path, Part, OnProgress], Future]
    """Takes the folder of the parts, a part, and a callback for its progress."""
    lost: type[Exception] | tuple[()]
    """Error of a future whose worker ended; none where it cannot."""


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def _serial(work: Work, _: str, most: int) -> Iterator[_Pool]:
    prepare = lru_cache(work.begin)
    threads = min(cores(), most) if work.in_threads else 1
    ended = threading.Event()

    def make(folder: Path, each: Part, count: OnProgress) -> Exception | None:
        def report(done: int, total: int) -> None:
            if ended.is_set():
                raise KeyboardInterrupt
            count(done, total)

        with counting(report):
            return _make(prepare, folder, each)

    def submit(*arguments: Any) -> Future:
        if threads > 1:
            return pool.submit(copy_context().run, make, *arguments)
        future: Future = Future()
        future.set_result(make(*arguments))
        return future

    with ThreadPoolExecutor(threads) as pool:
        try:
            yield _Pool(workers=threads, submit=submit, lost=())
        except BaseException:
            ended.set()
            pool.shutdown(cancel_futures=True)
            raise


@contextmanager
def _processes(work: Work, number: str, most: int) -> Iterator[_Pool]:
    if number and not (number.isdigit() and int(number)):
        raise InputError(f"--on processes={number} is no number of processes; write processes or processes=2")
    count = min(int(number or cores()), most)
    threads, packed = max(1, cores() // count), pickle.dumps(work)
    # loky ends a worker that has grown by 300 MB, such as by loading torch, and starts another
    warnings.filterwarnings("ignore", "A worker was restarted", UserWarning)

    def executor() -> Any:  # a new one after a worker was lost
        return get_reusable_executor(count, timeout=60, initializer=_begin_worker, initargs=(os.getpid(), threads))

    def submit(folder: Path, each: Part, _: OnProgress) -> Future:
        return executor().submit(_make_remotely, packed, Path.cwd(), folder, each)

    try:
        yield _Pool(workers=count, submit=submit, lost=BrokenProcessPool)
    except BaseException:
        executor().shutdown(kill_workers=True)
        raise


def _begin_worker(parent: int, threads: int) -> None:
    """Prepare a process for parts: it ends with its parent, and leaves interruptions to it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ["OMP_NUM_THREADS"] = str(threads)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(threads)

    def end_with_parent() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


def _make_remotely(packed: bytes, working_directory: Path, folder: Path, each: Part) -> Exception | None:
    os.chdir(working_directory)  # relative paths start there
    return _make(partial(_prepared, packed), folder, each)


@lru_cache(maxsize=1)
def _prepared(packed: bytes) -> MakePart:
    return pickle.loads(packed).begin()  # noqa: S301 (bytes that this program packed for its own process)


@contextmanager
def _ray(work: Work, address: str, most: int) -> Iterator[_Pool]:
    require_packages("ray", extra="ray", purpose="--on ray")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # else Ray reports its use to its makers
    import ray  # noqa: PLC0415 (an extra)  # pyright: ignore[reportMissingImports]
    from ray.exceptions import RayError  # noqa: PLC0415  # pyright: ignore[reportMissingImports]

    connected = ray.is_initialized()
    if not connected:
        # without an address Ray tries the one of an earlier cluster, which may be gone
        where: dict[str, Any] = {"address": address} if address else {"address": "local", "include_dashboard": False}
        try:
            ray.init(**where, log_to_driver=False, logging_level=logging.ERROR)
        except Exception as error:  # what it raises if a node takes more than 30 s to start
            reason, option = " ".join(str(error).split())[:200], f"ray={address}" if address else "ray"
            raise InputError(f"--on {option} has no cluster of Ray ({reason}); start it, check it, or retry") from None
    try:
        unit = "GPU" if work.on_gpu else "CPU"
        if (count := int(ray.cluster_resources().get(unit, 0))) < 1:
            raise InputError(f"the cluster of Ray has no {unit}; start a node that has one")
        packed, directory = ray.put(pickle.dumps(work)), Path.cwd()
        options: dict[str, Any] = {"num_cpus": 1, "num_gpus": int(work.on_gpu), "max_retries": 0}
        task: Any = ray.remote(scheduling_strategy="SPREAD", **options)(_make_remotely)

        def submit(folder: Path, each: Part, _: OnProgress) -> Future:
            return task.remote(packed, directory, folder, each).future()

        yield _Pool(workers=min(count, most), submit=submit, lost=RayError)
    finally:
        if not connected:
            ray.shutdown()


EXECUTORS = {"serial": _serial, "processes": _processes, "ray": _ray}
"""Where parts are made. A row takes the work, what follows `=`, and the number of parts, and opens its workers."""


def require_executor(on: str) -> None:
    """Check the name of an executor (`--on`) before any work is done."""
    pick(EXECUTORS, on.partition("=")[0], noun="executor")


def run_table(
    work: Work,
    parts: Sequence[Part],
    out: Path | None,
    *,
    title: str,
    recipe: object,
    resumable: bool = True,
    on: str = "serial",
    overwrite: bool = False,
    on_rows: Callable[[pa.Table], None] | None = None,
) -> tuple[pa.Schema, pa.Table | None]:
    """Make parts that are Parquet files and join them; return the columns, and the rows if `out` is None.

    With a suffix `out` is one file. Without, it is a folder, and the parts remain: a Parquet data set with a folder per
    trial. `on_rows` is called with the rows of each part in turn. Other parameters as in `run_parts`.
    """

    def make(folder: Path) -> pa.Schema:
        with open_stage(title):
            run_parts(work, parts, folder, on=on)
        return open_table(folder / parts[0].path).schema_arrow

    def rows(folder: Path) -> Iterator[pa.Table]:
        for each in parts:
            file = open_table(folder / each.path)
            if on_rows is None:
                yield from map(file.read_row_group, range(file.num_row_groups))
            else:
                on_rows(table := file.read())
                yield table

    if out is not None and not out.suffix:
        every = hashlib.sha256("".join(each.path for each in parts).encode())  # changed frames make another result
        config = {"recipe": recipe, "shards_sha256": every.hexdigest()}
        if not resumable:  # frames in memory cannot be compared with those of an earlier call
            config["made"] = secrets.token_hex(8)
        with output_folder(out, stage=title, config=config, overwrite=overwrite) as output:
            schema = make(output.folder)
            deque(rows(output.folder) if on_rows is not None else (), maxlen=0)
            return schema, None
    with scratch_folder() if out is None else _parts_beside(out, resumable=resumable, replaces=overwrite) as folder:
        schema = make(folder)
        return schema, write_tables(regrouped(rows(folder), rows=LONGEST), out, schema)


@contextmanager
def _parts_beside(table: Path, *, resumable: bool, replaces: bool) -> Iterator[Path]:
    """Open the folder of the parts of a table, which stays after an interruption."""
    folder = partial_folder(table)
    with locked(table):
        require_new_file(table, overwrite=replaces)
        if not resumable:
            remove(folder)
        try:
            yield folder
        except BaseException:
            if not any(path.is_file() for path in folder.rglob("*")):
                remove(folder)
            raise
        remove(folder)


def keep_record(
    folder: Path, make: Callable[[Path], Any], *, stage: str, config: object, what: str, overwrite: bool = False
) -> None:
    """Keep a record in a folder, complete or absent; `make` takes the folder of parts that the next call continues."""
    with output_folder(folder, stage=stage, config=config, overwrite=overwrite) as output:
        if not output.complete:
            save_result(make(output.folder / "parts"), output.folder)
            remove(output.folder / "parts")  # not before: what fails above goes on from them
    report_file(folder, what, kept=output.complete)
