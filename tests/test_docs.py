"""Code of the documentation runs, its commands are there, and what it names: imports, arguments, files."""

import ast
import importlib
import inspect
import os
import re
import runpy
import shlex
import shutil
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from functools import wraps
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import cyclopts
import matplotlib.pyplot as plt
import numpy as np
import pytest
from command_line import typed
from made_up import write_workspace
from own_recording import write_forces, write_frames
from simulated_data import simulate_recipe

import sliplens
from house import sentences
from sliplens.cli.app import COMMANDS, adapt
from sliplens.images import write_png
from sliplens.live import LiveReader
from sliplens.simulation import Nuisances, SimulationRecipe, plan_trials, simulate_trial
from sliplens.training.config import RECIPES

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").rglob("plot_*.py"))
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md")), *EXAMPLES]
PAGE = pytest.mark.parametrize(
    "page", [page for page in PAGES if page.name != "CHANGELOG.md"], ids=lambda page: page.stem
)


MARKDOWN = pytest.mark.parametrize(
    "page", [page for page in PAGES if page.suffix == ".md" and page.name != "CHANGELOG.md"], ids=lambda page: page.stem
)

NO_MODULES = (
    {f"sliplens.{name}" for name in ("fills", "formats", "encodings", "backbones", "executors", "controllers")}
    | {f"sliplens.{name}" for name in ("manifest", "input", "output", "recipes", "augmentations", "sources")}
    | {"sliplens.sinks"}
)
"""Groups of entry points, and keys in the metadata of an ONNX file."""
_CODE = re.compile(r"^```(\w*) ?(.*)\n((?:.*\n)*?)```", flags=re.MULTILINE)


class Block(NamedTuple):
    """Code of a page; of its fence a reader sees the language alone, and `mark` says why it is not run here."""

    language: str
    mark: str
    code: str
    line: int


def blocks_of(page: Path) -> list[Block]:
    text = page.read_text(encoding="utf-8")
    if page.suffix == ".py":
        return [Block("python", "", text, 1)]
    return [Block(fence[1], fence[2], fence[3], text.count("\n", 0, fence.start(3))) for fence in _CODE.finditer(text)]


def code_of(page: Path) -> list[ast.Module]:
    return [ast.parse(block.code) for block in blocks_of(page) if block.language == "python"]


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


def command_lines(page: Path) -> Iterator[tuple[str, list[str]]]:
    """Name and words of each command of sliplens on a page, and the mark of its block in front of them."""
    for block in blocks_of(page):
        lines = [] if block.language == "python" else block.code.replace("\\\n", "").splitlines()
        for words in (shlex.split(line, comments=True) for line in lines):
            if words[:1] == ["sliplens"] and words[1:] != ["--version"]:
                name = " ".join(words[1:3]) if " ".join(words[1:3]) in COMMANDS else words[1]
                yield name, words[1 + len(name.split()) :]


@PAGE
def test_what_a_page_trains_and_evaluates_on_has_trials_for_it(page: Path):
    commands = list(command_lines(page))
    imported = {words[words.index("-o") + 1]: words for name, words in commands if name == "import"}
    for name, words in commands:
        for data in imported.keys() & set(words):
            needed = {"train": "--validation-trials", "evaluate": "--test-trials"}.get(name)
            assert needed is None or {needed, "--splits"} & set(imported[data]), words


@MARKDOWN
def test_what_a_page_types_is_a_command_with_its_options(page: Path):
    for name, words in command_lines(page):
        app = cyclopts.App(result_action="return_value")
        app.default(adapt(COMMANDS[name])[0])
        app.parse_args(words, exit_on_error=False, print_error=False)


@pytest.fixture(scope="module")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the files that pages name: a data set, a network, a recording."""
    folder = tmp_path_factory.mktemp("workshop")
    recipe = SimulationRecipe(dry_trials=5, wet_trials=1, days=3, frames_per_trial=40)
    simulate_recipe(folder / "runs/mine/data", recipe)
    simulate_recipe(folder / "OTHER", SimulationRecipe(dry_trials=3, wet_trials=0, days=2, frames_per_trial=20, seed=9))
    write_workspace(folder / "RUNS")
    shutil.copytree(ROOT / "src/sliplens/weights/chromatouch-pair", folder / "runs/mine/train")
    links = {"runs/mine/data": ("DATA", "data"), "runs/mine/train": ("RUN", "run"), "frames": ("FRAMES",)}
    for target, names in links.items():
        for name in names:
            (folder / name).symlink_to(target)
    trial = simulate_trial(plan_trials(replace(recipe, frames_per_trial=120, release=True))[0])
    times_ms = np.round(1000 * trial.time_s).astype(int).tolist()
    for name in ("cup.mp4", "tip.mp4", "grasp.mp4", "clip.avi"):
        write_frames(folder / name, trial.frames, codec="libx264", pixels="yuv420p", stamps_ms=times_ms)
    write_forces(trial, folder / "cup.csv")
    (folder / "trials").mkdir()
    os.link(folder / "cup.mp4", folder / "trials/cup.mp4")
    for name, image in [("untouched", trial.reference), ("UNTOUCHED", trial.reference), ("frame", trial.frames[50])]:
        write_png(folder / f"{name}.png", image)
    pulls = [
        simulate_trial(plan_trials(replace(recipe, nuisances=Nuisances(shear_direction_deg=(turn, turn))))[0])
        for turn in (0.0, 90.0)
    ]
    loads = [np.outer(pull.tangential_force_n, axis) for pull, axis in zip(pulls, np.eye(3), strict=False)]
    force_n = np.concatenate(loads) + np.outer(np.concatenate([pull.normal_force_n for pull in pulls]), [0, 0, 1])
    states = np.concatenate([pull.frames for pull in pulls])[force_n[:, 2] > 0]
    known = {"force_n": force_n[force_n[:, 2] > 0], "untouched": pulls[0].reference}
    np.savez(folder / "states.npz", frames=states, **known)
    for name in ("frames", "DIFFERENCES"):
        (folder / name).mkdir()
    for number, frame in enumerate(trial.frames):
        write_png(folder / f"frames/frame-{number}.png", frame)
        difference = np.abs(frame.astype(np.int16) - trial.reference).astype(np.uint8)
        write_png(folder / f"DIFFERENCES/frame-{number}.png", difference)
    return folder


@pytest.fixture
def hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run live for half a second, and train for an epoch of two batches."""
    begin = LiveReader.__init__

    @wraps(begin)
    def begin_short(self: LiveReader, *args: Any, seconds: float | None = None, **options: Any) -> None:
        begin(self, *args, seconds=0.5, **options)

    monkeypatch.setattr(LiveReader, "__init__", begin_short)
    monkeypatch.setitem(RECIPES, "adapt", replace(RECIPES["adapt"], epochs=1, epoch_frames=64))


@pytest.fixture
def desk(workshop: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hurry: None) -> Path:
    """Copy of the workshop, as the folder to work in; no file is written in place, so that links will do."""
    monkeypatch.chdir(shutil.copytree(workshop, tmp_path / "desk", symlinks=True, copy_function=os.link))
    return Path.cwd()


@pytest.mark.parametrize(
    "page", [page for page in PAGES if page.suffix == ".md" and code_of(page)], ids=lambda page: page.stem
)
def test_the_python_of_a_page_runs_from_top_to_bottom(page: Path, desk: Path):
    """Blocks of the README are pasted one at a time."""
    names: dict[str, Any] = {}
    for block in blocks_of(page):
        if block.language == "python" and not block.mark:
            names = {} if page.name == "README.md" else names
            exec(compile("\n" * block.line + block.code, page, "exec"), names)
            assert page.name != "README.md" or len(block.code.splitlines()) <= 10


def test_few_blocks_of_python_are_not_run():
    marks = [block.mark for page in PAGES for block in blocks_of(page) if block.language == "python" and block.mark]
    assert set(marks) == {"hardware", "hours"}
    assert len(marks) <= 3


QUICK = {"check", "recover", "predict", "track", "sensor new"}


@MARKDOWN
def test_quick_commands_of_a_page_run(page: Path, desk: Path):
    """Left out: what takes a file of a slow command, and sensors whose frames have another size."""
    missing = {"gelsight-mini", "fingervision", "digit"}
    for name, words in command_lines(page):
        if name in QUICK and not missing & set(words):
            typed(*name.split(), *words)
        else:
            missing |= {out for option, out in pairwise(words) if option == "-o"}


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
