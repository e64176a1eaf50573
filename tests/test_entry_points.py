"""Rows that installed packages add to the tables of sliplens."""

import sys
from pathlib import Path

import pytest

from sliplens.errors import InputError
from sliplens.explainers.table import EXPLAINERS
from sliplens.extras import Table
from sliplens.faithfulness.fills import FILLS
from sliplens.grip.controllers import CONTROLLERS
from sliplens.live.sinks import SINKS
from sliplens.live.sources import SOURCES
from sliplens.recordings.formats import FORMATS

TABLES = {
    "sliplens.controllers": CONTROLLERS,
    "sliplens.explainers": EXPLAINERS,
    "sliplens.fills": FILLS,
    "sliplens.formats": FORMATS,
    "sliplens.sinks": SINKS,
    "sliplens.sources": SOURCES,
}


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Put a package on the path whose metadata add a row to a group."""

    def add(group: str, row: str, code: str = "ROW = 'a row'\n") -> None:
        (tmp_path / "other_rows.py").write_text(code)
        info = tmp_path / "other_rows-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other-rows\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[{group}]\n{row}\n")
        monkeypatch.syspath_prepend(str(tmp_path))

    yield add
    sys.modules.pop("other_rows", None)


@pytest.mark.parametrize("group", TABLES)
def test_an_installed_package_adds_a_row_to_every_table(install, group):
    table = TABLES[group]
    assert table.group == group
    ours = dict(table)
    install(group, "other = other_rows:ROW")
    fresh = Table(table.noun, table.group, ours)  # `table` has been walked, and keeps what it found
    assert fresh["other"] == fresh.pick("other") == "a row"
    assert list(fresh) == [*ours, "other"]


def test_a_table_is_walked_without_importing_what_nobody_asks_for(install):
    install("sliplens.levels", "other = other_rows:ROW", code="raise RuntimeError('loaded')\n")
    assert Table("level", "sliplens.levels", {"black": 0.0})["black"] == 0.0


def test_a_package_that_imports_sliplens_first_can_add_to_it(install):
    code = "from sliplens.faithfulness.fills import FILLS\nlist(FILLS)\nROW = FILLS['grey']\n"
    install("sliplens.other", "other = other_rows:ROW", code=code)
    assert Table("fill", "sliplens.other", {})["other"] is FILLS["grey"]


def test_a_row_that_cannot_be_imported_is_left_out_and_names_its_package(install):
    install("sliplens.levels", "other = other_rows:MISSING")
    table, words = Table("level", "sliplens.levels", {"black": 0.0}), r"other-rows adds the level 'other', .* update or"
    with pytest.warns(UserWarning, match=words):
        assert list(table) == ["black"]
    assert table.pick("black") == 0.0
    with pytest.raises(InputError, match=words):
        table.pick("other")


def test_no_package_replaces_a_row_of_sliplens(install):
    install("sliplens.fills", "grey = other_rows:ROW")
    table = Table("fill", "sliplens.fills", {"grey": 0.5})
    assert table["grey"] == 0.5
    with pytest.raises(InputError, match="adds the fill 'grey', a name that is taken"):
        list(table)
