"""The figures of benchmarks/results.toml are whole, and the tables drawn from them are theirs."""

import re
import runpy
from decimal import Decimal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
NO_FIGURES = {"contact_events"}
"""What the scripts share; they measure nothing."""


TABLES = SimpleNamespace(**runpy.run_path(str(ROOT / "docs" / "benchmark_tables.py")))
SECTIONS: dict[str, dict[str, Any]] = TABLES.load_sections()


def test_every_script_has_its_figures():
    scripts = {path.stem for path in (ROOT / "benchmarks").glob("*.py")} - NO_FIGURES
    assert set(SECTIONS) == scripts


@pytest.mark.parametrize("script", SECTIONS)
def test_rows_are_whole(script: str):
    section = SECTIONS[script]
    for row in section["rows"]:
        check_row(section, row)


def check_row(section: dict[str, Any], row: dict[str, Any]) -> None:
    facts = section | row
    assert set(facts) <= {"script", "title", "rows", "command", "date", "machine"} | {
        "figure", "value", "unit", "low", "high", "spread", "goal", "judged"
    }  # fmt: skip
    assert section["script"] in facts["command"] or facts["command"].startswith("make ")
    assert facts["machine"] in TABLES.MACHINES
    if row["value"] == "not measured":
        assert not {"low", "high", "spread"} & set(row)
    else:
        assert isinstance(row["value"], int | Decimal)
        assert re.fullmatch(r"20\d\d-\d\d(-\d\d)?", facts["date"])
        assert facts["machine"] != "gpu"
        assert row.get("low", row["value"]) <= row["value"] <= row.get("high", row["value"])
    assert row.get("judged", "value") == "value"
    if "goal" in row:
        direction, bound = row["goal"].split()
        assert direction in {"<=", ">=", "="}
        assert bound in {"true", "false"} if direction == "=" else float(bound) >= 0


def test_the_page_of_results_has_the_tables_of_the_file():
    page = (ROOT / "benchmarks" / "RESULTS.md").read_text(encoding="utf-8")
    assert re.findall(r"<!-- figures: (\w+) -->", page) == list(SECTIONS)
    assert re.findall(r"^## (.*)$", page, re.MULTILINE) == [section["title"] for section in SECTIONS.values()]
    assert page == TABLES.fill_in(page), "run python docs/benchmark_tables.py"


def test_the_site_shows_every_table():
    page = (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"<!-- figures: (\w+) -->", page)) == sorted(SECTIONS)


@pytest.mark.parametrize(
    ("row", "verdict"),
    [
        ({"value": 8, "goal": "<= 8"}, "reached"),
        ({"value": Decimal("8.1"), "goal": "<= 8"}, "**missed**"),
        ({"value": Decimal("0.9"), "goal": ">= 0.9", "low": Decimal("0.9"), "high": Decimal("1.2")}, "reached"),
        ({"value": Decimal("0.9"), "goal": ">= 0.9", "low": Decimal("0.8"), "high": Decimal("1.2")}, "not for sure"),
        ({"value": Decimal("0.3"), "goal": "<= 0.33", "low": Decimal("0.2"), "high": Decimal("0.4")}, "not for sure"),
        ({"value": True, "goal": "= true"}, "reached"),
        ({"value": False, "goal": "= true"}, "**missed**"),
        ({"value": "not measured", "goal": "<= 8"}, ""),
        ({"value": 3}, ""),
    ],
)
def test_a_goal_is_judged_in_its_direction(row: dict[str, Any], verdict: str):
    assert TABLES.judge(row) == verdict


def test_machines_are_told_where_they_differ():
    section = {
        "command": "python x.py",
        "machine": "quiet",
        "date": "2026-11",
        "rows": [
            {"figure": "`a`", "value": 1200, "unit": "ms", "goal": "<= 1000"},
            {"figure": "`b`", "value": "not measured", "machine": "gpu"},
        ],
    }
    lines = TABLES.draw_table(section).splitlines()
    assert lines[2] == "| `a` | at most 1000 | 1,200 ms | **missed** |"
    assert lines[3] == "| `b` |  | not measured | a GPU |"
    assert lines[5] == "`python x.py`; two quiet cores; 2026-11."
