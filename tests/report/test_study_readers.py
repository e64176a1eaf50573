"""What a study saved is read whole, and refused in one sentence where it is malformed."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sliplens.errors import InputError
from sliplens.report import load_results

from .study_results import FILLS, METHODS


def change(path: Path, place: tuple, value: object) -> None:
    """Put a value into a JSON file, `place` keys and indices deep."""
    whole = json.loads(path.read_text(encoding="utf-8"))
    inside = whole
    for key in place[:-1]:
        inside = inside[key]
    inside[place[-1]] = value
    path.write_text(json.dumps(whole), encoding="utf-8")


def test_maps_of_real_touch_do_not_stand_for_the_studys_own(study):
    real = shutil.copytree(study / "explain-raw", study / "explain-real")
    change(real / "result.json", ("source",), "real")
    change(real / "run.json", ("finished",), "2026-11-22T00:00:00+00:00")

    results = load_results(study)

    assert set(results.explanations) == {("raw", "simulated"), ("raw", "real")}
    assert results.study.explanations["raw"].source == results.study.deletion["raw"].source == "simulated"


def test_curves_and_scores_tell_the_same(study):
    faithful = load_results(study).study.faithfulness["raw"]

    assert {key[:2] for key in faithful.curves} == set(FILLS)
    for score in faithful.scores:
        curve = faithful.curves[score.key]
        assert curve.most_first.shape == (18, 21)
        assert curve.symmetric_gain.mean() == pytest.approx(score.srg.estimate)


def test_rows_may_stand_in_any_order(study):
    path = study / "faithfulness-raw" / "table.parquet"
    before = load_results(study).study.faithfulness["raw"].curves
    table = pq.read_table(path)
    pq.write_table(table.take(np.random.default_rng(0).permutation(table.num_rows)), path)

    after = load_results(study).study.faithfulness["raw"].curves

    assert set(after) == set(before)
    for key, curve in after.items():
        assert curve.frame_ids == before[key].frame_ids
        np.testing.assert_array_equal(curve.clusters, before[key].clusters)
        np.testing.assert_array_equal(curve.least_first, before[key].least_first)


def test_markers_keep_their_places(study):
    states = load_results(study).study.states

    assert states is not None
    assert len(states.markers) == 6
    for frame in states.markers.values():
        assert frame.rest_px.shape == frame.now_px.shape == (36, 2)
        # one marker was not followed
        assert np.isnan(frame.now_px[0]).all()
        assert np.isfinite(frame.now_px[1:]).all()


def test_null_is_unknown(study):
    change(study / "map-quality-raw" / "result.json", ("methods", "poly-cam", "resolution"), None)
    change(study / "truth-raw" / "result.json", ("shapley_against_margin",), None)
    change(study / "truth-raw" / "result.json", ("methods", "poly-cam", "margin"), None)
    change(study / "randomisation-raw" / "result.json", ("methods", "poly-cam", "similarity", 1), None)

    found = load_results(study).study

    assert found.map_quality["raw"].methods["poly-cam"].resolution is None
    assert found.truth["raw"].shapley_against_margin is None
    assert found.truth["raw"].methods["poly-cam"].margin is None
    assert found.randomisation["raw"].methods["poly-cam"].similarity[1] is None


@pytest.mark.parametrize(
    ("file", "place", "value", "message"),
    [
        ("choice", ("trials", 0, "qualified"), "yes", r"expected `bool`, got `str` at trials\[0\].qualified"),
        ("choice", ("summary",), None, r"choice/result.json .*expected `str`, got `null` at summary"),
        ("faithfulness-raw", ("scores", 0, "srg"), 0.1, r"expected `object`, got `float` at scores\[0\].srg"),
        (
            "faithfulness-raw",
            ("scores", 0, "srg", "low"),
            "x",
            r"expected `float \| null`, got `str` at scores\[0\].srg.low",
        ),
        ("faithfulness-raw", ("scores", 0, "method"), "none", r"lacks the curves of reference / pixel / none"),
        ("score-raw", ("methods", "none"), {"mean": 0, "sd": 0, "last_step_mean": 0, "frames": 1}, r"curves of none"),
        ("randomisation-raw", ("methods", "poly-cam", "layers"), [1], r"has 1 layers but 4 similarities"),
        ("randomisation-raw", ("methods", "poly-cam", "similarity"), 1, r"expected `array`, got `int`"),
        ("map-quality-raw", ("methods", "poly-cam", "resolution"), "much", r"expected `float \| null`, got `str`"),
        ("timing-raw", ("methods", "poly-cam", "seconds"), None, r"expected `float`, got `null`"),
        ("truth-raw", ("areas",), [], r"expected `object`, got `array` at areas"),
        ("truth-raw", ("meta", 0, "fill"), 1, r"expected `str`, got `int` at meta\[0\].fill"),
    ],
)
def test_malformed_fields_are_told_in_one_sentence(study, file, place, value, message):
    change(study / file / "result.json", place, value)

    with pytest.raises(InputError, match=message) as caught:
        load_results(study)

    assert "\n" not in str(caught.value)
    assert re.search("again with `sliplens (study|score)`", str(caught.value))


@pytest.mark.parametrize(
    ("file", "message"),
    [
        ("faithfulness-raw/table.parquet", r"table.parquet does not exist"),
        ("truth-raw/effects.parquet", r"effects.parquet does not exist"),
        ("truth-raw/arrays.npz", r"arrays.npz does not exist"),
        ("states/table.parquet", r"table.parquet does not exist"),
    ],
)
def test_missing_files_are_told(study, file, message):
    (study / file).unlink()

    with pytest.raises(InputError, match=message):
        load_results(study)


def test_a_curve_without_all_its_areas_is_told(study):
    path = study / "faithfulness-raw" / "table.parquet"
    pq.write_table(pq.read_table(path).slice(1), path)

    with pytest.raises(InputError, match=r"lacks areas of some frames under reference / pixel / grad-cam"):
        load_results(study)


def test_maps_of_other_frames_are_told(study):
    maps = np.zeros((2, 4, 4), dtype=np.float32)
    np.savez(
        study / "truth-raw" / "arrays.npz", allow_pickle=False, shapley_maps=maps, network_maps=maps, margin_maps=maps
    )

    with pytest.raises(InputError, match=r"holds maps of shape \(2, 4, 4\) where 18 finite ones belong"):
        load_results(study)


def test_methods_unknown_to_the_report_are_kept(study):
    path = study / "faithfulness-raw" / "table.parquet"
    table = pq.read_table(path)
    own = table.filter(pa.array([name == "poly-cam" for name in table["method"].to_pylist()]))
    named = own.set_column(own.column_names.index("method"), "method", pa.array(["my-cam"] * own.num_rows))
    pq.write_table(pa.concat_tables([table, named]), path)

    curves = load_results(study).study.faithfulness["raw"].curves

    assert {method for _, _, method in curves} >= {*METHODS, "my-cam"}
