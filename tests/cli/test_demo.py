"""The demo, small: every stage, the page that grows, and a second run that has nothing to do."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from command_line import refused, run

import sliplens.demo
from sliplens.demo import run_demo
from sliplens.files import read_json
from sliplens.report.page import Written

SMALL = {"preset": "thesis", "dry_trials": 3, "wet_trials": 1, "frames_per_trial": 24, "days": 2, "test_days": 1}


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sliplens.demo, "SHOWN_DATA", SMALL)
    monkeypatch.setattr(sliplens.demo, "STRIP_METHOD", "grad-cam")


@pytest.fixture
def pages() -> list[str]:
    return []


def test_the_demo_runs_every_stage_and_its_page_grows(
    tmp_path: Path, pages: list[str], monkeypatch: pytest.MonkeyPatch
):
    out = tmp_path / "demo"
    page = run_demo(out, on_page=lambda page: pages.append(page.read_text(encoding="utf-8")))
    stages = {read_json(path)["stage"] for path in out.glob("*/run.json")}
    assert stages >= {"simulate", "strip", "evaluate"}
    assert page == out / "report.html"
    assert pages[-1] == page.read_text(encoding="utf-8")
    # while something is missing the page says so and loads itself anew, and ends complete
    assert ['http-equiv="refresh"' in text for text in pages] == [True] * (len(pages) - 1) + [False]
    assert len(pages) == 2 + (out / "explain-real").is_dir()  # the reference is not everywhere
    assert "how well both networks predict" in pages[0]
    # each opens with the grip, above the verdict
    assert all(0 < text.index('id="opening"') < text.index('id="verdict"') for text in pages)

    # the same again makes nothing anew; drawing its three pages again would take as long as all the rest
    written = {path: path.stat().st_mtime_ns for path in out.glob("*/run.json")}
    monkeypatch.setattr(sliplens.demo, "write_report", lambda *_, **__: Written(page=page, figures=()))
    assert run_demo(out) == page
    assert {path: path.stat().st_mtime_ns for path in out.glob("*/run.json")} == written


def test_a_folder_that_is_no_demo_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def stop(*arguments: object, **options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(sliplens.demo, "simulate", stop)
    assert run("demo", tmp_path / "demo") == 130
    assert run("demo", tmp_path / "demo") == 130  # the same goes on
    (tmp_path / "demo").mkdir(exist_ok=True)
    (tmp_path / "demo" / "thesis.tex").touch()
    capsys.readouterr()
    assert "is no demo; choose another folder" in refused(capsys, "demo", tmp_path / "demo")


def test_the_command_says_where_the_page_is_as_soon_as_it_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def made(out: str, *, on_page: Callable | None = None, on_progress: Any = None) -> Path:
        assert on_page is not None
        page = Path(out) / "report.html"
        on_page(page)
        on_progress.note("a method does not beat a random order")
        return page

    monkeypatch.setattr(sliplens.demo, "run_demo", made)
    assert run("demo", tmp_path / "demo") == 0
    printed = capsys.readouterr().out.replace("\n", "")
    assert f"open {tmp_path / 'demo' / 'report.html'} now" in printed
    assert "random order" not in printed  # the page tells them
