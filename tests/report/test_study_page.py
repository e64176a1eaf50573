"""The page of a study: whole, by itself, and true to its numbers."""

import re
import shutil
from itertools import pairwise
from pathlib import Path

import pytest
from command_line import run

from sliplens.codec import write_json
from sliplens.report import Written, write_report
from sliplens.results.study import CONFIG_FILE, StudyConfig

from .study_results import Made, write_choice

THESIS_FIGURES = {"fig-07-mse-by-bin", "fig-09-faithfulness", "fig-15-methods-difference", "fig-16-methods-raw"}
STAGES = ("faithfulness", "map-quality", "truth")


@pytest.fixture(scope="module")
def text(study_report: Written) -> str:
    return study_report.page.read_text(encoding="utf-8")


def test_every_figure_of_the_thesis_is_there_as_pdf_and_csv(study_report):
    found = {path.stem: path for path in study_report.figures}

    assert set(found) == THESIS_FIGURES
    assert {path.name for path in (study_report.page.parent / "figures").iterdir()} == {
        f"{name}.{suffix}" for name in found for suffix in ("pdf", "csv")
    }
    for path in study_report.figures:
        assert path.suffix == ".csv" or path.read_bytes().startswith(b"%PDF")
        assert b"CreationDate" not in path.read_bytes()


def test_verdict_comes_first_and_headings_and_contents_lead_everywhere(text):
    levels = [int(level) for level in re.findall(r"<h([1-6])", text)]
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in pairwise([0, *levels]))
    sections = re.findall(r'<section id="([^"]+)"', text)
    assert sections[:4] == ["opening", "verdict", "accuracy", "faithfulness"]
    assert sections[-2:] == ["claims", "recipe"]
    assert re.findall(r'<a href="#([^"]+)"', text) == sections


def test_the_first_table_sets_every_method_beside_the_best_control(text):
    first = text.split("<h2>Can these maps be trusted?</h2>")[1].split("</table>")[0]
    assert re.search(r'<td class="name">Poly-CAM</td>.*badge ahead', first)


def test_alarms_and_the_choice_of_trials_are_on_the_page(text):
    assert text.count("the fill decides in 2 of 18 frames.") == 2
    assert "<li>Raw images: Grad-CAM does not beat a random order: its symmetric gain is -0.050." in text
    assert "60 dry test trials have a frame near every level" in text


def missing(folder: Path) -> str:
    """Sections that the page of a study names as not run yet."""
    page = write_report(folder).page.read_text(encoding="utf-8")
    assert "<h2>Can these maps be trusted?</h2>" in page
    (names,) = re.findall(r"goes on where it stopped\. (.*?): not run yet; <code>sliplens study</code> makes it", page)
    return names


@pytest.mark.parametrize("stage", ["choice", "states", *(f"{stage}-raw" for stage in STAGES)])
def test_a_stage_alone_makes_a_page_that_names_the_others(pristine_study, tmp_path, stage):
    shutil.copytree(pristine_study / stage, tmp_path / stage)
    assert len(missing(tmp_path).split(", ")) >= 3


def test_a_page_misses_nothing_that_was_not_asked_for(pristine_study, tmp_path):
    for stage in ("choice", "states", "truth-raw"):
        shutil.copytree(pristine_study / stage, tmp_path / stage)
    write_json(tmp_path / CONFIG_FILE, StudyConfig(tests=("truth",)))
    assert missing(tmp_path) == "Accuracy, Saliency maps"


def test_too_few_trials_are_told_before_anything_else(tmp_path, text):
    write_choice(tmp_path, Made(trials=3))

    page = write_report(tmp_path).page.read_text(encoding="utf-8")

    opening = page.split("<h2>Can these maps be trusted?</h2>")[1].split("</p>", 1)[1].lstrip()
    assert opening.startswith('<p class="few">This study explains 3 trials, and fewer than 5 decide nothing')
    assert 'class="few"' not in text


def test_command_says_what_it_wrote(pristine_study, tmp_path, capsys):
    shutil.copytree(pristine_study / "score-raw", tmp_path / "score-raw")
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "my-own.pdf").write_text("mine")
    assert run("report", tmp_path) == 0

    told = capsys.readouterr().out
    assert f"{tmp_path / 'figures'}  1 figure as PDF, their numbers as CSV" in told
    assert f"{tmp_path / 'report.html'}  open it in a browser" in told
    # a half-written file has a name that begins with a point
    assert not list(tmp_path.rglob(".*"))
    assert (tmp_path / "figures" / "my-own.pdf").read_text() == "mine"
