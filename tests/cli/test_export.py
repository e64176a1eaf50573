"""`sliplens export`: what it writes, and what it refuses."""

import json
from pathlib import Path

import pytest
from command_line import typed

from sliplens.errors import InputError
from sliplens.extras import import_onnxruntime
from sliplens.files import RUN_FILE
from sliplens.recordings import Dataset
from sliplens.recordings.formats import open_captures
from sliplens.recordings.options import ReadOptions


def refused(message: str, *words: object) -> None:
    with pytest.raises(InputError, match=message):
        run(*words)


def run(*words: object) -> None:
    typed("export", *words)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_network_becomes_an_onnx_file(difference_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("onnxscript")
    output = tmp_path / "new" / "a.onnx"
    run("onnx", difference_run, "-o", output)
    assert "predicts as the network does" in capsys.readouterr().out
    assert names(tmp_path / "new") == ["a.onnx"]
    session = import_onnxruntime().InferenceSession(str(output), providers=["CPUExecutionProvider"])
    told = session.get_modelmeta().custom_metadata_map
    assert json.loads(told["sliplens.manifest"])["backbone"] == "shufflenet_v2_x1_0"
    before = output.read_bytes()
    refused(r"a\.onnx exists; choose another file or pass --overwrite", "onnx", difference_run, "-o", output)
    assert output.read_bytes() == before


@pytest.mark.parametrize("kind", ["lerobot", "mcap"])
def test_a_data_set_comes_back_from_other_formats(
    kind: str, small_dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    if kind == "mcap":
        pytest.importorskip("mcap")
        pytest.importorskip("rosbags")
    output = tmp_path / "out"
    chosen = ("--trials", "test-wet-7", "train-dry-1")
    run(kind, small_dataset.folder, "-o", output, *chosen)
    sources = [output] if kind == "lerobot" else [path for path in sorted(output.iterdir()) if path.suffix == ".mcap"]
    captures = [capture for path in sources for capture in open_captures(path, options=ReadOptions())]
    assert [len(capture) for capture in captures] == [small_dataset.find(trial).frames for trial in chosen[1:]]
    # nothing of ours where their readers look
    assert names(output) == (
        ["data", "meta"] if kind == "lerobot" else [RUN_FILE, "test-wet-7.mcap", "train-dry-1.mcap"]
    )
    record = json.loads(next(output.rglob(RUN_FILE)).read_text())
    assert record["config"]["data_hash"] == small_dataset.hash
    assert names(tmp_path) == ["out"]
    capsys.readouterr()
    run(kind, small_dataset.folder, "-o", output, *chosen)
    assert "kept" in capsys.readouterr().out
    refused("holds a result of other settings", kind, small_dataset.folder, "-o", output)
    run(kind, small_dataset.folder, "-o", output, "--trials", "test-dry-6", "--overwrite")
    assert "1 trial, 12 frames" in capsys.readouterr().out
    assert names(tmp_path) == ["out"]


def test_a_failure_leaves_nothing_behind(small_dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def fail(_data: Dataset, _trials: object, folder: Path) -> None:
        (folder / "half").write_text("")
        raise InputError("the disk is full")

    monkeypatch.setattr("sliplens.recordings.formats.lerobot_export.write_lerobot", fail)
    refused("the disk is full", "lerobot", small_dataset.folder, "-o", tmp_path / "out")
    assert not names(tmp_path)
