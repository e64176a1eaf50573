"""Outcomes of many cases: stored as they come, and printed as a table."""

import argparse
import json
import os
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

Case = TypeVar("Case")
Outcomes = Iterator[tuple[Case, str, str]]
"""Case, word of the outcome, and message."""


def in_a_child(work: Callable[[], object]) -> None:
    """Do something in a process of its own, whose threads stay there."""
    if not (child := os.fork()):
        code = 1
        try:
            work()
            code = 0
        finally:
            os._exit(code)
    if os.waitpid(child, 0)[1]:
        raise SystemExit("the material could not be made")


def parser(text: str | None, *, cases: str, count: int) -> argparse.ArgumentParser:
    """Options of both programs."""
    options = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument(f"--{cases}", type=int, default=count, dest="count")
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--keep", type=Path)
    options.add_argument("--json", action="store_true")
    return options


def resume(
    keep: Path | None, wanted: Sequence[Case], kind: Callable[..., Case], judge: Callable[[list[Case]], Outcomes[Case]]
) -> Outcomes[Case]:
    """Outcomes that are stored, then those of the rest, stored as they come."""
    known: dict[Case, tuple[str, str]] = {}
    if keep is not None and keep.is_file():
        for line in keep.read_text().splitlines():
            row = json.loads(line)
            known[kind(**row["case"])] = row["outcome"], row["said"]
    yield from ((case, *known[case]) for case in wanted if case in known)
    if not (rest := [case for case in wanted if case not in known]):
        return
    for case, outcome, said in judge(rest):
        if keep is not None:
            keep.parent.mkdir(parents=True, exist_ok=True)
            with keep.open("a") as stream:
                row: dict[str, Any] = {"case": asdict(case), "outcome": outcome, "said": said}  # pyright: ignore[reportArgumentType]
                stream.write(json.dumps(row) + "\n")
        yield case, outcome, said


def tabulate(
    outcomes: Iterable[tuple[Case, str, str]], name: Callable[[Case], str], *, rows: Iterable[str],
    columns: Sequence[str], passed: Collection[str], as_json: bool,
) -> str:  # fmt: skip
    """Table of how often each row had each outcome, what failed, and a line of JSON."""
    table: dict[str, Counter[str]] = {row: Counter() for row in rows}
    began, failures = time.perf_counter(), []
    for case, outcome, said in outcomes:
        table[name(case)][outcome] += 1
        if outcome not in passed:
            failures.append(f"  {outcome}: {case}  {said}")
    total = sum(table.values(), Counter())
    lines = [f"{'':18}" + "".join(f"{column:>10}" for column in columns)]
    for row, counts in {**table, "all": total}.items():
        lines.append(f"{row:18}" + "".join(f"{counts[column] or '':>10}" for column in columns))
    minutes = round((time.perf_counter() - began) / 60, 2)
    figures = {"cases": total.total(), **{column: total[column] for column in columns}, "minutes": minutes}
    return "\n".join([*lines, *failures, *([json.dumps(figures)] if as_json else [])])
