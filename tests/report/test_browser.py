"""The page of a study in a real browser."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hostile_names import ATTACK, FILE_NAME, assert_inert, watch
from own_recording import write_forces, write_video

from sliplens.cli import main
from sliplens.plots.sheets import draw_audit
from sliplens.plots.style import save_page
from sliplens.recordings import load_dataset
from sliplens.recordings.dataset import trial_path
from sliplens.recordings.store import load_recording
from sliplens.report import Written, write_report
from sliplens.simulation import PRESETS, plan_trials, simulate_trial

PHONE, DESK = {"width": 320, "height": 640}, {"width": 1280, "height": 900}


@pytest.fixture(scope="module", params=[PHONE, DESK], ids=["phone", "desk"])
def opened(request: pytest.FixtureRequest, browser: Any, study_report: Written) -> Iterator[tuple[Any, list, list]]:
    """The page, what the console said, and what was asked for beside it."""
    page = browser.new_page(viewport=request.param)
    said, asked = [], []
    page.on("console", lambda message: said.append(message.text) if message.type in {"error", "warning"} else None)
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda one: asked.append(one.url))
    page.goto(study_report.page.as_uri(), wait_until="load")
    yield page, said, asked
    page.close()


def test_the_page_is_whole_by_itself(opened, study_report):
    page, said, asked = opened

    assert said == []
    assert [url for url in asked if not url.startswith("data:")] == [study_report.page.as_uri()]
    widths = page.evaluate("[...document.images].map(image => image.naturalWidth)")
    assert widths
    assert min(widths) > 0


def test_the_page_does_not_scroll_sideways(opened):
    page, _, _ = opened

    # with every detail open: what is folded away must fit too
    page.evaluate("document.querySelectorAll('details').forEach(one => one.open = true)")
    wide = page.viewport_size["width"]
    assert page.evaluate("document.documentElement.scrollWidth") <= wide
    # what is wider scrolls inside a box that the keyboard reaches
    boxes = page.evaluate("""[...document.querySelectorAll('.scroll')].map(box => box.tabIndex)""")
    assert set(boxes) == {0}


@pytest.fixture
def window(browser: Any) -> Iterator[Any]:
    """A window that counts what runs though it should not."""
    window = browser.new_page()
    watch(window)
    yield window
    window.close()


def test_hostile_names_do_nothing_in_figures_of_an_import(window, tmp_path: Path, capsys):
    trial = simulate_trial(replace(plan_trials(PRESETS["small"])[0], frames=48))
    (source := tmp_path / "source").mkdir()
    write_video(trial, source / "cup.mkv")
    write_forces(trial, source / "cup.csv")
    (source / f"{FILE_NAME}.mkv").write_bytes(b"no video")
    named = [word for option in ("object", "condition") for word in (f"--{option}", ATTACK)]

    with pytest.raises(SystemExit):  # what was left out
        main(["import", str(source), "--output", str(tmp_path / "data"), *named, "--sensor", "tip", "--no-audit"])

    said = capsys.readouterr()
    assert "\x1b[2J" not in said.out + said.err
    [info] = load_dataset(tmp_path / "data").trials
    assert info.object == ATTACK
    recording = load_recording(trial_path(tmp_path / "data", info.trial))
    assert recording.labelling is not None
    save_page(draw_audit(recording, recording.labelling), tmp_path / "audit.svg")
    window.goto((tmp_path / "audit.svg").as_uri())
    assert window.evaluate("document.querySelectorAll('script, img, [onerror]').length") == 0
    assert window.evaluate("document.documentElement.tagName") == "svg"  # not the page of a parser's error


def test_hostile_names_do_nothing_on_a_report(window, workspace: Path, tmp_path: Path):
    for path in list(workspace.rglob("run.json")):
        told = json.loads(path.read_text())
        if told["stage"] in {"explain", "score"}:  # whose figures take seconds
            shutil.rmtree(path.parent)
            continue
        told["versions"][ATTACK] = told["machine"]["processor"] = told["config"][ATTACK] = ATTACK
        path.write_text(json.dumps(told))
    for path in workspace.rglob("*.json"):
        path.write_text(path.read_text().replace('"wet"', json.dumps(ATTACK)))
    for path in workspace.rglob("*.parquet"):
        if "condition" in (table := pq.read_table(path)).column_names:
            wet = pa.array([ATTACK if one == "wet" else one for one in table["condition"].to_pylist()])
            pq.write_table(table.set_column(table.column_names.index("condition"), "condition", wet), path)
    hostile = workspace.rename(tmp_path / FILE_NAME)

    page = write_report(hostile).page

    window.goto(page.as_uri())
    assert_inert(window)
