"""ONNX files: what they answer and tell, and that they appear right or not at all."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from small import network_of
from torch import Tensor, nn

from sliplens import __version__
from sliplens.errors import ModelError
from sliplens.extras import import_onnxruntime
from sliplens.files import to_builtins
from sliplens.models import Network
from sliplens.models import onnx as onnx_file
from sliplens.models.onnx import difference, export_onnx

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxscript")
runtime = import_onnxruntime()

HEADS = ("point", "histogram")


class Brightness(nn.Module):
    """The least network there is."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.tensor(1.0))

    def forward(self, images: Tensor) -> Tensor:
        return self.scale * images.mean(dim=(1, 2, 3))[:, None]


@pytest.fixture
def least() -> Network:
    return network_of(Brightness(), input="raw", image_size=8)


def run(path: Path, images: Tensor) -> list[np.ndarray]:
    session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    return session.run(None, {"image": images.numpy()})


@pytest.mark.parametrize("head", HEADS)
def test_the_file_is_valid_and_tells_how_to_feed_it(
    head: str, onnx_files: dict[str, Path], networks: dict[str, Network]
):
    model = onnx.load(onnx_files[head])
    onnx.checker.check_model(model, full_check=True)
    assert [(one.domain, one.version) for one in model.opset_import] == [("", 18)]
    assert (model.producer_name, model.producer_version) == ("sliplens", __version__)
    shapes = {
        value.name: [dim.dim_param or dim.dim_value for dim in value.type.tensor_type.shape.dim]
        for value in (*model.graph.input, *model.graph.output)
    }
    assert shapes == {
        "image": ["batch", 3, 32, 32],
        "margin": ["batch"],
        **({"probabilities": ["batch", 60]} if head == "histogram" else {}),
    }
    told = {item.key: json.loads(item.value) for item in model.metadata_props}
    assert told["sliplens.manifest"] == json.loads(json.dumps(to_builtins(networks[head].manifest)))
    assert told["sliplens.input"]["encoding"] == "difference"
    assert told["sliplens.input"]["image_size"] == 32
    edges = told["sliplens.output"]["bin_edges"]
    if head == "histogram":
        # 60 bins from -0.1 to 1.1; kept as float32
        np.testing.assert_allclose(edges, np.linspace(-0.1, 1.1, 61), atol=1e-6)
    else:
        assert edges is None


def test_a_network_that_answers_otherwise_is_refused(least: Network, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "a.onnx"
    path.write_text("the last good one")
    monkeypatch.setattr(onnx_file, "difference", lambda values, expected: difference(values + 1e-3, expected))
    with pytest.raises(ModelError, match=r"predictions differ by 0\.001, 0\.0001 is allowed"):
        export_onnx(least, path, overwrite=True)
    assert path.read_text() == "the last good one"
    assert len(list(tmp_path.iterdir())) == 1
