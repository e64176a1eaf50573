"""What becomes of hostile inputs: some of every format (`tests/fuzz/hostile.py`), read by processes that may end.

Refused is a sentence; same is an input that was read as the original is; accepted is one that was read as something
else, which it may well be; wrong is one that no recording can be and that was read none the less. A traceback, more
than 10 s, 1.5 GB more than the process had, and files left behind by a refusal are failures. `--keep` notes every
outcome in a file and goes on after those that are there; `--one` reads a single input again, here, to be looked at.
`--json` ends with one line of JSON.
"""

import json
import os
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # the children of a process must not inherit its threads
_TESTS = Path(__file__).resolve().parent.parent
sys.path += [str(_TESTS / "fuzz"), str(_TESTS / "helpers")]

import torch  # noqa: E402 (after the threads are told)
from hostile import FORMATS, Input, bomb, inputs, outcome, whole_reading  # noqa: E402
from outcomes import in_a_child, parser, resume, tabulate  # noqa: E402

from sliplens.cli.console import Terminal  # noqa: E402

LONGEST_S = 10.0
MOST_BYTES = 1_500_000_000
KINDS = ("refused", "same", "accepted", "wrong", "partial", "traceback", "hang", "memory")


def read_all(waiting: list[Input], originals: Path, workers: int) -> Iterator[tuple[Input, str, str]]:
    """Outcomes of inputs as they come, each read by a process of its own; a hang counts if it comes twice."""
    running: dict[int, tuple[Input, int, str, float]] = {}
    slow: set[Input] = set()
    while waiting or running:
        while waiting and len(running) < workers:
            (answers, writer), folder = os.pipe(), tempfile.mkdtemp(prefix="fuzz-")
            if not (child := os.fork()):
                try:
                    _read(waiting[-1], originals, Path(folder) / "input", writer)
                finally:
                    os._exit(0)
            os.close(writer)
            running[answers] = waiting.pop(), child, folder, time.monotonic() + LONGEST_S
        ready = select.select(list(running), [], [], 0.2)[0]
        for answers, (one, child, folder, until) in list(running.items()):
            if answers not in ready and time.monotonic() < until:
                continue
            text = os.read(answers, 65536) if answers in ready else b""
            os.close(answers)
            if not text and answers not in ready:
                os.kill(child, signal.SIGKILL)
            status = os.waitpid(child, 0)[1]
            shutil.rmtree(folder, ignore_errors=True)
            del running[answers]
            if text:
                kind, told = json.loads(text)
                yield one, kind, told
            elif answers in ready:
                yield one, "traceback", f"the process ended with status {status}"
            elif one in slow:
                yield one, "hang", f"over {LONGEST_S:g} s"
            else:
                slow.add(one)
                waiting.append(one)


def _read(one: Input, originals: Path, folder: Path, answers: int) -> None:
    """Write the outcome of an input into a pipe."""
    most = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE") + 3 * MOST_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    try:
        told = outcome(one, originals, folder)
    except MemoryError:
        told = "memory", "more than was left"
    except BaseException as error:  # whatever there is
        *_, last = traceback.extract_tb(error.__traceback__)
        told = "traceback", f"{type(error).__name__}: {str(error)[:200]} ({last.filename}:{last.lineno})"
    more = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before
    if more > MOST_BYTES:
        told = "memory", f"{more / 1e9:.1f} GB more"
    os.write(answers, json.dumps(told).encode()[:60_000])


def judge(rest: list[Input], workers: int) -> Iterator[tuple[Input, str, str]]:
    """Outcomes of inputs, with valid ones made for them."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder, Terminal().stage("Reading hostile inputs") as told:
        originals = Path(folder)
        in_a_child(lambda: [whole_reading(name, originals) for name in FORMATS])
        bomb()  # for all processes
        for number, answer in enumerate(read_all(rest[::-1], originals, workers), start=1):
            told(number, len(rest))
            yield answer


def main() -> None:
    """Read them, and print a table."""
    options = parser(__doc__, cases="inputs", count=250)
    options.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    options.add_argument("--one", nargs=3, metavar=("FORMAT", "CHANGE", "SEED"))
    given = options.parse_args()
    if given.one:
        one = Input(format=given.one[0], change=given.one[1], seed=int(given.one[2]))
        with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
            print(*outcome(one, Path(folder) / "originals", Path(folder) / "input"))
        return
    wanted = list(inputs(given.count, seed=given.seed))
    print(tabulate(
        resume(given.keep, wanted, Input, lambda rest: judge(rest, given.workers)), lambda one: one.format,
        rows=FORMATS, columns=KINDS, passed=KINDS[:3], as_json=given.json,
    ))  # fmt: skip


if __name__ == "__main__":
    main()
