"""Engines: all answer alike, and say why where they cannot."""

import os
import subprocess
import sys
from pathlib import Path
from threading import Thread

import numpy as np
import pytest
import torch
from there import there
from torch import Tensor, nn
from torch.nn import functional

from sliplens.errors import InputError, ModelError
from sliplens.models import Manifest, Network, load
from sliplens.models.backbones import Answers, HistogramRegressor, answer_names
from sliplens.models.engines import ENGINES, fold_batch_norm, make_engine
from sliplens.models.novelty import read_features
from sliplens.models.onnx import export_onnx

ATOL = 1e-4  # float32 sums in another order, through some 60 layers


def skip_without(name: str) -> None:
    obstacle = ENGINES[name].obstacle(torch.device("cpu"))
    if obstacle:
        pytest.skip(obstacle)


def small_network(*, head: str) -> Network:
    """Seconds to compile: a convolution, batch normalisation and a linear layer."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        outputs = 60 if head == "histogram" else 1
        model = nn.Sequential(
            nn.Conv2d(3, 4, 3),
            nn.BatchNorm2d(4, momentum=None),
            nn.ReLU(),
            nn.AdaptiveAvgPool2d(1),
            nn.Flatten(),
            nn.Linear(4, outputs),
        )
        model.train()(functional.interpolate(torch.rand(16, 3, 4, 4) ** 2, size=(32, 32), mode="bilinear"))
        torch.nn.init.normal_(model[-1].get_parameter("weight"), std=10)
    whole = HistogramRegressor(model) if head == "histogram" else model
    manifest = Manifest(backbone="small", input="raw", image_size=32, frame_size=(32, 32), sensor="", data_hash="")
    return Network(model=whole.eval(), manifest=manifest)


def assert_alike(name: str, trained: Network, images: Tensor, *, onnx_file: Path | None = None) -> None:
    engine, eager = make_engine(name, trained, onnx_file=onnx_file), make_engine("eager", trained)
    assert eager.estimate(trained, images).margin.std() > 100 * ATOL  # else nothing would be shown
    for batch in (images, images[:1], torch.cat([images] * 4)):
        found, expected = engine.estimate(trained, batch), eager.estimate(trained, batch)
        np.testing.assert_allclose(found.margin, expected.margin, atol=ATOL, rtol=ATOL)
        assert found.calibration == expected.calibration
        if expected.probabilities is None:
            assert found.probabilities is None
            continue
        np.testing.assert_allclose(there(found.probabilities), expected.probabilities, atol=ATOL)
        np.testing.assert_array_equal(found.edges, expected.edges)


@pytest.mark.parametrize("head", ["point", "histogram", "margin-and-ratio"])
def test_eager_answers_as_the_network(head: str, networks: dict[str, Network], images: Tensor):
    found = make_engine("eager", networks[head]).estimate(networks[head], images)
    expected = networks[head].estimate(images)
    # the same operations on the same numbers
    np.testing.assert_allclose(found.margin, expected.margin, atol=1e-6)
    if head == "histogram":
        np.testing.assert_allclose(there(found.sigma), there(expected.sigma), atol=1e-6)


@pytest.mark.parametrize("head", ["point", "histogram", "margin-and-ratio"])
def test_folded_answers_as_eager(head: str, networks: dict[str, Network], images: Tensor):
    assert_alike("folded", networks[head], images)


@pytest.mark.parametrize("head", ["point", "histogram", "margin-and-ratio"])
@pytest.mark.parametrize("name", ["onnxruntime", "openvino"])
def test_engines_of_onnx_files_answer_as_eager(
    name: str, head: str, networks: dict[str, Network], onnx_files: dict[str, Path], images: Tensor
):
    skip_without(name)
    assert_alike(name, networks[head], images, onnx_file=onnx_files[head])


@pytest.mark.parametrize("name", ["onnxruntime", "openvino"])
def test_without_a_file_the_network_is_exported_on_the_fly(name: str, images: Tensor):
    skip_without(name)
    assert_alike(name, small_network(head="histogram"), images)


def test_compiled_answers_as_eager(images: Tensor):
    skip_without("compiled")
    assert_alike("compiled", small_network(head="histogram"), images)


def test_answers_of_a_call_outlive_the_next(networks: dict[str, Network], onnx_files: dict[str, Path], images):
    for name in ("onnxruntime", "openvino"):
        skip_without(name)
        engine = make_engine(name, networks["histogram"], onnx_file=onnx_files["histogram"])
        first = engine.estimate(networks["histogram"], images)
        before = first.margin.copy()
        engine.estimate(networks["histogram"], torch.zeros_like(images))
        np.testing.assert_array_equal(first.margin, before)


def test_folding_leaves_no_batch_normalisation_and_the_network_as_it_was(networks: dict[str, Network]):
    for trained in networks.values():
        before = {name: value.clone() for name, value in trained.model.state_dict().items()}
        folded = fold_batch_norm(trained.model)
        assert not [one for one in folded.modules() if isinstance(one, nn.BatchNorm2d)]
        assert [one for one in trained.model.modules() if isinstance(one, nn.BatchNorm2d)]
        for name, value in trained.model.state_dict().items():
            assert torch.equal(value, before[name])


def test_features_come_with_the_answers_by_every_engine():
    trained = load("chromatouch-pair")
    novelty = there(trained.novelty)
    images = torch.rand(5, 6, 112, 112, generator=torch.Generator().manual_seed(0))
    features = read_features(trained.model, novelty.layer, images)
    folded = fold_batch_norm(Answers(trained.model, novelty.layer))
    assert not [one for one in folded.get_submodule("watched").modules() if isinstance(one, nn.BatchNorm2d)]
    for name in ("eager", "folded", "onnxruntime", "openvino"):
        if ENGINES[name].obstacle(torch.device("cpu")) is None:
            [answers] = make_engine(name, trained, batch_size=8).answers([images])
            assert len(answers) == len(answer_names(trained.model, novelty.layer)) == 4
            np.testing.assert_allclose(answers[-1], features, atol=ATOL)


def test_a_network_that_cannot_be_traced_is_run_as_it_is(images: Tensor):
    class Branches(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.inner = small_network(head="point").model

        def forward(self, images: Tensor) -> Tensor:
            return self.inner(images) if images.sum() > 0 else self.inner(-images)

    model = Branches().eval()
    with torch.no_grad():
        assert torch.equal(fold_batch_norm(model)(images), model(images))


def test_a_network_that_another_thread_runs_while_one_is_folded_answers_as_before(images: Tensor):
    other, answers = small_network(head="point").model, []

    class Meanwhile(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.inner = small_network(head="point").model

        def forward(self, images: Tensor) -> Tensor:
            elsewhere = Thread(target=lambda: answers.append(other(some)))  # no proxy: numbers of its own
            elsewhere.start()
            elsewhere.join()
            return self.inner(images)

    some = images
    folded = fold_batch_norm(Meanwhile().eval())
    torch.testing.assert_close(answers[0], other(images))
    assert not [one for one in folded.modules() if isinstance(one, nn.BatchNorm2d)]


def test_an_unknown_engine_is_refused(networks: dict[str, Network]):
    with pytest.raises(InputError, match="no engine named 'tensorrt'; choose one of eager, folded, compiled,"):
        make_engine("tensorrt", networks["point"])


def test_a_missing_package_is_told(networks: dict[str, Network], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("sliplens.extras.find_spec", lambda name: None if name == "openvino" else name)
    with pytest.raises(InputError, match=r"needs openvino, which is not .* `pip install \"sliplens\[openvino\]\"`"):
        make_engine("openvino", networks["point"])


def test_a_missing_compiler_is_told(networks: dict[str, Network], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    with pytest.raises(InputError, match="needs a C\\+\\+ compiler and there is none"):
        make_engine("compiled", networks["point"])


def test_a_file_of_another_network_is_refused(networks: dict[str, Network], onnx_files: dict[str, Path]):
    with pytest.raises(InputError, match="holds another network"):
        make_engine("onnxruntime", networks["point"], onnx_file=onnx_files["histogram"])


def test_a_file_that_tells_less_than_the_network_is_refused(tmp_path: Path):
    onnx = pytest.importorskip("onnx")
    trained = load("chromatouch-pair")
    model = onnx.load(export_onnx(trained, tmp_path / "a.onnx"))
    assert [one.name for one in model.graph.output] == ["margin", "probabilities", "ratio_probabilities", "features"]
    del model.graph.output[-1]
    onnx.save(model, tmp_path / "b.onnx")
    with pytest.raises(InputError, match=r"b\.onnx does not tell features, as an older export; export the run again$"):
        make_engine("onnxruntime", trained, onnx_file=tmp_path / "b.onnx")


def test_a_damaged_file_is_told(networks: dict[str, Network], onnx_files: dict[str, Path], tmp_path: Path):
    onnx = pytest.importorskip("onnx")
    model = onnx.load(onnx_files["point"])
    del model.graph.node[3]
    onnx.save(model, tmp_path / "a.onnx")
    for name in ("onnxruntime", "openvino"):
        skip_without(name)
        with pytest.raises(ModelError, match=r"cannot run ShuffleNetV2 .*; export .*a\.onnx again$"):
            make_engine(name, networks["point"], onnx_file=tmp_path / "a.onnx")


def test_the_fastest_engine_is_that_which_pays(monkeypatch: pytest.MonkeyPatch):
    hidden: set[str] = set()
    monkeypatch.setattr("sliplens.extras.find_spec", lambda name: None if name in hidden else name)

    def chosen(frames: int) -> str:
        return make_engine("auto", small_network(head="point"), frames=frames).name

    assert chosen(10) == "eager"
    # a conversion takes longer than to predict a few frames
    assert chosen(1000) == "folded"
    assert chosen(100_000) == "openvino"
    hidden.add("openvino")
    assert chosen(100_000) == "onnxruntime"
    hidden.add("onnxscript")
    assert chosen(100_000) == "folded"


def test_a_file_that_was_made_before_pays_at_once(networks: dict[str, Network], onnx_files: dict[str, Path]):
    skip_without("openvino")
    assert make_engine("auto", networks["point"], frames=1, onnx_file=onnx_files["point"]).name == "openvino"


def test_nothing_is_reported_to_anybody(tmp_path: Path):
    """Both libraries keep an identifier below the home folder when they report."""
    skip_without("openvino")
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


def test_frames_that_were_read_before_choose_no_engine():
    trained = small_network(head="histogram")
    assert [make_engine("auto", trained, frames=40).name for _ in range(4)] == ["eager"] * 4


def test_folded_gives_the_same_bits_on_any_number_of_threads():
    trained = load("chromatouch-difference")  # small ones have no layer whose sums threads would share
    images = torch.rand(19, 3, 224, 224, generator=torch.Generator().manual_seed(0))
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            engine = make_engine("folded", trained, batch_size=8)
            found.append(engine.estimate(trained, images).margin.tobytes())
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    assert found[1:] == found[:1] * 2
