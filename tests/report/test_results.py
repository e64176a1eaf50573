import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from sliplens.errors import InputError
from sliplens.report import load_results


def change(path: Path, **fields):
    value = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps(value | fields), encoding="utf-8")


def test_every_stage_is_found_whatever_its_folder_is_called(workspace):
    for index, folder in enumerate(sorted(workspace.iterdir())):
        folder.rename(workspace / f"any name {index}")

    results = load_results(workspace)

    assert results.simulation is not None
    assert set(results.trainings) == set(results.evaluations) == {"raw", "difference"}
    assert set(results.explanations) == {
        (name, source) for name in ("raw", "difference") for source in ("simulated", "real")
    }
    assert set(results.scores) == {("raw", "simulated"), ("difference", "simulated")}
    assert results.notes == ()


def test_arrays_have_one_row_a_frame(workspace):
    results = load_results(workspace)

    explained = results.explanations["raw", "simulated"]
    assert explained.pictures.shape == (12, 24, 24, 3)
    assert {one.shape for one in explained.saliency.values()} == {(12, 24, 24)}
    assert results.scores["raw", "simulated"].curves["random"].scores.shape == (12, 24)
    assert len(results.evaluations["raw"].predictions.trial) == 2 * 6 * 40


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


def test_repeated_random_orders_are_averaged(workspace):
    path = workspace / "score-raw" / "deletion.parquet"
    table = pq.read_table(path)
    shifted = table.set_column(table.column_names.index("score"), "score", pa.array(table["score"].to_numpy() + 0.5))
    before = load_results(workspace).scores["raw", "simulated"].curves["random"].scores
    pq.write_table(pa.concat_tables([table, shifted]), path)

    after = load_results(workspace).scores["raw", "simulated"].curves["random"].scores

    np.testing.assert_allclose(after, before + 0.25)


def test_missing_folder_is_told(tmp_path):
    with pytest.raises(InputError, match=r"the workspace .*nowhere does not exist; check the path"):
        load_results(tmp_path / "nowhere")


def test_workspace_without_result_is_told(tmp_path):
    with pytest.raises(InputError, match=r"holds no result to report; run `sliplens simulate`"):
        load_results(tmp_path)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("test-raw", "{", r"test-raw/result.json is not valid JSON"),
        (
            "test-raw",
            "[]",
            r"test-raw/result.json holds no JSON object; make it again with `sliplens evaluate`",
        ),
        ("test-raw", '{"input": "raw"}', r"test-raw/result.json .*missing required field `split`.*; make it again"),
        ("test-raw", '{"input": "raw", "conditions": NaN}', r"test-raw/result.json is not valid JSON"),
        ("network-raw", '{"input": 3}', r"expected `str`, got `int` at input; .*`sliplens train`"),
        ("network-raw", '{"input": "raw", "image_size": true}', r"expected `int`, got `bool` at image_size"),
        ("maps-raw-real", '{"input": "raw", "image_size": 24, "frames": []}', r"names no frame; explain some"),
        ("maps-raw-real", '{"input": "raw", "image_size": 24, "frames": 3}', r"has 3 as 'frames' where a list belongs"),
        ("score-raw", '{"input": "raw", "source": "simulated"}', r"lacks 'fill'; .*`sliplens score`"),
    ],
)
def test_malformed_result_is_told_in_one_sentence(workspace, name, text, message):
    (workspace / name / "result.json").write_text(text)

    with pytest.raises(InputError, match=message) as caught:
        load_results(workspace)

    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("test-raw/result.json", r"result.json does not exist"),
        ("test-raw/predictions.parquet", r"predictions.parquet does not exist; .*`sliplens evaluate`"),
        ("network-raw/curve.parquet", r"curve.parquet does not exist; .*`sliplens train`"),
        ("maps-raw-real/maps.npz", r"maps.npz does not exist; .*`sliplens explain`"),
        ("score-raw/deletion.parquet", r"deletion.parquet does not exist; .*`sliplens score`"),
    ],
)
def test_missing_file_is_told(workspace, name, message):
    (workspace / name).unlink()

    with pytest.raises(InputError, match=message):
        load_results(workspace)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("test-raw/predictions.parquet", r"is not a readable table"),
        ("network-raw/curve.parquet", r"is not a readable table"),
        ("maps-raw-real/maps.npz", r"cannot be read as maps"),
        ("score-raw/deletion.parquet", r"cannot be read as Parquet"),
        ("maps-raw-real/frames/real-dry-000-f000.png", r"cannot be read as an image"),
    ],
)
def test_damaged_file_is_told(workspace, name, message):
    (workspace / name).write_bytes(b"epoch,loss\n0,1\n")

    with pytest.raises(InputError, match=message):
        load_results(workspace)


def test_parquet_without_a_column_is_told(workspace):
    path = workspace / "test-raw" / "predictions.parquet"
    pq.write_table(pq.read_table(path).drop_columns(["prediction"]), path)

    with pytest.raises(InputError, match=r"lacks the column 'prediction'"):
        load_results(workspace)


def test_curves_with_a_missing_step_are_told(workspace):
    path = workspace / "score-raw" / "deletion.parquet"
    pq.write_table(pq.read_table(path).slice(1), path)

    with pytest.raises(InputError, match=r"lacks steps of some frames under 'grad-cam'"):
        load_results(workspace)


@pytest.mark.parametrize(
    ("maps", "message"),
    [
        ({}, r"holds no saliency of grad-cam, integrated-gradients, poly-cam"),
        ({"shape": (6, 12, 12)}, r"map 0 of 'grad-cam' has shape \(12, 12\) but its image is 24 x 24"),
        ({"shape": (5, 24, 24)}, r"where \(6, 24, 24\) belongs"),
        ({"shape": (6, 24, 24), "value": np.nan}, r"holds NaN or infinity in 576 of 576 pixels"),
    ],
)
def test_maps_that_do_not_fit_their_frames_are_told(workspace, maps, message):
    methods = ("grad-cam", "integrated-gradients", "poly-cam") if maps else ()
    arrays = {f"{name}.saliency": np.full(maps["shape"], maps.get("value", 0.5)) for name in methods}
    np.savez(workspace / "maps-raw-real" / "maps.npz", allow_pickle=False, **arrays)

    with pytest.raises(InputError, match=message):
        load_results(workspace)


def test_picture_of_another_size_is_told(workspace):
    path = workspace / "maps-raw-real" / "frames" / "real-dry-000-f000.png"
    Image.new("RGB", (10, 10)).save(path)

    with pytest.raises(InputError, match=r"is 10 x 10 pixels, 24 x 24 are needed"):
        load_results(workspace)


def test_frame_id_cannot_leave_its_folder(workspace):
    path = workspace / "maps-raw-real" / "result.json"
    value = json.loads(path.read_text())
    value["frames"][0]["id"] = "../../secret"
    path.write_text(json.dumps(value))

    with pytest.raises(InputError, match=r"'../../secret' in .* is no file name"):
        load_results(workspace)
