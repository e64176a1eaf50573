"""Engines: each predicts the same as the network itself, or is not used."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from sliplens.errors import InputError, ModelError
from sliplens.models import Network, load
from sliplens.models.backbones import answer_names
from sliplens.models.engines import ENGINES, Engine, expecting, make_engine, prepare

ATOL = 1e-4  # float32 sums in another order, through some 60 layers


@pytest.fixture(params=ENGINES)
def name(request: pytest.FixtureRequest) -> str:
    if request.param == "openvino":
        pytest.importorskip("openvino")
    return request.param


@pytest.fixture
def tiny() -> nn.Module:
    """A convolution, batch normalisation and a linear layer: milliseconds to convert."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        layers = (nn.Conv2d(3, 4, 3), nn.BatchNorm2d(4), nn.ReLU(), nn.AdaptiveAvgPool2d(1), nn.Flatten())
        return nn.Sequential(*layers, nn.Linear(4, 1)).eval().requires_grad_(requires_grad=False)


def make(model: nn.Module, images: Tensor, *, engine: str = "auto", passes: int = 10_000) -> Engine:
    return prepare(model, images, passes=passes, engine=engine, batch_size=2)


@pytest.mark.parametrize("head", ["point", "histogram", "margin-and-ratio"])
def test_an_engine_predicts_the_same_as_the_network(name: str, head: str, networks: dict[str, Network], images: Tensor):
    network = networks[head]
    engine = make_engine(name, network)
    for batch in (images, images[:1], torch.cat([images] * 4)):
        estimate, expected = network.estimate(batch, engine=engine), network.estimate(batch)
        np.testing.assert_allclose(estimate.margin, expected.margin, atol=ATOL, rtol=ATOL)
        assert estimate.calibration == expected.calibration
        assert (estimate.probabilities is None) == (expected.probabilities is None)
        if estimate.probabilities is not None and expected.probabilities is not None:
            np.testing.assert_allclose(estimate.probabilities, expected.probabilities, atol=ATOL)
    assert network.estimate(images).margin.std() > 100 * ATOL  # else the comparison would show nothing


def test_predictions_come_in_the_order_of_the_batches(name: str, tiny: nn.Module, images: Tensor):
    batches = [images[:2], images[1:3], images[:1], images[3:], images[2:3]]  # short ones among them
    answers = list(make(tiny, images[:2], engine=name).run(iter(batches)))
    assert [len(answer) for answer in answers] == [2, 2, 1, 2, 1]
    with torch.no_grad():
        expected = torch.cat([tiny(batch).flatten() for batch in batches])
    torch.testing.assert_close(torch.cat(answers), expected, atol=1e-5, rtol=1e-5)


def test_features_come_with_the_predictions(name: str):
    network = load("chromatouch-pair")
    assert network.manifest.novelty is not None
    images = torch.rand(5, 6, 112, 112, generator=torch.Generator().manual_seed(0))
    features = network.answers([images])[-1].double().numpy()
    [answers] = make_engine(name, network, batch_size=8).answers([images])
    assert len(answers) == len(answer_names(network.model, network.feature_layer)) == 4
    np.testing.assert_allclose(answers[-1], features, atol=ATOL)


def test_auto_takes_openvino_where_its_conversion_pays(tiny: nn.Module, images: Tensor, monkeypatch):
    pytest.importorskip("openvino")
    assert make(tiny, images, passes=100).name == "torch"
    assert make(tiny, images, passes=100_000).name == "openvino"
    # a choice depends on the call alone, not on earlier ones
    assert make(tiny, images, passes=100).name == "torch"
    with expecting(100_000):
        assert make(tiny, images, passes=100).name == "openvino"
    monkeypatch.setattr("sliplens.extras.find_spec", lambda _: None)
    assert make(tiny, images, passes=100_000).name == "torch"


def test_new_weights_are_converted_anew(tiny: nn.Module, images: Tensor):
    pytest.importorskip("openvino")
    make(tiny, images, engine="openvino")
    tiny.get_parameter("5.weight").mul_(-1)
    answers = torch.cat(list(make(tiny, images, engine="openvino").run(images.split(2))))
    torch.testing.assert_close(answers, tiny(images).flatten(), atol=1e-5, rtol=1e-5)


class Branches(nn.Module):
    """A network whose graph depends on its input: a trace keeps the branch of the example, all zeros."""

    def __init__(self) -> None:
        super().__init__()
        self.maps = nn.Conv2d(3, 4, 3, stride=2)

    def forward(self, images: Tensor) -> Tensor:
        features = self.maps(images).mean(dim=(1, 2, 3))
        return 2 * features if float(images.sum()) > 0 else features


def test_an_engine_with_other_predictions_is_not_used(images: Tensor):
    pytest.importorskip("openvino")
    assert make(Branches(), images).name == "torch"
    with pytest.raises(ModelError, match=r"openvino cannot run Branches \(its predictions differ by .*; choose torch"):
        make(Branches(), images, engine="openvino")


def test_an_engine_that_is_not_there_is_refused_with_the_cure(networks: dict[str, Network], monkeypatch):
    with pytest.raises(InputError, match="no engine named 'tensorrt'; choose one of auto, torch, openvino"):
        make_engine("tensorrt", networks["point"])
    monkeypatch.setattr("sliplens.extras.find_spec", lambda name: None if name == "openvino" else name)
    with pytest.raises(InputError, match=r"needs openvino, which is not .* `pip install \"sliplens\[openvino\]\"`"):
        make_engine("openvino", networks["point"])


def test_nothing_is_reported_to_anybody(tmp_path: Path):
    """Both libraries keep an identifier below the home folder when they report."""
    pytest.importorskip("openvino")
    pytest.importorskip("onnxruntime")
    code = (
        "import sys, os, socket\n"
        "def refuse(*_): raise SystemExit('somebody was called')\n"
        "socket.socket.connect = socket.getaddrinfo = refuse\n"
        "from sliplens.extras import import_onnxruntime, import_openvino\n"
        "import_openvino().Core().available_devices\n"
        "import_onnxruntime().SessionOptions()\n"
        "assert os.environ['ORT_DISABLE_TELEMETRY'] == '1'\n"
        "assert not [name for name in sys.modules if name.startswith('openvino_telemetry')]\n"
    )
    unset = {"CI", "ORT_DISABLE_TELEMETRY", "XDG_CACHE_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME"}
    environment = {name: value for name, value in os.environ.items() if name not in unset}
    environment["HOME"] = str(tmp_path)
    done = subprocess.run([sys.executable, "-c", code], check=False, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not list(tmp_path.rglob("*"))
