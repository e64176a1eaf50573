import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

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
        ("maps-raw-real", '{"input": "raw", "frames": 3}', r"is not what was written: .* make it again with"),
        ("score-raw", '{"input": "raw", "source": "simulated"}', r"missing required field `fill`.*`sliplens score`"),
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
        ("maps-raw-real/arrays.npz", r"arrays.npz does not exist; .*`sliplens explain`"),
        ("score-raw/table.parquet", r"table.parquet does not exist; .*`sliplens score`"),
    ],
)
def test_missing_file_is_told(workspace, name, message):
    (workspace / name).unlink()

    with pytest.raises(InputError, match=message):
        load_results(workspace)


def test_curves_with_a_missing_step_are_told(workspace):
    path = workspace / "score-raw" / "table.parquet"
    pq.write_table(pq.read_table(path).slice(1), path)

    with pytest.raises(InputError, match=r"lacks steps of some frames under 'grad-cam'"):
        load_results(workspace)


def change_arrays(workspace: Path, **arrays: np.ndarray) -> None:
    path = workspace / "maps-raw-real" / "arrays.npz"
    np.savez(path, allow_pickle=False, **(dict(np.load(path)) | arrays))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (
            {"relevance/grad-cam": np.zeros((6, 12, 12))},
            r"holds float64 of shape \(6, 12, 12\) as 'relevance/grad-cam'",
        ),
        ({"relevance/grad-cam": np.zeros((5, 24, 24), np.float32)}, r"holds float32 of shape \(5, 24, 24\) as"),
        ({"images": np.zeros((6, 3, 20, 20), np.uint8)}, r"of shape \(6, 3, 24, 24\) as 'references' where UInt8"),
    ],
)
def test_arrays_that_do_not_fit_their_frames_are_told(workspace, arrays, message):
    change_arrays(workspace, **arrays)

    with pytest.raises(InputError, match=message):
        load_results(workspace)


def test_a_method_without_maps_is_told(workspace):
    path = workspace / "maps-raw-real" / "arrays.npz"
    np.savez(path, allow_pickle=False, **{k: v for k, v in np.load(path).items() if k != "relevance/grad-cam"})

    with pytest.raises(InputError, match=r"holds no relevance of grad-cam; make it again with `sliplens explain`"):
        load_results(workspace)


def test_missing_folder_is_told(tmp_path):
    with pytest.raises(InputError, match=r"the workspace .*nowhere does not exist; check the path"):
        load_results(tmp_path / "nowhere")
