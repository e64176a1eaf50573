"""Networks that are not trained, but whose batch normalisation has seen images."""

from pathlib import Path

import pytest
import torch
from small import CALIBRATION, IMAGE_SIZE, TRACTION, save_untrained
from torch import Tensor, nn
from torch.nn import functional

from sliplens.models import Network, load
from sliplens.models.backbones import HistogramRegressor
from sliplens.models.onnx import export_onnx

HEADS = ("point", "histogram", "margin-and-ratio")


def some_images(count: int, *, seed: int) -> Tensor:
    """Coloured clouds: unlike noise, each gives a network another answer."""
    colours = torch.rand(count, 3, 4, 4, generator=torch.Generator().manual_seed(seed)) ** 2
    return functional.interpolate(colours, size=(IMAGE_SIZE, IMAGE_SIZE), mode="bilinear")


@torch.no_grad()
def awaken(model: nn.Module) -> None:
    """Give a network at its beginning statistics and answers that vary, else a mistake would hardly be seen."""
    network = model.backbone if isinstance(model, HistogramRegressor) else model
    for one in network.modules():
        if isinstance(one, nn.BatchNorm2d):
            one.momentum = None  # the true statistics; a few steps towards them would let the signal die
    for seed in range(3):
        network.train()(some_images(16, seed=seed))
    last = [one for one in network.eval().modules() if isinstance(one, nn.Linear)][-1]
    spread = network(some_images(64, seed=3)).std(dim=0, keepdim=True).T
    last.weight.mul_(1 / spread)
    last.bias.mul_(1 / spread[:, 0])


def save_run(folder: Path, *, head: str, kind: str = "difference") -> Path:
    calibration, traction = None if head == "point" else CALIBRATION, TRACTION if head == "margin-and-ratio" else None
    return save_untrained(
        folder, head=head, kind=kind, seed=5, calibration=calibration, traction=traction, prepare=awaken
    )


@pytest.fixture(scope="session")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A run for each head."""
    return {head: save_run(tmp_path_factory.mktemp(head), head=head) for head in HEADS}


@pytest.fixture(scope="session")
def networks(runs: dict[str, Path]) -> dict[str, Network]:
    return {head: load(folder) for head, folder in runs.items()}


@pytest.fixture(scope="session")
def images() -> Tensor:
    """Five images, to which the networks give five answers."""
    return some_images(5, seed=9)


@pytest.fixture(scope="session")
def onnx_files(networks: dict[str, Network], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Each network as it is exported, once."""
    pytest.importorskip("onnxscript")
    folder = tmp_path_factory.mktemp("onnx")
    for head, trained in networks.items():
        export_onnx(trained, folder / f"{head}.onnx")
    return {head: folder / f"{head}.onnx" for head in networks}
