"""Several pieces of work at the same time, a process for each, with their progress shown here."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from sliplens.errors import SliplensError
from sliplens.progress import OnProgress, note, stage, wrote

_PIPES: dict[str, Connection] = {}
"""Where a process of the pool tells its progress, by piece of work."""


def run_together(
    work: Callable[[str, OnProgress], object], names: Sequence[str], *, threads: int, on_progress: OnProgress | None
) -> None:
    """Do a piece of work, which must be picklable, for every name, each in a process with so many threads of torch.

    Where one fails or this process is interrupted, the others are ended too, as if the machine had stopped: the work
    must leave nothing behind that it cannot go on from.
    """
    context = multiprocessing.get_context("spawn")  # a fork would inherit locks of torch's threads
    pipes = {name: context.Pipe(duplex=False) for name in names}
    alive, life = context.Pipe(duplex=False)  # its end is that of the processes

    def end_with(future: Future[None]) -> None:
        if future.cancelled() or future.exception() is not None:
            life.close()

    pool = ProcessPoolExecutor(
        len(names),
        mp_context=context,
        initializer=_prepare,
        initargs=(threads, alive, {name: theirs for name, (_, theirs) in pipes.items()}),
    )
    try:
        futures = [pool.submit(_work, work, name) for name in names]
        for future in futures:
            future.add_done_callback(end_with)
        for _, theirs in pipes.values():
            theirs.close()  # so that the end of the last process is the end of the pipes
        _show({ours: ExitStack() for ours, _ in pipes.values()}, on_progress)
    except BaseException:
        life.close()
        raise
    finally:
        pool.shutdown(cancel_futures=True)
        life.close()
    errors = [error for future in futures if (error := future.exception()) is not None]
    for error in errors:
        if not isinstance(error, BrokenProcessPool):
            raise error
    if errors:
        raise SliplensError(
            "a process of the study was ended from outside, perhaps for want of memory; give the same command again "
            "with --jobs 1"
        )


def _show(pipes: dict[Connection, ExitStack], on_progress: OnProgress | None) -> None:
    """Show what the processes tell until the last has ended."""
    counts: dict[Connection, OnProgress] = {}
    with ExitStack() as every:
        for opened in pipes.values():
            every.push(opened)
        while pipes:
            for pipe in wait(list(pipes)):
                assert isinstance(pipe, Connection)
                try:
                    kind, *values = pipe.recv()
                except EOFError:
                    kind, values = "done", []
                match kind:
                    case "done":
                        pipes.pop(pipe).close()
                    case "begin":
                        counts[pipe] = pipes[pipe].enter_context(stage(on_progress, *values))
                    case "count":
                        counts[pipe](*values)
                    case "end":
                        pipes[pipe].close()
                    case "wrote":
                        path, what, kept = values
                        wrote(on_progress, path, what, kept=kept)
                    case "note":
                        note(on_progress, *values)


class _Relay:
    """The `Stages` of the process that began this one."""

    def __init__(self, pipe: Connection) -> None:
        self._tell = pipe.send

    def __call__(self, done: int, total: int, /) -> None:
        self._tell(("count", done, total))

    @contextmanager
    def stage(self, title: str, /) -> Iterator[OnProgress]:
        self._tell(("begin", title))
        yield self
        self._tell(("end",))

    def wrote(self, path: Path, what: str, /, *, kept: bool = False) -> None:
        self._tell(("wrote", path, what, kept))

    def note(self, message: str, /) -> None:
        self._tell(("note", message))


def _prepare(threads: int, alive: Connection, pipes: dict[str, Connection]) -> None:
    # an interruption reaches every process of a terminal; the first of them ends the others
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(alive,), daemon=True).start()
    import torch  # noqa: PLC0415 (takes seconds, and the others need it not)

    torch.set_num_threads(threads)
    _PIPES.update(pipes)


def _end_with(alive: Connection) -> None:
    alive.poll(None)
    os._exit(1)


def _work(work: Callable[[str, OnProgress], Any], name: str) -> None:
    try:
        work(name, _Relay(_PIPES[name]))
    finally:
        _PIPES[name].send(("done",))
