"""The page of a workspace and of a study: whole, by itself, and true to its numbers."""

import re
import shutil
from dataclasses import replace
from html import unescape
from itertools import pairwise
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from command_line import run

from sliplens.errors import InputError
from sliplens.files import write_json
from sliplens.report import Written, load_results, write_report
from sliplens.report.plates import frames_by_margin
from sliplens.results.study import CONFIG_FILE, StudyConfig

from .study_results import Made, edit, write_choice

HOSTILE, DOLLARS = "<script>alert(1)</script>", "$\\bad$"


@pytest.fixture(scope="module")
def complete(pristine_workspace, tmp_path_factory):
    """A complete workspace and its page, for the tests that only read."""
    return pristine_workspace, write_report(pristine_workspace, tmp_path_factory.mktemp("out") / "report.html").page


@pytest.fixture
def text(complete) -> str:
    return complete[1].read_text(encoding="utf-8")


@pytest.fixture
def cells(text) -> set[str]:
    """Texts of the cells of all tables."""
    return {unescape(cell).strip() for cell in re.findall(r"<td[^>]*>(.*?)</td>", text, re.DOTALL)}


@pytest.fixture
def build(workspace, tmp_path):
    """The page of a workspace of one's own, as it is when called."""
    return lambda: write_report(workspace, tmp_path / "report.html").page.read_text(encoding="utf-8")


def keep(workspace, *names):
    for folder in workspace.iterdir():
        if folder.name not in names:
            shutil.rmtree(folder)


def test_page_needs_nothing_but_itself(text):
    loaded = re.findall(r'<[^>]*\s(?:src|href)="([^"]*)"', text)
    assert loaded
    assert all(value.startswith(("data:image/", "#")) for value in loaded)
    assert not re.search(r"url\(|@import|<link|<script|http-equiv=\"refresh", text)


def test_page_speaks_to_those_who_cannot_see_it(text):
    images = re.findall(r"<img [^>]*>", text)
    assert images
    assert all(re.search(r'alt="[^"]{21,}"', image) for image in images)
    assert '<html lang="en">' in text


def test_tables_hold_the_numbers_of_the_results(cells, complete):
    results = load_results(complete[0])
    for evaluation in results.evaluations.values():
        for score in evaluation.conditions.values():
            assert score.r2 is not None
            assert {f"{score.mse:.4f}", f"{score.r2:.3f}", f"{100 * score.mae:.1f}"} <= cells
    for scored in results.deletion.values():
        assert {f"{score.mean:.3f} ± {score.sd:.3f}" for score in scored.methods.values()} <= cells


def test_the_thesis_stands_beside_and_is_marked(text, cells):
    assert {"0.0187", "0.0507", "0.0144", "0.0402", "0.85", "0.57", "0.89", "0.66"} <= cells
    assert {"0.325 ± 0.106", "0.272 ± 0.158", "0.200 ± 0.146", "0.539 ± 0.101"} <= cells
    assert text.count("thesis (real touch, other data)") == 3


def test_warnings_and_alarms_are_shown(text):
    assert "on 3 frames the filled image is answered like the frame itself." in text
    assert "integrated-gradients: completeness gap 1.8 % on 2 frames." in text


def test_same_results_make_the_same_page(text, complete, tmp_path):
    assert write_report(complete[0], tmp_path / "again.html").page.read_text(encoding="utf-8") == text


def test_what_was_not_asked_for_is_not_missed(build, workspace):
    keep(workspace, "test-difference", "maps-raw-simulated")

    text = build()

    assert "not run yet" not in text
    assert "<h2>How far" not in text


def test_hostile_names_are_escaped(build, workspace):
    keep(workspace, "data", "test-difference", "maps-raw-real")

    def rename(value):
        value["frames"][0]["id"] = '"><img src=x onerror=alert(1)>'
        value["methods"]["grad-cam"]["warnings"] = [HOSTILE]
        for frame in value["frames"]:
            frame["condition"] = "<b>$dry$"

    evaluated = workspace / "test-difference"
    table = pq.read_table(evaluated / "predictions.parquet")
    for place, (column, name) in enumerate((("trial", HOSTILE), ("condition", DOLLARS))):
        table = table.set_column(place, column, pa.array([name] * table.num_rows))
    pq.write_table(table, evaluated / "predictions.parquet")
    edit(evaluated / "result.json", lambda value: value.update(conditions={DOLLARS: value["conditions"]["dry"]}))
    edit(workspace / "maps-raw-real" / "result.json", rename)
    edit(workspace / "data" / "run.json", lambda value: value.update(config={HOSTILE: HOSTILE}, finished=HOSTILE))

    text = build()

    assert "<script" not in text
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in text
    assert not re.search(r"<[^>]*onerror", text)
    assert "<b>$dry$" not in text
    assert DOLLARS in text  # drawn as it is


def test_page_is_not_written_where_a_result_is_malformed(workspace, tmp_path):
    (workspace / "score-raw" / "result.json").write_text("{}")

    with pytest.raises(InputError):
        write_report(workspace, tmp_path / "report.html")

    assert not list(tmp_path.glob("*report.html*"))


@pytest.mark.parametrize(
    ("labels", "chosen"),
    [
        # evenly spread by their labels, those of the condition that most frames have
        ([1.0, 0.9, 0.2, 0.0, 0.4, 0.6, 0.7, 0.5, 0.3, 0.1, 0.8], [1.0, 0.8, 0.6, 0.4, 0.2, 0.0]),
        ([0.0, 1.0, 0.25], [1.0, 0.25, 0.0]),
        ([None] * 9, [None] * 6),
    ],
)
def test_frames_fall_from_stick_to_slip_and_without_labels_stand_in_order(complete, labels, chosen):
    results = load_results(complete[0])
    explained = results.explanations["raw"]
    frames = [replace(explained.frames[0], id=str(at), safety_margin=label) for at, label in enumerate(labels)]
    frames.append(replace(explained.frames[0], id="wet", condition="wet", safety_margin=0.5))
    many = explained.take([0] * len(frames))
    rows = frames_by_margin(results, replace(many, frames=tuple(frames)))
    assert [frames[row].safety_margin for row in rows] == chosen


@pytest.mark.parametrize(
    ("page", "message"), [(".", "is a folder; name the HTML file"), ("file/report.html", "cannot write")]
)
def test_a_page_that_cannot_be_written_is_refused(workspace, tmp_path, page, message):
    keep(workspace, "data")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=message):
        write_report(workspace, tmp_path / page)


THESIS_FIGURES = {"fig-07-mse-by-bin", "fig-09-faithfulness", "fig-15-methods-difference", "fig-16-methods-raw"}
STAGES = ("faithfulness", "map-quality", "truth")


@pytest.fixture(scope="module")
def study_text(study_report: Written) -> str:
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


def test_verdict_comes_first_and_headings_and_contents_lead_everywhere(study_text):
    levels = [int(level) for level in re.findall(r"<h([1-6])", study_text)]
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in pairwise([0, *levels]))
    sections = re.findall(r'<section id="([^"]+)"', study_text)
    assert sections[:4] == ["opening", "verdict", "accuracy", "faithfulness"]
    assert sections[-2:] == ["claims", "recipe"]
    assert re.findall(r'<a href="#([^"]+)"', study_text) == sections


def test_the_first_table_sets_every_method_beside_the_best_control(study_text):
    first = study_text.split("<h2>Can these maps be trusted?</h2>")[1].split("</table>")[0]
    assert re.search(r'<td class="name">Poly-CAM</td>.*badge ahead', first)


def test_alarms_and_the_choice_of_trials_are_on_the_page(study_text):
    assert study_text.count("the fill decides in 2 of 18 frames.") == 2
    assert "<li>Raw images: grad-cam does not beat a random order: its symmetric gain is -0.050." in study_text
    assert "60 dry test trials have a frame near every level" in study_text


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


def test_too_few_trials_are_told_before_anything_else(tmp_path, study_text):
    write_choice(tmp_path, Made(trials=3))

    page = write_report(tmp_path).page.read_text(encoding="utf-8")

    opening = page.split("<h2>Can these maps be trusted?</h2>")[1].split("</p>", 1)[1].lstrip()
    assert opening.startswith('<p class="few">This study explains 3 trials, and fewer than 5 decide nothing')
    assert 'class="few"' not in study_text


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
