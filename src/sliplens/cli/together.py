"""Several pieces of work at the same time, a process for each, shown on one terminal."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import TypeAlias

from sliplens.cli.console import Bar, progress_bars
from sliplens.cli.screen import Remote, Screen, show
from sliplens.errors import SliplensError

Work: TypeAlias = Callable[[str, Screen], None]


def run_together(work: Work, names: Sequence[str], *, threads: int) -> None:
    """Do a piece of work for every name, each in a process of its own.

    Where one fails or this process is interrupted, the others are ended too, as if the machine had stopped: the work
    must leave nothing behind that it cannot go on from.

    Parameters
    ----------
    work
        Takes a name, and where to show how far it is; must be picklable.
    names
        What there is to do.
    threads
        Of torch, in each process.

    Raises
    ------
    SliplensError
        That of the process that failed first, or one that says that it died.
    """
    context = multiprocessing.get_context("spawn")  # a fork would inherit locks of torch's threads
    running: dict[Connection, tuple[str, SpawnProcess, Bar]] = {}
    with progress_bars() as new_bar:
        try:
            for name in names:
                ours, theirs = context.Pipe(duplex=False)
                process = context.Process(target=_work, args=(work, name, threads, theirs), name=name, daemon=True)
                process.start()
                theirs.close()  # so that the end of the process is the end of the pipe
                running[ours] = (name, process, new_bar())
            while running:
                for pipe in wait(list(running)):
                    assert isinstance(pipe, Connection)
                    name, process, bar = running[pipe]
                    try:
                        event = pipe.recv()
                    except EOFError:
                        process.join()
                        del running[pipe]
                        _require_end(name, process.exitcode)
                        continue
                    if event[0] == "failed":
                        raise event[1]
                    show(event, bar)
        finally:
            for _, process, _ in running.values():
                process.terminate()
                process.join()


def _require_end(name: str, exit_code: int | None) -> None:
    if not exit_code:
        return
    if exit_code < 0:
        raise SliplensError(
            f"the process for {name} was ended by signal {-exit_code}, perhaps for want of memory; give the same "
            "command again with --jobs 1"
        )
    raise SliplensError(
        f"the process for {name} failed; what it printed above is a fault of sliplens, please report it"
    )


def _work(work: Work, name: str, threads: int, pipe: Connection) -> None:
    # an interruption reaches every process of a terminal; the first of them ends the others
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    import torch

    torch.set_num_threads(threads)
    try:
        work(name, Remote(pipe))
    except SliplensError as error:
        pipe.send(("failed", error))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
