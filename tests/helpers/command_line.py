"""The command line as tests call it."""

import pytest

from sliplens.cli import call_command, main


def run(*words: object) -> int:
    """Run a command; gives its exit code."""
    return main([str(word) for word in words])


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """Run a command that must fail with exit code 2 and one line besides notes; gives the line."""
    assert run(*words) == 2
    captured = capsys.readouterr()
    assert "Traceback" not in captured.err + captured.out
    lines = [line for line in captured.err.strip().splitlines() if not line.lstrip().startswith("note: ")]
    assert len(lines) == 1
    return lines[0]


def typed(*words: object) -> None:
    """Run a command as it is typed; errors are raised instead of printed."""
    call_command([str(word) for word in words])


def table_cells(out: str) -> list[list[str]]:
    """Rows of the tables that were printed."""
    return [[cell.strip() for cell in line.strip("│").split("│")] for line in out.splitlines() if "│" in line]
