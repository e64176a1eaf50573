"""What becomes of hostile inputs: some of every format (`tests/fuzz/hostile.py`), read by processes that may end.

Refused is a sentence; same is an input that was read as the original is; accepted is one that was read as something
else, which it may well be; wrong is one that no recording can be and that was read none the less. A traceback, more
than 10 s, 1.5 GB more than the process had, and files left behind by a refusal are failures. `--keep` notes every
outcome in a file and goes on after those that are there; `--one` reads a single input again, here, to be looked at.
`--json` ends with one line of JSON.
"""

import argparse
import json
import os
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # the children of a process must not inherit its threads
_TESTS = Path(__file__).resolve().parent.parent
sys.path += [str(_TESTS / "fuzz"), str(_TESTS / "helpers")]

import torch  # noqa: E402 (after the threads are told)
from hostile import FORMATS, Input, bomb, inputs, original, outcome  # noqa: E402

from sliplens.cli.console import Terminal  # noqa: E402

LONGEST_S = 10.0
MOST_BYTES = 1_500_000_000
KINDS = ("refused", "same", "accepted", "wrong", "partial", "traceback", "hang", "memory")


class Worker:
    """A process that reads one input after another, until one ends it."""

    def __init__(self, originals: Path) -> None:
        (theirs, self._write), (self.read, answers) = os.pipe(), os.pipe()
        self.child = os.fork()
        if not self.child:
            try:
                os.close(self._write)
                _work(theirs, answers, originals)
            finally:
                os._exit(0)
        os.close(theirs)
        os.close(answers)
        self.input: Input | None = None

    def take(self, one: Input) -> None:
        """Begin to read an input."""
        self.input, self.until = one, time.monotonic() + LONGEST_S
        self._folder = tempfile.mkdtemp(prefix="fuzz-")
        os.write(self._write, json.dumps([asdict(one), self._folder]).encode() + b"\n")

    def outcome(self) -> tuple[str, str] | None:
        """What became of the input, once it is there or the time is over; None before. Then it is idle, or ended."""
        ready = select.select([self.read], [], [], 0)[0]
        if not ready and time.monotonic() < self.until:
            return None
        text = os.read(self.read, 65536) if ready else b""
        shutil.rmtree(self._folder, ignore_errors=True)
        self.input = None
        if text:
            kind, said = json.loads(text)
            if kind == "memory":
                self.end()
            return kind, said
        status = self.end()
        return ("traceback", f"the process ended with status {status}") if ready else ("hang", f"over {LONGEST_S:g} s")

    def end(self) -> int:
        """End the process; gives how it ended."""
        for pipe in (self._write, self.read):
            os.close(pipe)
        if not (ended := os.waitpid(self.child, os.WNOHANG))[0]:
            os.kill(self.child, signal.SIGKILL)
            ended = os.waitpid(self.child, 0)
        self.child = 0
        return ended[1]


def _work(inputs: int, answers: int, originals: Path) -> None:
    """Answer with the outcome of one input after another."""
    size = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    most = size + 3 * MOST_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    with os.fdopen(inputs) as lines:
        for line in lines:
            one, folder = json.loads(line)
            try:
                told = outcome(Input(**one), originals, Path(folder) / "input")
            except MemoryError:
                told = "memory", "more than was left"
            except BaseException as error:  # whatever there is
                frames, at = error.__traceback__, ""
                while frames:
                    at, frames = f"{frames.tb_frame.f_code.co_filename}:{frames.tb_lineno}", frames.tb_next
                told = "traceback", f"{type(error).__name__}: {str(error)[:200]} ({at})"
            more = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before
            if more > MOST_BYTES:
                told = "memory", f"{more / 1e9:.1f} GB more"
            os.write(answers, json.dumps(told).encode()[:60_000])


def read_all(rest: list[Input], originals: Path, workers: int) -> Iterator[tuple[Input, str, str]]:
    """Outcomes of inputs, as they come. What fails is read again by a process that read nothing else.

    It is a failure if it fails there too, or ended a process or raised an error the first time.
    """
    pool, waiting = [Worker(originals) for _ in range(workers)], rest[::-1]
    while waiting or any(one.input for one in pool):
        for place, worker in enumerate(pool):
            if worker.input is None and waiting:
                worker.take(waiting.pop())
            elif (one := worker.input) and (told := worker.outcome()):
                if told[0] in {"hang", "memory", "traceback"}:
                    told = _alone(one, told, originals)
                if not worker.child:
                    pool[place] = Worker(originals)
                yield one, *told
        select.select([one.read for one in pool if one.input], [], [], 0.2)
    for worker in pool:
        worker.end()


def _alone(one: Input, told: tuple[str, str], originals: Path) -> tuple[str, str]:
    worker = Worker(originals)
    worker.take(one)
    while not (again := worker.outcome()):
        select.select([worker.read], [], [], 0.2)
    if worker.child:
        worker.end()
    if again[0] == told[0] or told[0] != "traceback":
        return again
    return told[0], f"{told[1]}; alone it was {again[0]}"


def make_originals(folder: Path) -> None:
    """Make the valid inputs in a process of its own, whose threads stay there."""
    child = os.fork()
    if not child:
        code = 1
        try:
            for name in FORMATS:
                original(name, folder)
            code = 0
        finally:
            os._exit(code)
    if os.waitpid(child, 0)[1]:
        raise SystemExit("the valid inputs could not be made")


def run(count: int, seed: int, keep: Path | None, workers: int) -> Iterator[tuple[Input, str, str]]:
    """Outcomes of so many inputs, those that are kept first."""
    known: dict[Input, tuple[str, str]] = {}
    if keep is not None and keep.is_file():
        for line in keep.read_text().splitlines():
            row = json.loads(line)
            known[Input(**row["input"])] = row["outcome"], row["said"]
    wanted = list(inputs(count, seed=seed))
    yield from ((one, *known[one]) for one in wanted if one in known)
    if not (rest := [one for one in wanted if one not in known]):
        return
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory(prefix="fuzz-") as originals, Terminal().stage("Reading hostile inputs") as told:
        make_originals(Path(originals))
        bomb()  # for all processes
        for number, (one, kind, said) in enumerate(read_all(rest, Path(originals), workers), start=1):
            told(number, len(rest))
            if keep is not None:
                keep.parent.mkdir(parents=True, exist_ok=True)
                with keep.open("a") as stream:
                    stream.write(json.dumps({"input": asdict(one), "outcome": kind, "said": said}) + "\n")
            yield one, kind, said


def main() -> None:
    """Read them, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=250)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--one", nargs=3, metavar=("FORMAT", "CHANGE", "SEED"))
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    if given.one:
        one = Input(format=given.one[0], change=given.one[1], seed=int(given.one[2]))
        with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
            print(*outcome(one, Path(folder) / "originals", Path(folder) / "input"))
        return
    table: dict[str, Counter[str]] = {name: Counter() for name in FORMATS}
    began, failures = time.perf_counter(), []
    for one, kind, said in run(given.inputs, given.seed, given.keep, given.workers):
        table[one.format][kind] += 1
        if kind not in {"refused", "same", "accepted"}:
            failures.append(f"  {kind}: {one.format!r} {one.change!r} {one.seed}  {said}")
    print(f"{'':16}" + "".join(f"{kind:>10}" for kind in KINDS))
    for name, counts in table.items():
        print(f"{name:16}" + "".join(f"{counts[kind] or '':>10}" for kind in KINDS))
    total = sum(table.values(), Counter())
    print(f"{'all':16}" + "".join(f"{total[kind] or '':>10}" for kind in KINDS), *failures, sep="\n")
    if given.json:
        named = {
            "tracebacks": "traceback",
            "hangs": "hang",
            "memory": "memory",
            "partial": "partial",
            "accepted_wrong": "wrong",
        }
        figures = {"inputs": total.total(), **{name: total[kind] for name, kind in named.items()}}
        print(json.dumps({**figures, "minutes": round((time.perf_counter() - began) / 60, 2)}))


if __name__ == "__main__":
    main()
