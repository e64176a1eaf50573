"""What the documentation names is there: imports, calls, files."""

import ast
import importlib
import re
from pathlib import Path

import pytest

import sliplens

ROOT = Path(__file__).parents[1]
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("*.md"))]
PAGE = pytest.mark.parametrize(
    "page", [page for page in PAGES if page.name != "CHANGELOG.md"], ids=lambda page: page.stem
)


NO_MODULES = (
    {
        f"sliplens.{name}"
        for name in ("fills", "formats", "encodings", "backbones", "engines", "executors", "controllers", "conditions")
    }
    | {
        f"sliplens.{name}"
        for name in ("manifest", "input", "output", "recipes", "augmentations", "sources", "estimators")
    }
    | {"sliplens.sensors", "sliplens.presets", "sliplens.pulls", "sliplens.sinks", "sliplens.gripper_messages"}
)
"""Groups of entry points, and keys in the metadata of an ONNX file."""
_CODE = re.compile(r"^```(\w*)\n(.*?)^```", flags=re.MULTILINE | re.DOTALL)


def code_of(page: Path) -> list[ast.Module]:
    return [ast.parse(code) for kind, code in _CODE.findall(page.read_text(encoding="utf-8")) if kind == "python"]


def text_of(page: Path) -> str:
    return _CODE.sub("", page.read_text(encoding="utf-8"))


def exists(name: str) -> bool:
    """Whether a dotted name is a module, or an attribute of one."""
    owner, _, last = name.rpartition(".")
    try:
        importlib.import_module(name)
    except ImportError:
        return bool(owner) and exists(owner) and hasattr(find(owner), last)
    return True


def find(name: str) -> object:
    try:
        return importlib.import_module(name)
    except ImportError:
        owner, _, last = name.rpartition(".")
        return getattr(find(owner), last)


@PAGE
def test_what_a_page_imports_is_there(page: Path):
    names = [
        f"{node.module}.{alias.name}"
        for code in code_of(page)
        for node in ast.walk(code)
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("sliplens")
        for alias in node.names
    ]
    assert not [name for name in names if not exists(name)]


@PAGE
def test_what_a_page_calls_is_public(page: Path):
    calls = {
        node.attr
        for code in code_of(page)
        for node in ast.walk(code)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in {"sl", "sliplens"}
    }
    assert calls <= set(sliplens.__all__)


@PAGE
def test_what_a_page_names_in_its_text_is_there(page: Path):
    named = set(re.findall(r"`(sliplens(?:\.\w+)+)(?:\(.*?\))?`", text_of(page))) - NO_MODULES
    assert not [name for name in named if not exists(name)]


@PAGE
def test_where_a_page_links_to_there_is_a_file(page: Path):
    links = re.findall(r"\]\((?!https?:)([^)#\s]+)", text_of(page))
    assert not [link for link in links if not (page.parent / link).exists()]
