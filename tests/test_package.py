"""Laws of the package as a whole."""

import re
import runpy
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from readme_renderer.markdown import render
from there import there

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    ("code", "unneeded"),
    [
        ("import sliplens", "torch numpy matplotlib"),
        ("from sliplens.cli import main\nmain(['--help'])", "torch"),
        ("import sliplens.cli, sliplens.report", "torch matplotlib.pyplot av rerun cv2"),
        ("import sliplens.models.predictions", "torch._dynamo torch._inductor pandas scipy.special matplotlib"),
    ],
    ids=["sliplens", "the overview of commands", "commands and pages", "networks"],
)
def test_an_import_loads_nothing_that_it_does_not_need(code: str, unneeded: str):
    script = f"{code}\nimport sys\nprint('loaded', [name for name in sys.argv[1:] if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", script, *unneeded.split()], check=True, capture_output=True, text=True)
    assert done.stdout.endswith("loaded []\n")


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
