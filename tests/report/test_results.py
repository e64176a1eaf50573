"""What a workspace holds is loaded whole, and refused in one sentence where it is malformed."""

import shutil
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from sliplens.errors import InputError
from sliplens.report import load_results

from .study_results import edit


def change(path: Path, **fields):
    edit(path, lambda value: value.update(fields))


def test_every_stage_is_found_whatever_its_folder_is_called(workspace):
    for index, folder in enumerate(sorted(workspace.iterdir())):
        folder.rename(workspace / f"any name {index}")

    results = load_results(workspace)

    assert set(results.trainings) == set(results.evaluations) == {"raw", "difference"}
    assert set(results.explanations) == set(results.real) == set(results.deletion) == {"raw", "difference"}
    assert results.notes == ()


def test_hidden_and_foreign_folders_are_passed_over(workspace):
    (workspace / ".test-raw.partial").mkdir()
    (workspace / ".test-raw.partial" / "run.json").write_text("{}")
    (workspace / "notes").mkdir()
    other = workspace / "other"
    other.mkdir()
    (other / "run.json").write_bytes((workspace / "data" / "run.json").read_bytes())
    change(other / "run.json", stage="export")

    assert [run.stage for run in load_results(workspace).runs.values()].count("export") == 1


def test_of_two_results_of_one_kind_the_later_is_kept_and_said(workspace):
    folder = workspace / "test-raw"
    later = workspace / "a-later-one"
    later.mkdir()
    for path in folder.iterdir():
        (later / path.name).write_bytes(path.read_bytes())
    change(later / "run.json", finished="2026-11-22T00:00:00+00:00")

    results = load_results(workspace)

    assert len(results.notes) == 1
    assert "a-later-one" in results.notes[0]
    assert "test-raw" in results.notes[0]


def test_a_workspace_without_a_result_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"holds no result to report; run `sliplens simulate`"):
        load_results(tmp_path)
    with pytest.raises(InputError, match=r"the workspace .*nowhere does not exist; check the path"):
        load_results(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("test-raw", "{", r"test-raw/result.json is not valid JSON"),
        ("network-raw", '{"input": 3}', r"Expected `str`, got `int` - at `\$\.input`.*`sliplens train`"),
        ("maps-raw-real", '{"input": "raw", "frames": 3}', r"is not what was written \(.*make it again with"),
        ("score-raw", '{"input": "raw", "source": "simulated"}', r"missing required field `fill`.*`sliplens score`"),
    ],
)
def test_a_malformed_result_is_refused_in_one_sentence(workspace, file, text, message):
    (workspace / file / "result.json").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        load_results(workspace)
    assert "\n" not in str(caught.value)


def test_maps_of_real_touch_do_not_stand_for_the_studys_own(study):
    real = shutil.copytree(study / "explain-raw", study / "explain-real")
    change(real / "result.json", source="real")
    change(real / "run.json", finished="2026-11-22T00:00:00+00:00")

    results = load_results(study)

    assert set(results.real) == {"raw"}
    assert results.explanations["raw"].source == results.deletion["raw"].source == "simulated"


def test_rows_may_stand_in_any_order(study):
    path = study / "faithfulness-raw" / "table.parquet"
    before = load_results(study).faithfulness["raw"].curves
    table = pq.read_table(path)
    pq.write_table(table.take(np.random.default_rng(0).permutation(table.num_rows)), path)

    after = load_results(study).faithfulness["raw"].curves

    assert set(after) == set(before)
    for key, curve in after.items():
        assert curve.frame_ids == before[key].frame_ids
        np.testing.assert_array_equal(curve.clusters, before[key].clusters)
        np.testing.assert_array_equal(curve.least_first, before[key].least_first)


def test_markers_keep_their_places(study):
    states = load_results(study).states

    assert states is not None
    assert len(states.markers) == 6
    for markers in states.markers.values():
        np.testing.assert_array_equal(markers.marker, np.arange(36))
        # one marker was not followed
        np.testing.assert_array_equal(np.isnan(markers.x_px), np.arange(36) == 0)
