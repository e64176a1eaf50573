"""What makes a ratio of speeds fair: a neighbour that keeps one core busy, and a rival on its own best terms."""

import multiprocessing
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

Answer = TypeVar("Answer")


@contextmanager
def busy_process() -> Iterator[None]:
    """Keep one core busy by another process while the context is open."""
    spinning = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        yield
    finally:
        spinning.kill()
        spinning.wait()


def at_its_best(timed: Callable[..., tuple[float, Answer]], *inputs: Any) -> tuple[float, Answer]:
    """What a function that measures its own seconds gives under the better of two ways of waiting.

    Threads that sleep while they wait (`OMP_WAIT_POLICY=passive`, good beside an engine with threads of its own) make a
    loop of small batches up to three times slower where waking an idle core takes long, as on virtual machines. So it
    runs in a process each way, and the faster one counts. Function and inputs must travel between processes.
    """
    return min((_in_process(spins, timed, *inputs) for spins in (None, "300000")), key=lambda found: found[0])


def _in_process(spins: str | None, timed: Callable[..., tuple[float, Answer]], *inputs: Any) -> tuple[float, Answer]:
    if spins:
        os.environ["GOMP_SPINCOUNT"] = spins  # what libgomp does when nobody tells it how to wait
    try:
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as process:
            return process.submit(timed, *inputs).result()
    finally:
        os.environ.pop("GOMP_SPINCOUNT", None)
