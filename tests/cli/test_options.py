"""Options that a command offers are options that it heeds."""

import ast
import inspect
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Unpack, get_args, get_origin, get_type_hints

import pytest
from command_line import refused

from sliplens.cli import Command, command
from sliplens.recordings import Dataset

BASE = Path(command.__file__).read_text()


def heeded(text: str) -> set[str]:
    """What is read of `self`, and the parameters of what the command hands all its options to (`Command.call`)."""
    nodes = list(ast.walk(ast.parse(text)))
    imported = [node for node in nodes if isinstance(node, ast.ImportFrom) and node.module]
    origin = {name.name: node.module for node in imported for name in node.names}
    attributes = [node for node in nodes if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)]
    read = {node.attr for node in attributes if isinstance(node.value, ast.Name) and node.value.id == "self"}
    calls = [node for node in nodes if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)]
    handed = [node.args[0] for node in calls if isinstance(node.func, ast.Attribute) and node.func.attr == "call"]
    names = {name.id for one in handed for name in ast.walk(one) if isinstance(name, ast.Name)}
    functions = [getattr(import_module(str(origin[name])), name) for name in names & origin.keys()]
    if "getattr(self" in text:
        read |= {node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    hints = [hint for function in functions for hint in get_type_hints(function).values()]
    grouped = [get_args(hint)[0].__annotations__ for hint in hints if get_origin(hint) is Unpack]
    return read.union(*(inspect.signature(function).parameters for function in functions), *grouped)


@pytest.mark.parametrize("offers", get_args(Command), ids=lambda offers: offers.__name__)
def test_every_option_is_heeded(offers: type) -> None:
    module = inspect.getmodule(offers)
    assert isinstance(module, ModuleType)
    if "vars(self)" in inspect.getsource(module):
        return  # handed on whole: the function refuses what it does not take
    names = {field.name for field in fields(offers)}  # pyright: ignore[reportArgumentType]
    assert names <= heeded(inspect.getsource(module)) | heeded(BASE)


def test_an_option_that_nobody_reads_is_noticed() -> None:
    found = heeded("from sliplens import predict\nself.call(predict, out=self.output)")
    assert {"output", "batch_size", "run"} <= found
    assert "forgotten" not in found


@pytest.mark.parametrize(
    ("option", "noun"),
    [("--recipe", "recipe"), ("--input", "input"), ("--augmentation", "augmentation")],
)
def test_the_library_says_which_rows_there_are_to_train_with(
    option: str, noun: str, small_dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = refused(capsys, "train", small_dataset.folder, "-o", tmp_path / "run", option, "other")
    assert f"there is no {noun} named 'other'; choose one of " in line


@pytest.mark.parametrize(("option", "noun"), [("--preset", "preset"), ("--sensor", "sensor")])
def test_the_library_says_which_rows_there_are_to_simulate(
    option: str, noun: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = refused(capsys, "simulate", tmp_path / "data", option, "other")
    assert f"there is no {noun} named 'other'; choose one of " in line
