"""What the documentation and its gallery name is there: imports, calls and their arguments, files."""

import ast
import functools
import importlib
import inspect
import re
import runpy
import tomllib
from collections.abc import Iterator
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

import sliplens
from house import sentences
from sliplens.cli.app import adapt
from sliplens.cli.commands import COMMANDS

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").rglob("plot_*.py"))
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md")), *EXAMPLES]
PAGE = pytest.mark.parametrize(
    "page", [page for page in PAGES if page.name != "CHANGELOG.md"], ids=lambda page: page.stem
)


NO_MODULES = (
    {f"sliplens.{name}" for name in ("fills", "formats", "encodings", "backbones", "executors", "controllers")}
    | {f"sliplens.{name}" for name in ("manifest", "input", "output", "recipes", "augmentations", "sources")}
    | {"sliplens.sinks"}
)
"""Groups of entry points, and keys in the metadata of an ONNX file."""
_CODE = re.compile(r"^```(\w*)\n(.*?)^```", flags=re.MULTILINE | re.DOTALL)


def code_of(page: Path) -> list[ast.Module]:
    text = page.read_text(encoding="utf-8")
    return (
        [ast.parse(code) for kind, code in _CODE.findall(text) if kind == "python"]
        if page.suffix == ".md"
        else [ast.parse(text)]
    )


def text_of(page: Path) -> str:
    return _CODE.sub("", page.read_text(encoding="utf-8"))


def find(name: str) -> object:
    """Module of a dotted name, or the attribute of one."""
    try:
        return importlib.import_module(name)
    except ImportError:
        owner, _, last = name.rpartition(".")
        return getattr(find(owner), last)


def exists(name: str) -> bool:
    """Whether a dotted name is a module, or an attribute of one."""
    try:
        find(name)
    except (ImportError, AttributeError):
        return False
    return True


def calls_of(code: ast.Module) -> Iterator[tuple[ast.Call, object]]:
    """Calls of names of `sliplens`, and what each name stands for; an import that is not there fails."""
    imported = {
        alias.asname or alias.name: find(f"{node.module}.{alias.name}")
        for node in ast.walk(code)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("sliplens")
        for alias in node.names
    }
    for node in ast.walk(code):
        if isinstance(node, ast.Call):
            match node.func:
                case ast.Attribute(value=ast.Name(id="sl" | "sliplens"), attr=name):
                    yield node, getattr(sliplens, name)
                case ast.Name(id=name) if name in imported:
                    yield node, imported[name]


@PAGE
def test_what_a_page_imports_and_calls_is_there_and_takes_its_arguments(page: Path):
    """Examples are not run here; `make docs` runs them all."""
    for code in code_of(page):
        names = (node for node in ast.walk(code) if isinstance(node, ast.Attribute))
        used = {each.attr for each in names if isinstance(each.value, ast.Name) and each.value.id in {"sl", "sliplens"}}
        assert used <= set(sliplens.__all__)
        for call, thing in calls_of(code):
            assert callable(thing)
            given = [argument for argument in call.args if not isinstance(argument, ast.Starred)]
            named = {keyword.arg: keyword.value for keyword in call.keywords if keyword.arg}
            spread = len(given) < len(call.args) or len(named) < len(call.keywords)
            signature = inspect.signature(thing)
            (signature.bind_partial if spread else signature.bind)(*given, **named)


@PAGE
def test_what_a_page_names_in_its_text_is_there(page: Path):
    named = set(re.findall(r"`(sliplens(?:\.\w+)+)(?:\(.*?\))?`", text_of(page))) - NO_MODULES
    assert not [name for name in named if not exists(name)]


def anchors_of(page: Path) -> set[str]:
    """Anchors of a page: its headings as GitHub and MyST name them, and its own labels."""
    text = text_of(page)
    headings = (
        re.sub(r"[^\w\s-]", "", heading).strip().lower() for heading in re.findall(r"^#+ (.*)", text, re.MULTILINE)
    )
    return {re.sub(r"\s", "-", heading) for heading in headings} | set(
        re.findall(r"^\(([\w-]+)\)=", text, re.MULTILINE)
    )


@PAGE
def test_where_a_page_links_to_there_is_a_file_with_its_heading(page: Path):
    for path, anchor in re.findall(r"\]\((?!https?:)([^)#\s]*)(?:#([^)\s]+))?\)", text_of(page)):
        target = page.parent / path if path else page
        assert target.exists()
        assert not anchor or anchor in anchors_of(target), f"{path}#{anchor}"


def command_lines(code: str) -> list[list[str]]:
    """Words of each command of sliplens in a block, without what is said of it."""
    lines = (line.partition("#")[0].split() for line in code.splitlines())
    return [words[1:] for words in lines if words[:1] == ["sliplens"] and words[1:] != ["--version"]]


@PAGE
def test_what_a_page_trains_and_evaluates_on_has_trials_for_it(page: Path):
    for _, code in _CODE.findall(page.read_text(encoding="utf-8")):
        commands = command_lines(code)
        imported = {words[words.index("-o") + 1]: words for words in commands if words[0] == "import"}
        for words in commands:
            for data in imported.keys() & set(words[1:]):
                needed = {"train": "--validation-trials", "evaluate": "--test-trials"}.get(words[0])
                assert needed is None or {needed, "--splits"} & set(imported[data]), words


@functools.cache
def options_of(name: str) -> set[str]:
    """Options of a command of sliplens."""
    _, names = adapt(COMMANDS[name])
    options = {f"--{prefix}{name.replace('_', '-')}" for name in names for prefix in ("", "no-")}
    return options | {alias for _, alias in COMMANDS[name].aliases} | {"-o", "--output", "--help"}


@pytest.mark.parametrize("page", [page for page in PAGES if page.suffix == ".md"], ids=lambda page: page.stem)
def test_what_a_page_types_is_a_command_with_its_options(page: Path):
    for _, code in _CODE.findall(page.read_text(encoding="utf-8")):
        for words in command_lines(code):
            name = " ".join(words[:2]) if " ".join(words[:2]) in COMMANDS else words[0]
            assert {word.partition("=")[0] for word in words if re.match(r"--?[a-z]", word)} <= options_of(name)


def rows_of(page: str) -> list[list[str]]:
    """Cells of every row of a page's tables, heads and rules left out."""
    lines = (ROOT / "docs" / page).read_text(encoding="utf-8").splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines if line.startswith("| ")]
    return [row for number, row in enumerate(rows) if number]


def test_the_table_of_extras_is_that_of_the_package():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    needed = {
        name: ", ".join(re.findall(r"^[\w-]+", "\n".join(packages), flags=re.MULTILINE))
        for name, packages in project["optional-dependencies"].items()
        if name not in {"dev", "docs"}
    }
    assert {row[0].strip("`"): row[2] for row in rows_of("install.md")} == needed


def test_sentences_that_the_troubleshooting_quotes_are_said_somewhere():
    source = "".join(path.read_text(encoding="utf-8") for path in sorted((ROOT / "src").rglob("*.py")))
    # sentences are broken over lines, and what stands in braces is told at run time
    said = re.sub(r"\{[^{}\"\n]*\}", "…", re.sub(r'"\s*f?"', "", source))
    quoted = [text for row in rows_of("troubleshooting.md") for text in re.findall(r"^`([^`]*)`", row[0])]
    assert quoted
    parts = {part.strip() for text in quoted for part in text.split("…") if len(part.strip()) > 3}
    assert not sorted(part for part in parts - {".NAME.partial"} if part not in said)


@pytest.mark.parametrize(
    "name", ["tutorials/plot_4_live_and_grip", "tutorials/plot_5_thesis", "gallery/plot_4_markers"]
)
def test_the_quickest_pages_of_the_gallery_run(name: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(plt, "show", lambda: None)
    plt.switch_backend("agg")
    try:
        runpy.run_path(str(ROOT / "examples" / f"{name}.py"))
        figures = list(map(plt.figure, plt.get_fignums()))
        assert figures
        assert all(ax.has_data() for figure in figures for ax in figure.axes)
    finally:
        plt.close("all")


def test_every_page_of_the_gallery_shows_a_picture_and_says_what_it_is_about():
    assert len([page for page in EXAMPLES if page.parent.name == "tutorials"]) == 5
    for page in EXAMPLES:
        title, line, blank, *_ = (ast.get_docstring(ast.parse(page.read_text(encoding="utf-8"))) or "").splitlines()
        assert set(line) == {"="}
        assert len(line) == len(title)
        assert not blank
        assert "plt.show()" in page.read_text(encoding="utf-8")


def test_sentences_are_short_and_without_riddle_words():
    for page in PAGES:
        if page.suffix != ".md" or page.name in {"CHANGELOG.md", "CODE_OF_CONDUCT.md"}:
            continue
        prose = sentences(text := page.read_text(encoding="utf-8"))
        assert np.mean([len(sentence.split()) for sentence in prose] or [0]) <= 22, page.name
        assert not re.findall(r"\b(?:tells|told|mends?|mended|at hand|nobody|untouched test)\b", text), page.name
