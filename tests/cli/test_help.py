"""What the command line tells of itself."""

import shlex
from typing import get_args

import pytest
import tyro
from command_line import refused, run

from sliplens.cli import Command
from sliplens.cli.help import EXAMPLES, OPTIONAL, TASKS

COMMANDS = [kind.__name__.lower() for kind in get_args(Command)]


def told(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    with pytest.raises(SystemExit) as ended:
        run(*words, "--help")
    assert ended.value.code == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("command", COMMANDS)
def test_help_is_for_people(command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COLUMNS", "70")
    text = told(capsys, command)
    assert "None" not in text
    assert "(default: )" not in text
    assert max(map(len, text.splitlines()[:-1])) <= 70  # but for the example, which is to be copied
    assert text.splitlines()[-1] == f"  {EXAMPLES[command]}"


def test_the_overview_has_a_line_a_command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COLUMNS", "70")
    with pytest.raises(SystemExit):
        run("--help")
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 70
    assert [line.split()[0] for line in lines if line[:2] == "  " and line[2:3].strip()] == list(EXAMPLES)


def test_paragraphs_of_options_have_no_ragged_lines(capsys: pytest.CaptureFixture[str]):
    words = " ".join(told(capsys, "study").replace("\u2502", " ").split())
    assert "which takes" not in words
    assert "If not given, chromatouch-pair, or with --preset thesis-difference and thesis-raw." in words


@pytest.mark.parametrize("command", COMMANDS)
def test_examples_can_be_typed(command: str):
    program, *words = shlex.split(EXAMPLES[command])
    assert (program, words[0]) == ("sliplens", command)
    made = tyro.cli(Command, args=words, registry=OPTIONAL)  # pyright: ignore[reportArgumentType]
    assert type(made).__name__.lower() == command


def test_six_tasks(capsys: pytest.CaptureFixture[str]):
    assert len(TASKS) == 6
    assert run("help") == 0
    everything = capsys.readouterr().out
    for name, (title, commands) in TASKS.items():
        assert f"{title} ({name})" in everything
        assert run("help", name) == 0
        shown = [line.strip() for line in capsys.readouterr().out.splitlines() if line.startswith("  ")]
        assert shown == [EXAMPLES[command] for command in commands]
    assert "choose one of look, read" in refused(capsys, "help", "fly")
