"""What the figures of a study are made of."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

import sliplens as sl
from sliplens.report import load_results
from sliplens.report.pictures import plate_truth
from sliplens.report.plates import (
    Cell,
    Plate,
    bright_pictures,
    draw_grid,
    explained_of,
    picture_brightness,
    shown_frames,
    write_plates,
)
from sliplens.report.tables import table_scores

from .study_results import METHODS, SPEARMAN, Made, write_choice, write_faithfulness


@pytest.fixture(scope="module")
def results(pristine_study):
    return load_results(pristine_study)


def make_plate(name: str = "one", numbers: dict | None = None) -> Plate:
    figure = Figure(figsize=(2, 1), layout="constrained")
    figure.subplots().plot([0, 1])
    return Plate(
        name=name, figure=figure, alt="A line that rises.", caption="A line.", numbers=numbers or {"x": [0, 1]}
    )


def test_shown_frames_are_one_trial_from_stick_to_slip(results):
    explained = explained_of(results, "raw")
    assert explained is not None

    frames = shown_frames(results, explained)

    assert [frame.level for frame in frames] == [1.0, 0.8, 0.6, 0.4, 0.2, 0.0]
    assert {explained.frames[frame.index].id[:3] for frame in frames} == {"t00"}


def test_differences_are_made_brighter_all_alike_and_raw_frames_never(results):
    raw, difference = explained_of(results, "raw"), explained_of(results, "difference")
    assert raw is not None
    assert difference is not None

    untouched, called = bright_pictures(raw, [0, 3])
    np.testing.assert_array_equal(untouched[3], raw.pictures[3])
    assert called == "Input"

    # the frame of full stick alone is all but black
    brighter, called = bright_pictures(difference, [0])
    factor = float(called.split("\N{NO-BREAK SPACE}")[1])
    assert factor > 1
    np.testing.assert_array_equal(brighter[0], np.minimum(np.round(np.float32(factor) * difference.pictures[0]), 255))


def test_the_truth_stands_beside_the_maps_that_match_it_best(results):
    study, truth = results.study, results.study.truth["raw"]
    turned = {"grad-cam": truth.methods["poly-cam"], "poly-cam": truth.methods["grad-cam"]}
    study = replace(study, truth={"raw": replace(truth, methods=truth.methods | turned)})

    plate = plate_truth(replace(results, study=study), "raw")

    assert plate is not None
    assert "maps of Grad-CAM, Integrated Gradients and Poly-CAM" in plate.alt


def test_the_truth_alone_is_a_figure(results):
    (ax,) = sl.plot(results.study.truth["raw"]).axes

    row = [label.get_text() for label in ax.get_yticklabels()].index("Poly-CAM")
    assert np.asarray(ax.lines[2 * row + 1].get_xdata()).item() == SPEARMAN["poly-cam"]
    assert ax.yaxis_inverted()  # the thesis's methods on top


def test_grid_has_an_axes_for_each_cell_and_leaves_absent_ones_blank():
    picture = np.zeros((5, 5, 3), dtype=np.uint8)

    grid = draw_grid([("A", [Cell(picture=picture), Cell(picture=None)])], heads=["one", "two"])

    assert [len(row) for row in grid.axes] == [2]
    assert [len(ax.images) for ax in grid.axes[0]] == [1, 0]
    assert [text.get_text() for text in grid.axes[0][1].texts] == ["no frame"]


def test_numbers_are_written_with_nine_digits(tmp_path):
    page, table = write_plates([make_plate(numbers={"name": ["a", "b"], "value": np.array([1 / 3, 2.0])})], tmp_path)

    with table.open(newline="") as stream:
        assert list(csv.reader(stream)) == [["name", "value"], ["a", "0.333333333"], ["b", "2"]]
    assert page.name == "one.pdf"


@pytest.mark.parametrize(("more", "beside"), [((), "Poly-CAM"), (("poly-cam-thesis",), "Poly-CAM as in the thesis")])
def test_the_thesis_stands_beside_its_own_poly_cam(tmp_path, rng, more, beside):
    made = Made(inputs=("raw",), methods=(*METHODS, *more))
    write_choice(tmp_path, made)
    write_faithfulness(tmp_path, "raw", made, rng=rng)

    table = table_scores(load_results(tmp_path).study.faithfulness["raw"], None)

    told = {row[0].text: row[2].text for row in table.rows}
    assert told[beside] == "0.512 ± 0.203"
    assert list(told.values()).count("0.512 ± 0.203") == 1


def test_only_pictures_on_black_are_brightened():
    dark, middle = (np.full((1, 8, 8, 3), level, dtype=np.uint8) for level in (20, 128))

    assert picture_brightness("difference", dark) == (12.8, "Input \N{MULTIPLICATION SIGN}\N{NO-BREAK SPACE}12.8")
    assert picture_brightness("amplitude", dark)[0] == 12.8
    # no change is mid-grey in signed differences: twice as bright it would be white
    assert picture_brightness("signed", middle) == picture_brightness("raw", middle) == (1.0, "Input")


def test_columns_of_unequal_length_write_nothing(tmp_path):
    with pytest.raises(ValueError, match="shorter"):
        write_plates([make_plate(numbers={"a": [1, 2], "b": [1]})], tmp_path)

    assert not list(tmp_path.rglob("*.csv*"))


def test_same_plate_makes_the_same_files(tmp_path):
    files = [write_plates([make_plate()], tmp_path / name)[0].read_bytes() for name in "ab"]

    assert files[0] == files[1]
    assert make_plate().picture == make_plate().picture
