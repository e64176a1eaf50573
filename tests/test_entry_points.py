"""Rows that installed packages add to tables."""

import sys
from pathlib import Path

import pytest

from sliplens.errors import InputError
from sliplens.extras import entry_points


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Install a package that adds a row to a table of fills."""

    def install(row: str) -> None:
        (tmp_path / "other_fills.py").write_text("ROW = 'a fill'\n")
        info = tmp_path / "other_fills-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other-fills\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[sliplens.fills]\nother = {row}\n")
        monkeypatch.syspath_prepend(str(tmp_path))

    yield install
    sys.modules.pop("other_fills", None)


def test_a_package_adds_a_row(installed):
    installed("other_fills:ROW")
    assert entry_points("sliplens.fills") == {"other": "a fill"}
    assert entry_points("sliplens.explainers") == {}


def test_a_row_that_cannot_be_imported_names_its_package(installed):
    installed("other_fills:MISSING")
    with pytest.raises(InputError, match=r"other-fills adds .other. to sliplens.fills.*update or uninstall"):
        entry_points("sliplens.fills")
