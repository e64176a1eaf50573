"""`sliplens export onnx`: what it writes, and what it refuses."""

import json
from pathlib import Path

import pytest
from command_line import typed

from sliplens.errors import InputError
from sliplens.extras import import_onnxruntime


def test_a_network_becomes_an_onnx_file(difference_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("onnxscript")
    output = tmp_path / "new" / "a.onnx"
    typed("export", "onnx", difference_run, "-o", output)
    assert "predicts as the network does" in capsys.readouterr().out
    assert [path.name for path in output.parent.iterdir()] == ["a.onnx"]
    session = import_onnxruntime().InferenceSession(str(output), providers=["CPUExecutionProvider"])
    told = session.get_modelmeta().custom_metadata_map
    assert json.loads(told["sliplens.manifest"])["backbone"] == "shufflenet_v2_x1_0"
    before = output.read_bytes()
    with pytest.raises(InputError, match=r"a\.onnx exists; choose another file or pass --overwrite"):
        typed("export", "onnx", difference_run, "-o", output)
    assert output.read_bytes() == before
