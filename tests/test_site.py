"""The documentation's own checker finds what a reader would stumble over; `make docs` runs it over the whole site."""

import runpy
from pathlib import Path
from types import SimpleNamespace

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def docs():
    """The script that `make docs` runs."""
    return SimpleNamespace(**runpy.run_path(str(ROOT / ".ci" / "docs.py")))


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """Two pages that lead to each other."""
    (tmp_path / "api").mkdir()
    (tmp_path / "api" / "calls.html").write_text('<h2 id="load">load</h2> <a href="../index.html#top">home</a>')
    (tmp_path / "index.html").write_text(
        '<h1 id="top">Site</h1> <a href="api/calls.html#load">load</a> <a href="https://example.org/gone">other</a>'
    )
    return tmp_path


def test_a_site_whose_links_lead_somewhere_has_no_fault(docs, site: Path):
    assert docs.find_faults(site) == []


def test_a_site_is_found_from_where_one_stands(docs, site: Path, monkeypatch: pytest.MonkeyPatch):
    (site / "api" / "calls.html").write_text('<a href="../index.html#gone">home</a>')
    monkeypatch.chdir(site.parent)
    assert docs.find_faults(Path(site.name)) == docs.find_faults(site) != []


@pytest.mark.parametrize(
    ("added", "told"),
    [
        ('<a href="gone.html">', "gone.html, which is not there"),
        ('<a href="api/calls.html#train">', "no such place"),
        ('<a href="/gone.html">', "which is not there"),
        ('<img src="images/gone.png">', "which is not there"),
        ('<script src="https://cdn.example.org/x.js">', "loads https://cdn.example.org/x.js"),
        ('<link rel="stylesheet" href="//fonts.example.org/x.css">', "loads //fonts.example.org/x.css"),
    ],
)
def test_what_leads_nowhere_or_is_loaded_from_outside_is_told(docs, site: Path, added: str, told: str):
    page = site / "index.html"
    page.write_text(page.read_text() + added)
    [fault] = docs.find_faults(site)
    assert fault.startswith("index.html")
    assert told in fault


def test_a_browser_finds_what_is_wide_faint_or_broken(docs, site: Path):
    page = site / "index.html"
    page.write_text(
        "<!doctype html><body style='background: #fff'><p style='color: #ccc'>hardly there</p><p>plain to see</p>"
        "<div style='width: 500px'>wide</div><script>nothing.at.all</script></body>"
    )
    faults = docs.open_pages(site, [page, site / "api" / "calls.html"])
    if faults is None:
        pytest.skip("there is no Chromium on this machine")
    assert faults[0] == "index.html: nothing is not defined"
    assert "px wide" in faults[1]
    assert 'light: "hardly there"' in faults[2]
    assert len(faults) == 6  # and the same in the dark
