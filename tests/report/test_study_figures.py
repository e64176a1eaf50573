"""What the figures of a study are made of."""

import csv
from collections.abc import Iterator
from dataclasses import is_dataclass, replace

import numpy as np
import pytest
from matplotlib.figure import Figure

import sliplens as sl
from sliplens.codec import Result
from sliplens.report.plates import Plate, bright_pictures, write_plates
from sliplens.report.sections import table_scores
from sliplens.results.evaluation import Evaluation, Training
from sliplens.results.explanation import Strip, StripReadings
from sliplens.results.study import RECORDS, Study, UntrainedMaps, load_results

from .study_results import METHODS, SPEARMAN, Made, write_choice, write_faithfulness


@pytest.fixture(scope="module")
def results(pristine_study):
    return load_results(pristine_study)


def public_records(value: object) -> Iterator[Result]:
    """Records in a record or a mapping, itself included."""
    if isinstance(value, Result):
        yield value
    parts = value.values() if isinstance(value, dict) else vars(value).values() if is_dataclass(value) else ()
    for part in parts:
        yield from public_records(part)


def test_every_record_has_a_short_repr_a_table_and_a_figure(results, pristine_workspace):
    workspace = load_results(pristine_workspace)
    data = sl.simulate(dry_trials=3, wet_trials=0, days=2, frames_per_trial=20)
    untouched = UntrainedMaps(input="raw", source="simulated", maps={"grad-cam": np.ones((1, 8, 8), np.float32)})
    margins = {name: np.arange(2.0) for name in ("time_s", "safety_margin", "prediction", "low_90", "high_90")}
    readings = StripReadings(contact_state=np.array(["contact"] * 2), withheld=np.array(["", ""]), **margins)
    facts = {"trial": "t", "condition": "dry", "source": "real", "input": "pair", "method": "grad-cam"}
    maps = {"pictures": np.zeros((1, 8, 8, 3), np.uint8), "relevance": np.zeros((1, 8, 8), np.float32)}
    strip = Strip(readings=readings, shown=(0,), **facts, **maps)
    records = [*public_records(results), *public_records(workspace), data, data.load(data.trials[0]), untouched, strip]
    kinds = {type(record) for record in records}

    assert {*RECORDS.values(), Training, Evaluation, Strip, Study} <= kinds
    for record in {type(record): record for record in reversed(records)}.values():
        assert len(repr(record).splitlines()) <= 10, record
        assert max(map(len, repr(record).splitlines())) <= 280
        assert len(record.frame()) == record.to_arrow().num_rows > 0
        assert sl.plot(record).axes


def make_plate(rows: list[tuple] | None = None) -> Plate:
    figure = Figure(figsize=(2, 1), layout="constrained")
    figure.subplots().plot([0, 1])
    numbers = {"columns": ("name", "value"), "rows": rows or [("a", 1)]}
    return Plate(name="line", figure=figure, alt="A line that rises.", caption="A line.", **numbers)


def test_differences_are_brightened_by_one_factor_and_raw_frames_never(results):
    raw, difference = (results.explanations[name] for name in ("raw", "difference"))
    [_, untouched], title = bright_pictures(raw, [0, 3])
    np.testing.assert_array_equal(untouched, raw.pictures[3])
    assert title == "Input"
    # the frame of full stick alone is all but black
    [brighter], title = bright_pictures(difference, [0])
    factor = float(title.split("\N{NO-BREAK SPACE}")[1])
    assert factor > 1
    np.testing.assert_array_equal(brighter, np.minimum(np.round(np.float32(factor) * difference.pictures[0]), 255))
    # no change is mid-grey in signed differences: twice as bright it would be white
    assert bright_pictures(replace(difference, input="signed"), [0])[1] == "Input"


def test_the_truth_alone_is_a_figure(results):
    (ax,) = sl.plot(results.truth["raw"]).axes
    row = [label.get_text() for label in ax.get_yticklabels()].index("Poly-CAM")
    assert np.asarray(ax.lines[2 * row + 1].get_xdata()).item() == SPEARMAN["poly-cam"]
    assert ax.yaxis_inverted()  # the thesis's methods on top


def test_numbers_are_written_with_nine_digits_and_files_are_the_same_each_time(tmp_path):
    plates = [make_plate([("a", 1 / 3), ("b", 2.0)]) for _ in range(2)]
    (page, table), (again, _) = (
        write_plates([plate], tmp_path / name) for plate, name in zip(plates, "ab", strict=True)
    )
    with table.open(newline="") as stream:
        assert list(csv.reader(stream)) == [["name", "value"], ["a", "0.333333333"], ["b", "2"]]
    assert page.name == "line.pdf"
    assert page.read_bytes() == again.read_bytes()
    assert make_plate().uri == make_plate().uri


@pytest.mark.parametrize(("more", "beside"), [((), "Poly-CAM"), (("poly-cam-thesis",), "Poly-CAM as in the thesis")])
def test_the_thesis_stands_beside_its_own_poly_cam(tmp_path, rng, more, beside):
    made = Made(inputs=("raw",), methods=(*METHODS, *more))
    write_choice(tmp_path, made)
    write_faithfulness(tmp_path, "raw", made, rng=rng)
    table = table_scores("raw", load_results(tmp_path).faithfulness["raw"], None)
    scores = {row[0].text: row[2].text for row in table.rows}
    assert scores[beside] == "0.512 ± 0.203"
    assert list(scores.values()).count("0.512 ± 0.203") == 1
