"""Networks and images to explain."""

import copy
from collections.abc import Callable
from functools import cache
from itertools import pairwise

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional
from torchvision import models

from sliplens.explainers.gradients import IntegratedGradients

SIZE = 64


class GapNet(nn.Module):
    """Two convolutions, functional pooling, and one linear output on the mean over space."""

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Conv2d(3, 6, 3, stride=2, padding=1)
        self.second = nn.Conv2d(6, 8, 3, stride=2, padding=1)
        self.fc = nn.Linear(8, 1)

    def forward(self, images: Tensor) -> Tensor:
        features = self.second(torch.relu(self.first(images)))
        return self.fc(features.mean(dim=(2, 3)))[:, 0]


class Vgg(nn.Module):
    """The layers of VGG-11, a quarter as wide, and one linear output on the mean over space."""

    def __init__(self, features: nn.Sequential) -> None:
        super().__init__()
        self.features = features
        self.classifier = nn.Linear(128, 1)

    def forward(self, images: Tensor) -> Tensor:
        return self.classifier(self.features(images).mean(dim=(2, 3)))


def blobs(count: int, *, seed: int, size: int = SIZE) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(count, 3, 8, 8, generator=generator, dtype=torch.float64)
    return functional.interpolate(coarse, size=(size, size), mode="bilinear")


def as_trained(network: nn.Module, head: nn.Linear, *, count: int = 32) -> nn.Module:
    """Give an untrained network what training gives: matching statistics, and outputs that spread over [0, 1]."""
    network.double().train()
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.momentum = None  # a plain average over the batches
    images = blobs(count, seed=1)
    with torch.no_grad():
        network(images)
        network.eval()
        outputs = network(images)
        head.weight.div_(outputs.std() / 0.25)
        head.bias.zero_()
        head.bias.fill_(0.5 - float(network(images).mean()))
    return network


def shufflenet(network: models.ShuffleNetV2) -> nn.Module:
    network.fc = nn.Linear(network.fc.in_features, 1)
    return as_trained(network, network.fc)


def mobilenet() -> nn.Module:
    network = models.mobilenet_v3_small(weights=None)
    head = nn.Linear(1024, 1)
    network.classifier[3] = head
    return as_trained(network, head)


def resnet() -> nn.Module:
    network = models.resnet18(weights=None, num_classes=1)
    return as_trained(network, network.fc, count=4)


def vgg() -> nn.Module:
    # TorchVision's has 9 million weights in its layers, and 120 million in its classifier
    features: list[nn.Module]
    features = [nn.Conv2d(3, 16, 3, padding=1), nn.ReLU(inplace=True), nn.MaxPool2d(2)]
    for inputs, *outputs in ((16, 32), (32, 64, 64), (64, 128, 128), (128, 128, 128)):
        for before, width in pairwise((inputs, *outputs)):
            features += [nn.Conv2d(before, width, 3, padding=1), nn.ReLU(inplace=True)]
        features.append(nn.MaxPool2d(2))
    network = Vgg(nn.Sequential(*features))
    return as_trained(network, network.classifier, count=4)


def gap() -> nn.Module:
    network = GapNet()
    return as_trained(network, network.fc)


NETWORKS: dict[str, Callable[[], nn.Module]] = {
    "shufflenet": lambda: shufflenet(models.shufflenet_v2_x1_0(weights=None)),
    "small shufflenet": lambda: shufflenet(models.ShuffleNetV2([1, 1, 1], [8, 8, 16, 16, 24])),
    "mobilenet": mobilenet,  # its maps have both signs
    "resnet": resnet,
    "vgg": vgg,
    "gap": gap,
}


@pytest.fixture(scope="session")
def network() -> Callable[[str], nn.Module]:
    """Make a fresh network of `NETWORKS` in float64, with the outputs of a trained one."""

    @cache
    def made(name: str) -> nn.Module:
        with torch.random.fork_rng():
            torch.manual_seed(20261121)
            return NETWORKS[name]()

    return lambda name: copy.deepcopy(made(name))


@pytest.fixture
def images() -> Tensor:
    """Three images on which the networks' outputs differ."""
    return blobs(3, seed=2)


@pytest.fixture
def reference() -> Tensor:
    """An image to compare with, (3, height, width)."""
    return blobs(1, seed=3)[0]


@pytest.fixture
def short_guess(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first guess of Shapley values in few steps: of a network as rough as an untrained one it would take most."""
    short = IntegratedGradients(steps=4, max_steps=8)
    monkeypatch.setattr("sliplens.explainers.shapley.IntegratedGradients", lambda: short)
