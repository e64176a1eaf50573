"""Build wheel and source archive into dist/, and try the wheel as a stranger would, in clean environments.

`python .ci/dist.py` takes every supported Python that uv or pyenv knows on this machine; packages come from pip's usual
places. Nothing of the repository is importable while the wheel is tried.
"""

import os
import re
import subprocess
import sys
import tarfile
import tempfile
import time
import zipfile
from email import message_from_bytes
from email.message import Message
from pathlib import Path

from packaging.specifiers import SpecifierSet
from packaging.version import Version
from readme_renderer.markdown import render

ROOT = Path(__file__).parents[1]
DIST = ROOT / "dist"
LARGEST = 15_000_000
"""Bytes of either archive."""
LIBRARIES = Path(sys.executable).parent
NOT_SHIPPED = re.compile(
    r"(^|/)(tests?|benchmarks|docs|runs|examples|reference|conftest\.py)(/|$)|\.(png|jpe?g|mp4|parquet)$"
)
"""Tests, recordings, and what only the documentation needs."""

SMOKE = """
import re, sys, tempfile, time
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import sliplens as sl

assert not {"torch", "numpy"} & set(sys.modules), "importing sliplens imports more than sliplens"
assert sl.__version__ == version("sliplens")
package = Path(sl.__file__).parent
assert (package / "py.typed").is_file() and "site-packages" in package.parts, package
from sliplens.simulation import PRESETS, plan_trials, simulate_trial

trial = simulate_trial(replace(plan_trials(PRESETS["small"])[0], frames=20))
frames, untouched = trial.frames[-5:-4], trial.reference
given = {"frames": frames, "untouched": untouched}
blocks = re.findall(r"^```python\\n(.*?)^```", Path(sys.argv[1]).read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
[block] = (block for block in blocks if "sl.score(" in block)
# by the quickest method: what is tried is the package
exec(compile(block.replace("poly-cam", "grad-cam"), "README.md", "exec"), given)
assert given["readings"].frame().num_rows == 1
for name in ("chromatouch-pair", "thesis-difference", "thesis-raw"):
    assert sl.predict(name, trial.frames, reference=untouched).frame().num_rows == 20
sl.plot(given["readings"]).savefig("readings.png")
"""


def build() -> tuple[Path, Path]:
    """Wheel and source archive, made anew."""
    for old in DIST.glob("sliplens-*"):
        old.unlink()
    subprocess.run([LIBRARIES / "hatchling", "build", "-d", DIST], cwd=ROOT, check=True, capture_output=True)
    [wheel], [archive] = DIST.glob("*.whl"), DIST.glob("*.tar.gz")
    return wheel, archive


def contents(wheel: Path, archive: Path) -> tuple[set[str], set[str], Message]:
    """Names in both, and the metadata of the wheel."""
    with zipfile.ZipFile(wheel) as packed:
        names = set(packed.namelist())
        [metadata] = (name for name in names if name.endswith(".dist-info/METADATA"))
        told = message_from_bytes(packed.read(metadata))
    with tarfile.open(archive) as packed:
        sources = {name.partition("/")[2] for name in packed.getnames()}
    return names, sources, told


def faults(wheel: Path, archive: Path) -> list[str]:
    """What is wrong with the archives, a sentence each."""
    names, sources, told = contents(wheel, archive)
    found = [
        f"{path.name} has {path.stat().st_size:,} bytes; .ci/ship.py rounds weights"
        for path in (wheel, archive)
        if path.stat().st_size > LARGEST
    ]
    found += [f"{name} has no place in an archive" for name in sorted(names | sources) if NOT_SHIPPED.search(name)]
    wanted = {"sliplens/py.typed", f"sliplens-{told['Version']}.dist-info/licenses/LICENSE"}
    wanted |= {
        str(path.relative_to(ROOT / "src"))
        for path in (ROOT / "src").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    found += [f"{name} is missing from the wheel" for name in sorted(wanted - names)]
    missing = {"LICENSE", "README.md", "CITATION.cff", "pyproject.toml", "src/sliplens/py.typed"} - sources
    found += [f"{name} is missing from the source archive" for name in sorted(missing)]
    for field in (
        "Name",
        "Version",
        "Summary",
        "License-Expression",
        "Requires-Python",
        "Description-Content-Type",
        "Keywords",
    ):
        if not told[field]:
            found.append(f"the metadata has no {field}")
    page = render(str(told.get_payload()))
    if page is None:
        found.append("the README cannot be rendered as a package index does it")
    elif broken := re.findall(r'(?:src|href)="(?!https?:|#)([^"]*)"', page):
        found.append(f"a package index cannot show {', '.join(broken)}; see hatch_build.py")
    return found


def pythons(supported: SpecifierSet) -> dict[str, str]:
    """Supported Pythons of this machine, by their number of two parts; the one that runs this comes first."""
    listed = subprocess.run(
        [LIBRARIES / "uv", "python", "list", "--only-installed", "--no-config"],
        capture_output=True,
        text=True,
        check=False,
    ).stdout
    root = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    candidates = [
        sys.executable,
        *(line.split()[1] for line in listed.splitlines() if len(line.split()) > 1),
        *map(str, sorted(root.glob("3.*/bin/python"))),
    ]
    found: dict[str, str] = {}
    for candidate in candidates:
        asked = subprocess.run(
            [candidate, "-c", "import platform; print(platform.python_version())"],
            capture_output=True,
            text=True,
            check=False,
        )
        number = asked.stdout.strip()
        if asked.returncode == 0 and Version(number) in supported:
            found.setdefault(".".join(number.split(".")[:2]), candidate)
    return found


def try_wheel(wheel: Path, python: str) -> None:
    """Install the wheel alone, with what it asks for, and use it; `CalledProcessError` where that fails."""
    clean = {name: value for name, value in os.environ.items() if name not in {"PYTHONPATH", "VIRTUAL_ENV"}}
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "environment"
        own = place / "bin" / "python"
        install: list[str | Path] = [LIBRARIES / "uv", "pip", "install", "--quiet", "--python", own]
        command = place / "bin" / "sliplens"
        small = ["--dry-trials", "4", "--wet-trials", "1", "--days", "4", "--frames-per-trial", "20"]
        steps: list[list[str | Path]] = [
            [LIBRARIES / "uv", "venv", "--quiet", "--python", python, place],
            # the tested versions; their hashes are for `make install`
            [*install, "--constraint", ROOT / ".ci" / "requirements.txt", wheel],
            [LIBRARIES / "uv", "pip", "check", "--quiet", "--python", own],
            [own, "-W", "error::SyntaxWarning", "-c", SMOKE, ROOT / "README.md"],
            [command, "--help"],
            [command, "simulate", "data", *small],
            [command, "predict", "chromatouch-difference", "data", "-o", "margins.csv"],
        ]
        for step in steps:
            subprocess.run(step, cwd=folder, env=clean, check=True, capture_output=True, text=True)


def main() -> None:
    """Build, look inside, try."""
    wheel, archive = build()
    for path in (wheel, archive):
        print(f"{path.relative_to(ROOT)}: {path.stat().st_size / 1e6:.1f} MB")
    found = faults(wheel, archive)
    _, _, told = contents(wheel, archive)
    available = pythons(SpecifierSet(told["Requires-Python"]))
    for number, python in sorted(available.items()):
        started = time.perf_counter()
        try:
            try_wheel(wheel, python)
        except subprocess.CalledProcessError as error:
            found.append(
                f"Python {number}: {' '.join(map(str, error.cmd))[:200]} failed:\n{(error.stderr or '')[-2000:]}"
            )
        print(f"Python {number}: tried in {time.perf_counter() - started:.0f} s")
    missing = {"3.11", "3.12", "3.13"} - set(available)
    if missing:
        print(f"not at hand, and so not tried: Python {', '.join(sorted(missing))}")
    print(*found, sep="\n")
    sys.exit(1 if found else None)


if __name__ == "__main__":
    main()
