"""Laws of the package as a whole."""

import re
import runpy
import subprocess
import sys
import tomllib
from pathlib import Path

from readme_renderer.markdown import render
from there import there

ROOT = Path(__file__).parents[1]


def run_python(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout


def test_importing_sliplens_imports_neither_torch_nor_numpy():
    loaded = run_python(
        "import sys, sliplens; print([m for m in ('torch', 'numpy', 'matplotlib') if m in sys.modules])"
    )
    assert loaded.strip() == "[]"


def test_the_overview_of_the_commands_does_not_import_torch():
    code = (
        "import sys\nfrom sliplens.cli import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "print('torch' in sys.modules)"
    )
    assert run_python(code).strip().endswith("False")


def test_importing_commands_and_pages_imports_nothing_that_only_some_need():
    code = (
        "import sys, sliplens.cli, sliplens.report\n"
        "print({'torch', 'matplotlib.pyplot', 'av', 'rerun', 'cv2'} & set(sys.modules))"
    )
    assert run_python(code).strip() == "set()"


def test_the_floors_are_told_as_they_are_held():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    layers = settings["tool"]["importlinter"]["contracts"][0]["layers"]
    held = [
        name for layer in layers for name in re.findall(r"\w+", layer) if (ROOT / "src" / "sliplens" / name).is_dir()
    ]
    _, _, section = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").partition("imports only from lower layers")
    lines = re.findall(r"^(\w+)", section.split("```")[1], flags=re.MULTILINE)
    told = [name for name in lines if (ROOT / "src" / "sliplens" / name).is_dir()]
    assert told == held


def test_contributing_names_files_that_there_are():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    named = re.findall(r"`((?:\w+/)+(?:\w+\.py)?|\w+\.py)`", text)
    folders = [ROOT, ROOT / "src" / "sliplens", ROOT / "src" / "sliplens" / "faithfulness"]
    assert len(named) > 10
    assert not [name for name in named if not any((folder / name).exists() for folder in folders)]


def test_a_package_index_shows_the_readme_whole():
    build = runpy.run_path(str(ROOT / "hatch_build.py"))
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    page = there(render(build["describe"](readme)))
    # nothing there is relative to the repository
    assert "<img" not in page
    assert not re.findall(r'href="(?!https?:|#)', page)
    for heading in re.findall(r"^## (.*)", readme, flags=re.MULTILINE):
        assert f">{heading}<" in page
    assert "*" not in re.sub(r"<pre.*?</pre>", "", page, flags=re.DOTALL)
