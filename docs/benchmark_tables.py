"""Draw the tables of measured figures from benchmarks/results.toml.

They stand between `<!-- figures: SCRIPT -->` and `<!-- end -->`. As an extension of Sphinx this fills them into pages
as they are read; as a script, `python docs/benchmark_tables.py`, it draws those of benchmarks/RESULTS.md anew.
"""

import re
import tomllib
from decimal import Decimal
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parents[1] / "benchmarks"
MARKED = re.compile(r"(?<=<!-- figures: )(\w+) -->\n.*?(?=<!-- end -->)", re.DOTALL)
MACHINES = {
    "quiet": "two quiet cores",
    "shared": "two cores beside other work",
    "gpu": "a GPU",
    "any": "",
}


def load_sections() -> dict[str, dict[str, Any]]:
    """Load the figures, by the name of the script that measures them."""
    sections = tomllib.loads((FOLDER / "results.toml").read_text(encoding="utf-8"), parse_float=Decimal)["section"]
    return {section["script"]: section for section in sections}


def meets(value: Decimal | int, goal: str) -> bool:
    """Whether a value reaches a goal such as "<= 8"."""
    direction, bound = goal.split()
    if direction == "=":
        return str(value).lower() == bound
    return value <= Decimal(bound) if direction == "<=" else value >= Decimal(bound)


def judge(row: dict[str, Any]) -> str:
    """Say whether a row reaches its goal, and whether all of its interval does where that counts."""
    if "goal" not in row or row["value"] == "not measured":
        return ""
    if not meets(row["value"], row["goal"]):
        return "**missed**"
    if row.get("judged") == "value":
        return "reached"
    return "reached" if all(meets(row[end], row["goal"]) for end in ("low", "high") if end in row) else "not for sure"


def _say(value: Decimal | int | str) -> str:
    if isinstance(value, Decimal):
        return f"{value:.1e}" if 0 < abs(value) < Decimal("0.001") else str(value)
    return str(value).lower() if isinstance(value, bool | str) else f"{value:,}"


def _say_goal(goal: str) -> str:
    direction, bound = goal.split()
    return {"<=": f"at most {bound}", ">=": f"at least {bound}", "=": bound}[direction]


def _circumstances(facts: dict[str, Any]) -> list[str]:
    command, machine = facts.get("command"), MACHINES.get(facts.get("machine", "any"), "")
    return [part for part in (f"`{command}`" if command else "", machine, facts.get("date", "")) if part]


def draw_table(section: dict[str, Any]) -> str:
    """Draw the figures of one script as a table in Markdown, with how they were measured below."""
    lines = ["| figure | goal | measured | remarks |", "|---|---|---|---|"]
    for row in section["rows"]:
        measured = _say(row["value"])
        if row["value"] != "not measured":
            measured += f" {row['unit']}" if "unit" in row else ""
            measured += f" ({row['low']} to {row['high']})" if "low" in row else ""
            measured += f" ({row['spread']})" if "spread" in row else ""
        own = {key: row[key] for key in ("command", "machine", "date") if key in row and row[key] != section.get(key)}
        remarks = "; ".join(part for part in (judge(row), *_circumstances(own)) if part)
        goal = _say_goal(row["goal"]) if "goal" in row else ""
        lines.append(f"| {row['figure']} | {goal} | {measured} | {remarks} |")
    return "\n".join([*lines, "", f"{'; '.join(_circumstances(section))}.", ""])


def fill_in(text: str) -> str:
    """Draw every table between its marks anew."""
    sections = load_sections()
    return MARKED.sub(lambda mark: f"{mark[1]} -->\n{draw_table(sections[mark[1]])}", text)


def setup(app: Any) -> dict[str, bool]:
    """Fill in the tables of pages as Sphinx reads them."""

    def fill(app: Any, _page: str, source: list[str]) -> None:
        if MARKED.search(source[0]):
            app.env.note_dependency(str(FOLDER / "results.toml"))
            source[0] = fill_in(source[0])

    app.connect("source-read", fill)
    return {"parallel_read_safe": True}


if __name__ == "__main__":
    page = FOLDER / "RESULTS.md"
    page.write_text(fill_in(page.read_text(encoding="utf-8")), encoding="utf-8")
