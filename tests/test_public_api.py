"""What is exported is documented: in words, with units and shapes, and on the page of the Python interface."""

import ast
import doctest
import importlib.util
import inspect
import re
import types
import typing
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

import sliplens
from sliplens.explainers.contract import Explainer

ROOT = Path(__file__).parents[1]
API_PAGE = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
API_PAGES = "".join(page.read_text(encoding="utf-8") for page in sorted((ROOT / "docs" / "api").glob("*.md")))

UNIT_IN_NAME = re.compile(r"_(n|m|pa|px|s|ms|hz|deg|rad)$|(seconds|minutes|percent)$|_per_")
"""House style: a number of a physical quantity has its unit in its name."""
NONE_IN_NAME = re.compile(
    r"coefficient|ratio|share|margin|exponent|quantile|level|strain|temperature|factor|learning_rate|fraction|score|auroc|^mu$"
)
"""Names of what has no unit: ratios of two things alike, and margins, which are one."""
UNIT_IN_WORDS = re.compile(
    r"\b(newtons?|metres?|pascals?|pixels?|seconds?|minutes?|hertz|degrees?|radians?|grey levels?|margin units|percent"
    r"|points of margin|shares?|ratio|part|coefficient|correlation|standard deviations?|0 to 1|unit of)\b",
    re.IGNORECASE,
)
"""Or the sentence that describes it says the unit, or what it is a share of."""


def exports(module: types.ModuleType) -> list[str]:
    """Names that a package lists, or public functions and classes that a module defines."""
    return getattr(module, "__all__", None) or [
        name
        for name, thing in vars(module).items()
        if (inspect.isclass(thing) or inspect.isfunction(thing))
        and thing.__module__ == module.__name__
        and name[0] != "_"
    ]


DESCRIBED = re.findall(r"^\.\. automodule:: (\S+)$", API_PAGES, flags=re.MULTILINE)
MODULES = [importlib.import_module(name) for name in ("sliplens", *DESCRIBED)]
"""The package, and what the pages of the interface describe; a command has its --help."""
EXPORTED = [
    pytest.param(module, name, getattr(module, name), id=f"{module.__name__}.{name}")
    for module in MODULES
    for name in exports(module)
    if name != "__version__"
]
CALLABLE = [row for row in EXPORTED if inspect.isclass(row.values[2]) or inspect.isfunction(row.values[2])]


def own_docstring(thing: object) -> str:
    """Words of a function or class: not those of a base, nor the signature that `dataclass` puts in their place."""
    text = (vars(thing).get("__doc__") if inspect.isclass(thing) else thing.__doc__) or ""
    return "" if inspect.isclass(thing) and text.startswith(f"{thing.__name__}(") else text


def strings_below(body: list[ast.stmt]) -> dict[str, str]:
    """Names that are assigned, and the string below each, or below the run of names that it stands in."""
    found, run = {}, []
    for statement, after in pairwise([*body, ast.Pass()]):
        if isinstance(statement, ast.Assign | ast.AnnAssign):
            targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
            run += [name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)]
            if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                found |= dict.fromkeys(run, str(after.value.value))
                run = []
        else:
            run = []
    return found


def string_below(module: types.ModuleType, name: str) -> str:
    """What describes a value, where it is assigned."""
    body = ast.parse(inspect.getsource(module)).body
    for statement in body:
        if isinstance(statement, ast.ImportFrom) and name in [alias.asname or alias.name for alias in statement.names]:
            return string_below(importlib.import_module(str(statement.module)), name)
    return strings_below(body).get(name, "")


def parameters(thing: object) -> Iterator[tuple[str, object]]:
    """Names and types of what a function takes and gives, or of what a record holds."""
    hints = typing.get_type_hints(thing, localns={"Explainer": Explainer})  # its table is read without torch
    if inspect.isclass(thing):
        hints = {field.name: hints[field.name] for field in fields(thing)} if is_dataclass(thing) else {}
    for name, hint in hints.items():
        union = isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union
        for part in typing.get_args(hint) if union else (hint,):
            yield name, part


def description(thing: object, name: str) -> str:
    """What is said of a parameter or a field: its own paragraph, or the first one of all."""
    doc = inspect.getdoc(thing) or ""
    paragraphs = re.findall(rf"^(?:[\w, ]+, )?{name}(?:, [\w, ]+)?\n((?:    .*\n?|\n)+)", doc, flags=re.MULTILINE)
    summary = re.split(r"\n[A-Z][a-z]+\n-+\n", doc)[0]
    if inspect.isclass(thing):
        for base in (thing, *(base for base in thing.__mro__[1:] if is_dataclass(base))):
            [definition] = ast.parse(inspect.cleandoc(inspect.getsource(base))).body
            assert isinstance(definition, ast.ClassDef)
            paragraphs.append(strings_below(definition.body).get(name, ""))
    return " ".join([*paragraphs, summary])


@pytest.mark.parametrize(("module", "name", "thing"), EXPORTED)
def test_what_is_exported_is_described(module, name, thing):
    if inspect.isclass(thing) or inspect.isfunction(thing):
        assert own_docstring(thing)
    else:
        assert string_below(module, name), f"put a string below {name} that says what it is"


@pytest.mark.parametrize(("module", "name", "thing"), CALLABLE)
def test_a_number_has_a_unit_and_an_array_a_shape(module, name, thing):
    lacking = []
    for parameter, hint in parameters(thing):
        if hint in (np.ndarray, torch.Tensor):
            lacking.append(f'the array {parameter} has no shape, such as Float[np.ndarray, "frames markers"]')
        named = UNIT_IN_NAME.search(parameter) or NONE_IN_NAME.search(name if parameter == "return" else parameter)
        if hint is float and not named and not UNIT_IN_WORDS.search(description(thing, parameter)):
            lacking.append(f"the number {parameter} has no unit, neither in its name nor where it is described")
    assert not lacking


CALLS = [name for name in sliplens.__all__ if inspect.isfunction(getattr(sliplens, name))]


@pytest.mark.parametrize("name", [*CALLS, "Friction", "LiveReader", "StudyConfig"])
def test_a_call_has_an_example_with_its_output_and_names_its_neighbours(name):
    doc = inspect.getdoc(getattr(sliplens, name)) or ""
    neighbours = re.findall(r"^(\w+) : ", doc.partition("See Also\n--------\n")[2].partition("\n\n")[0], re.MULTILINE)
    assert neighbours
    assert set(neighbours) <= set(sliplens.__all__) - {name}
    assert any(example.want for example in doctest.DocTestParser().get_examples(doc))


def test_the_rule_of_units_and_shapes_can_fail():
    def press(force: float, frames: np.ndarray, depth_m: float) -> None:
        """Press."""

    with pytest.raises(AssertionError, match=r"frames has no shape.*|force has no unit"):
        test_a_number_has_a_unit_and_an_array_a_shape(None, "press", press)
    assert not UNIT_IN_WORDS.search(description(press, "force"))


def test_the_pages_of_the_interface_describe_every_public_module():
    described = re.findall(r"^\.\. automodule:: (\S+)$", API_PAGES, flags=re.MULTILINE)
    assert len(described) == len(set(described))
    assert {module.__name__ for module in MODULES} - {"sliplens"} <= set(described)
    assert all(importlib.util.find_spec(name) for name in described)


def test_the_pages_of_the_interface_describe_every_name_of_the_package():
    described = re.findall(r"^\.\. auto\w+:: sliplens\.(\w+)$", API_PAGES, flags=re.MULTILINE)
    listed = re.findall(r"^\| \{py:\w+\}`~sliplens\.(\w+)`", API_PAGE, flags=re.MULTILINE)
    modules = {module.__name__.removeprefix("sliplens.") for module in MODULES}
    assert sorted(set(described) - modules) == sorted(listed) == sorted(set(sliplens.__all__) - {"__version__"})
    linked = re.findall(r"^\| \{py:\w+\}`~sliplens\.(\w+)`.*: .*\]\(.* \|$", API_PAGE, flags=re.MULTILINE)
    plain = {"draft_corrections", "label_dataset", "load", "plot", "recover_dataset", "run_demo", "view"}
    assert set(listed) - set(linked) == plain | {"LiveReader", "SliplensError", "StudyConfig"}  # without one


@pytest.mark.parametrize("name", [*CALLS, "LiveReader", "StudyConfig"])
def test_a_misspelt_keyword_is_refused_before_anything_else(name):
    call = getattr(sliplens, name)
    parameters = inspect.signature(call).parameters.values()
    required = [each.name for each in parameters if each.default is each.empty and each.kind is not each.VAR_KEYWORD]
    options = [each.annotation for each in parameters if each.kind is each.VAR_KEYWORD]
    # of `**options: Unpack[TypedDict]` Python itself accepts any keyword
    known = [next(iter(typing.get_args(annotation)[0].__annotations__)) for annotation in options]
    for wrong, words in [("nosuch", "nosuch"), *((f"{option}s", f"did you mean '{option}'") for option in known)]:
        with pytest.raises(TypeError, match=words):
            next(iter(call(**dict.fromkeys(required, Path("nothing")), **{wrong: 1})))
