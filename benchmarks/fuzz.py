"""What becomes of hostile inputs: some of every format (`tests/fuzz/hostile.py`), each read in a process of its own.

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
_TESTS = Path(__file__).resolve().parent.parent / "tests"
sys.path += [str(_TESTS / "fuzz"), str(_TESTS / "helpers")]

import torch  # noqa: E402 (after the threads are told)
from hostile import FORMATS, Input, inputs, original, outcome  # noqa: E402

LONGEST_S = 10.0
MOST_BYTES = 1_500_000_000
KINDS = ("refused", "same", "accepted", "wrong", "partial", "traceback", "hang", "memory")


def in_a_child(one: Input, originals: Path) -> tuple[str, str]:
    """Outcome of an input, and what was said, from a process that may hang or fill the memory."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        try:
            size = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
            most = size + 3 * MOST_BYTES
            resource.setrlimit(resource.RLIMIT_AS, (most, most))
            told = outcome(one, originals, folder / "input")
        except MemoryError:
            told = "memory", "more than was left"
        except BaseException as error:  # whatever there is
            frames, at = error.__traceback__, ""
            while frames:
                at, frames = f"{frames.tb_frame.f_code.co_filename}:{frames.tb_lineno}", frames.tb_next
            told = "traceback", f"{type(error).__name__}: {str(error)[:200]} ({at})"
        os.write(writer, json.dumps(told).encode()[:60_000])
        os._exit(0)
    os.close(writer)
    ready = select.select([reader], [], [], LONGEST_S)[0]
    if not ready:
        os.kill(child, signal.SIGKILL)
    _, status, used = os.wait4(child, 0)
    text = os.read(reader, 65536)
    os.close(reader)
    shutil.rmtree(folder, ignore_errors=True)
    if not ready:
        return "hang", f"more than {LONGEST_S:g} s"
    if not text:
        return "traceback", f"the process ended with status {status}"
    if (more := used.ru_maxrss * 1024 - before) > MOST_BYTES:
        return "memory", f"{more / 1e9:.1f} GB more"
    kind, said = json.loads(text)
    return kind, said


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


def run(count: int, seed: int, keep: Path | None) -> Iterator[tuple[Input, str, str]]:
    """Outcomes of so many inputs, those that are kept first."""
    known: dict[Input, tuple[str, str]] = {}
    if keep is not None and keep.is_file():
        for line in keep.read_text().splitlines():
            row = json.loads(line)
            known[Input(**row["input"])] = row["outcome"], row["said"]
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory(prefix="fuzz-") as originals:
        make_originals(Path(originals))
        for one in inputs(count, seed=seed):
            if one not in known:
                told = in_a_child(one, Path(originals))
                if keep is not None:
                    keep.parent.mkdir(parents=True, exist_ok=True)
                    with keep.open("a") as stream:
                        stream.write(json.dumps({"input": asdict(one), "outcome": told[0], "said": told[1]}) + "\n")
                known[one] = told
            yield one, *known[one]


def main() -> None:
    """Read them, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=250)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path)
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
    for one, kind, said in run(given.inputs, given.seed, given.keep):
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
