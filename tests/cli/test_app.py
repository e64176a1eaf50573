"""Commands are functions: options, defaults and help come from their signatures and docstrings."""

import inspect
import re
import shlex
from collections.abc import Callable
from importlib import import_module

import cyclopts
import pytest
from command_line import refused, run

import sliplens
from sliplens.cli.app import COMMANDS, adapt

NAMED = pytest.mark.parametrize("name", COMMANDS)


def function_of(name: str) -> Callable[..., object]:
    module, _, function = COMMANDS[name].function.partition(":")
    return getattr(import_module(module), function)


@NAMED
def test_parameters_are_options_with_the_same_defaults(name: str):
    call, options = adapt(COMMANDS[name])
    parameters = inspect.signature(function_of(name)).parameters
    for option, parameter in inspect.signature(call).parameters.items():
        assert option in options
        if option in parameters and parameter.default not in ((), None):
            assert parameter.default in (parameters[option].default, (parameters[option].default,))
    assert (call.__doc__ or "").endswith(COMMANDS[name].example)


def test_every_command_has_a_call_and_every_call_a_command():
    calls = {COMMANDS[name].function.rpartition(":")[2] for name in COMMANDS}
    public = {name for name in sliplens.__all__ if inspect.isfunction(getattr(sliplens, name))}
    assert calls <= public
    # `load*`, `wrap` and `plot` give a value to go on with; corrections are drafted by `label --draft`
    assert public - calls == {"load", "load_dataset", "wrap", "plot", "draft_corrections"}


@NAMED
def test_help_fits_the_terminal(name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COLUMNS", "70")
    assert run(*name.split(), "--help") == 0
    text = capsys.readouterr().out
    # a user of the command line has no names of the code
    assert not re.search(r"None\]|[Rr]ow of|`([a-z]\w+\.)?[A-Z]{2,}(_[A-Z]+)*`", text.replace("SLIPLENS_REFERENCE", ""))
    assert " ".join(COMMANDS[name].example.split()) in " ".join(text.split())


@NAMED
def test_examples_can_be_typed(name: str):
    program, *words = shlex.split(COMMANDS[name].example)
    assert (program, words[: len(name.split())]) == ("sliplens", name.split())
    app = cyclopts.App(result_action="return_value")
    app.default(adapt(COMMANDS[name])[0])
    _, bound, _ = app.parse_args(words[len(name.split()) :], exit_on_error=False, print_error=False)
    assert len(bound.arguments) >= 0


def test_the_overview_has_a_line_for_each_command(capsys: pytest.CaptureFixture[str]):
    assert run("--help") == 0
    text = capsys.readouterr().out
    assert all(f"\n{name} " in text for name in COMMANDS)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("prdict cup.mp4", "did you mean predict?"),
        ("predict chromatouch-pair . --frction 0.7", "Did you mean --friction?"),
        ("label . -o b --reference-fram 3", "--reference-frame"),
        ("predict chromatouch-pair . c", "'c'"),
        ("predict . --batch-size many", "--batch-size"),
        ("sensor", "did you mean sensor new?"),
    ],
)
def test_a_typing_error_is_one_line_with_its_cure(words: str, message: str, capsys: pytest.CaptureFixture[str]):
    line = refused(capsys, *words.split())
    assert message in line
    assert "--help` lists" in line
