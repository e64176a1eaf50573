"""The page of a study: whole, by itself, and true to its numbers."""

import csv
import html
import re
import shutil
from html.parser import HTMLParser
from itertools import pairwise

import numpy as np
import pytest
from command_line import run

from sliplens.codec import save_record
from sliplens.report import Written, load_results, write_report
from sliplens.results.study import CONFIG_FILE, StudyConfig

from .study_results import Made, write_choice, write_others

THESIS_FIGURES = {
    "fig-07-mse-by-bin",
    "fig-09-faithfulness",
    "fig-15-methods-difference",
    "fig-16-methods-raw",
}
OWN_FIGURES = {
    "predictions",
    "randomisation",
    "sound-curves-difference",
    "sound-curves-raw",
    "truth-difference",
    "truth-raw",
}
STAGES = ("faithfulness", "randomisation", "map-quality", "timing", "truth")


class Reader(HTMLParser):
    """Tags with their attributes, and the caption of each figure."""

    def __init__(self):
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.captions: list[str] = []
        self._inside = False

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag == "figcaption":
            self._inside = True
            self.captions.append("")

    def handle_endtag(self, tag):
        self._inside = self._inside and tag != "figcaption"

    def handle_data(self, data):
        if self._inside:
            self.captions[-1] += data


@pytest.fixture(scope="module")
def text(study_report: Written) -> str:
    return study_report.page.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def reader(text) -> Reader:
    reader = Reader()
    reader.feed(text)
    return reader


@pytest.fixture(scope="module")
def caption(reader):
    """Caption of a figure, by the name of its files."""
    return lambda name: next(one for one in reader.captions if f"figures/{name}.pdf" in one)


@pytest.fixture(scope="module")
def numbers(study_report: Written):
    """Rows of a figure's CSV."""

    def read(name: str) -> list[dict[str, str]]:
        with (study_report.page.parent / "figures" / f"{name}.csv").open(encoding="utf-8", newline="") as stream:
            return list(csv.DictReader(stream))

    return read


def test_every_figure_of_the_thesis_is_there_as_pdf_and_csv(study_report):
    found = {path.stem: path for path in study_report.figures}

    assert set(found) == THESIS_FIGURES | OWN_FIGURES
    assert {path.name for path in (study_report.page.parent / "figures").iterdir()} == {
        f"{name}.{suffix}" for name in found for suffix in ("pdf", "csv")
    }
    for path in study_report.figures:
        assert path.suffix == ".csv" or path.read_bytes().startswith(b"%PDF")
        assert b"CreationDate" not in path.read_bytes()


def test_every_picture_has_words(reader):
    images = [attributes for tag, attributes in reader.tags if tag == "img"]

    assert len(images) == len(THESIS_FIGURES | OWN_FIGURES)
    assert all(len(attributes["alt"] or "") > 20 for attributes in images)


def test_headings_go_down_one_step_at_a_time(reader):
    levels = [int(tag[1]) for tag, _ in reader.tags if re.fullmatch(r"h[1-6]", tag)]

    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in pairwise(levels))


def test_verdict_comes_first_and_the_contents_lead_everywhere(reader):
    sections = [attributes["id"] for tag, attributes in reader.tags if tag == "section"]
    links = [attributes["href"] for tag, attributes in reader.tags if tag == "a"]

    assert sections[:4] == ["verdict", "claims", "accuracy", "faithfulness"]
    assert "truth" in sections
    assert links == [f"#{one}" for one in sections]


def test_all_five_claims_are_answered_for_both_networks(text):
    table = text.split("<h3>The claims of the thesis</h3>")[1].split("</table>")[0]
    outcomes = re.findall(r'<span class="badge ([a-z-]+)">', table)

    # the second compares both networks and has one row; without the methods of the thesis nothing is decided
    assert outcomes == ["undecided"] * (2 + 1 + 2 + 2) + ["holds"] * 2


def test_which_explanation_to_believe_is_the_first_table(text):
    first = text.split("<h2>Verdict</h2>")[1].split("</table>")[0]
    assert "Which explanation to believe" in first
    assert re.search(r'<td class="name">Poly-CAM</td>.*badge holds', first)


def test_caption_of_the_bins_is_their_largest_error(caption, numbers):
    rows = [row for row in numbers("fig-07-mse-by-bin") if row["mse"]]

    for condition in ("dry", "wet"):
        worst = max((row for row in rows if row["condition"] == condition), key=lambda row: float(row["mse"]))
        place = f"{100 * float(worst['low']):.0f}\N{NO-BREAK SPACE}% to {100 * float(worst['high']):.0f}"
        assert f"{condition}: {place}" in caption("fig-07-mse-by-bin")
        assert f"MSE {float(worst['mse']):.4f}" in caption("fig-07-mse-by-bin")


def test_captions_of_the_deletion_curves_are_their_means(caption, numbers):
    name = "fig-09-faithfulness"
    by_curve: dict[tuple[str, str], list[float]] = {}
    for row in numbers(name):
        by_curve.setdefault((row["input"], row["method"]), []).append(float(row["mean"]))

    told = [float(value) for value in re.findall(r"(?:CAM|Gradients|\(control\)) (0\.\d{3})", caption(name))]
    assert sorted(told) == sorted(round(float(np.mean(values)), 3) for values in by_curve.values())


@pytest.mark.parametrize("name", ["difference", "raw"])
def test_captions_of_the_sound_curves_are_the_areas_between_them(caption, numbers, name):
    rows = [row for row in numbers(f"sound-curves-{name}") if (row["fill"], row["unit"]) == ("reference", "pixel")]
    words = {"poly-cam": "Poly-CAM", "grad-cam": "Grad-CAM", "integrated-gradients": "Integrated Gradients"}

    for method, word in words.items():
        own = [row for row in rows if row["method"] == method]
        area, most, least = (
            np.array([float(row[key]) for row in own]) for key in ("area", "most_first", "least_first")
        )
        gain = f"{np.trapezoid(most - least, area):+.3f}".replace("-", "\N{MINUS SIGN}")
        assert f"{word} {gain}" in caption(f"sound-curves-{name}")


def test_tables_hold_the_thesis_score_beside_the_sound_ones(text, pristine_study):
    results = load_results(pristine_study)
    cells = {html.unescape(one) for one in re.findall(r"<td[^>]*>([^<]*)</td>", text)}

    for name in ("difference", "raw"):
        scored = results.scores[name, "simulated"].methods["poly-cam"]
        assert f"{scored.mean:.3f} ± {scored.sd:.3f}" in cells
        for score in results.study.faithfulness[name].scores:
            gap = score.srg
            values = [f"{one:+.3f}".replace("-", "\N{MINUS SIGN}") for one in (gap.estimate, gap.low, gap.high)]
            assert f"{values[0]}{'*' if gap.sure else ''}\n{values[1]} to {values[2]}" in cells
    assert {"0.325 ± 0.106", "0.200 ± 0.146"} <= cells


def test_alarms_and_the_choice_of_trials_are_told(text):
    assert "The fill decides in 2 of 18 frames." in text
    assert re.search(
        r"<li>Methods that do not beat a random order: \d+ \(difference images \d+ and raw images \d+\)</li>", text
    )
    assert "Grad-CAM does not beat a random order: its symmetric gain is -0.050." in text
    assert "5 of 60 dry test trials lie within 3 %, so the nearest other was taken too." in text


@pytest.mark.parametrize("kept", ["choice", "states", *(f"{stage}-raw" for stage in STAGES)])
def test_a_stage_alone_makes_a_page_that_names_the_others(pristine_study, tmp_path, kept):
    shutil.copytree(pristine_study / kept, tmp_path / kept)

    page = write_report(tmp_path).page.read_text(encoding="utf-8")

    missing = re.findall(r'<p class="missing">(.*?)</p>', page)
    assert len(missing[-1].split(", ")) >= 6
    assert all("not run yet; <code>sliplens study</code> makes it." in one for one in missing)
    assert "<h2>Verdict</h2>" in page


def test_a_page_misses_nothing_that_was_not_asked_for(pristine_study, tmp_path):
    for kept in ("choice", "states", "truth-raw"):
        shutil.copytree(pristine_study / kept, tmp_path / kept)
    save_record(StudyConfig(tests=("truth", "timing")), tmp_path / CONFIG_FILE)

    page = write_report(tmp_path).page.read_text(encoding="utf-8")

    *_, missing = re.findall(r'<p class="missing">(.*?)</p>', page)
    assert missing.partition(":")[0] == "Accuracy, Saliency maps, Cost"


def test_too_few_trials_are_told_before_anything_else(tmp_path, text):
    write_choice(tmp_path, Made(trials=3))

    page = write_report(tmp_path).page.read_text(encoding="utf-8")

    verdict = page.split("<h2>Verdict</h2>")[1].lstrip()
    assert verdict.startswith('<p class="few">This study explains 3 trials, and fewer than 5 decide nothing')
    assert 'class="few"' not in text


def test_command_says_what_it_wrote(pristine_study, tmp_path, capsys):
    shutil.copytree(pristine_study / "timing-raw", tmp_path / "timing-raw")
    shutil.copytree(pristine_study / "randomisation-raw", tmp_path / "randomisation-raw")

    assert run("report", tmp_path) == 0

    told = capsys.readouterr().out
    assert f"{tmp_path / 'figures'}  1 figure as PDF, their numbers as CSV" in told
    assert f"{tmp_path / 'report.html'}  open it in a browser" in told
    # a half-written file has a name that begins with a point
    assert not list(tmp_path.rglob(".*"))


def test_one_network_alone_misses_nothing_of_the_other(tmp_path):
    made = Made(inputs=("raw",))
    write_choice(tmp_path, made)
    write_others(tmp_path, "raw", made)

    page = write_report(tmp_path).page.read_text(encoding="utf-8")

    assert not re.findall(r'<p class="missing">Difference images', page)


def test_figures_of_others_are_left_alone(pristine_study, tmp_path):
    shutil.copytree(pristine_study / "randomisation-raw", tmp_path / "randomisation-raw")
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "my-own.pdf").write_text("mine")

    assert run("report", tmp_path) == 0

    assert (tmp_path / "figures" / "my-own.pdf").read_text() == "mine"
