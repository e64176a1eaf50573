import pytest
import torch
from torch import nn
from torchvision import models

from sliplens.errors import ModelError
from sliplens.explainers.cam import capture, find_layers
from sliplens.models import build_model

LAYERS = {
    "shufflenet_v2_x1_0": (
        ["conv1", *(f"stage{n}" for n in (2, 3, 4)), "conv5"],
        [24, 116, 232, 464, 1024],
        [112, 28, 14, 7, 7],
    ),
    "resnet18": (["relu", "layer1", "layer2", "layer3", "layer4"], [64, 64, 128, 256, 512], [112, 56, 28, 14, 7]),
    "mobilenet_v3_small": (
        [*(f"features.{number}" for number in (0, 1, 3, 6, 8, 11)), "features"],
        [16, 16, 24, 40, 48, 96, 576],
        [112, 56, 28, 14, 14, 7, 7],
    ),
    # the last map before each pooling
    "vgg11": ([f"features.{number}" for number in (1, 4, 9, 14, 19)], [64, 128, 256, 512, 512], [224, 112, 56, 28, 14]),
}
"""Layers of TorchVision's networks: names, channels and sides of the maps."""


@pytest.mark.parametrize("name", LAYERS)
def test_finds_the_last_map_of_each_resolution_and_width(name):
    with torch.device("meta"):  # shapes without arithmetic
        layers = find_layers(getattr(models, name)(weights=None), torch.zeros(1, 3, 224, 224))
    names, channels, sides = LAYERS[name]
    assert list(layers) == names
    assert list(layers.values()) == list(zip(channels, sides, sides, strict=True))


def test_looks_into_wrappers_and_blocks_that_shrink_repeatedly():
    class Backbone(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.one = nn.Conv2d(3, 4, 3, stride=2, padding=1)
            self.two = nn.Conv2d(4, 4, 3, stride=2, padding=1)

        def forward(self, images):
            return self.two(self.one(images))

    class Wrapper(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.net = nn.Sequential(Backbone(), nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(4, 1))

        def forward(self, images):
            return self.net(images)

    layers = find_layers(Wrapper(), torch.zeros(1, 3, 32, 32))
    assert list(layers) == ["net.0.one", "net.0.two"]


def test_maps_of_one_pixel_are_left_out(network, images):
    layers = find_layers(network("shufflenet"), images[..., :32, :32])
    assert list(layers) == ["conv1", "stage2", "stage3"]


def test_a_network_without_maps_is_refused():
    model = nn.Sequential(nn.Flatten(), nn.Linear(3 * 64, 1))
    with pytest.raises(ModelError, match="Sequential has no layer with a spatial map for images of 8 x 8 pixels"):
        find_layers(model, torch.zeros(1, 3, 8, 8))


def test_capture_keeps_what_an_in_place_activation_would_overwrite():
    convolution = nn.Conv2d(3, 4, 3)
    nn.init.constant_(convolution.weight, -1.0)
    model = nn.Sequential(convolution, nn.ReLU(inplace=True))
    with capture(model, ["0"]) as outputs:
        result = model(torch.ones(1, 3, 5, 5))
    assert bool((outputs["0"] < 0).all())
    assert bool((result == 0).all())


def test_a_head_that_answers_with_a_distribution_hides_no_layer():
    images = torch.zeros(1, 3, 64, 64)
    plain, wrapped = (find_layers(build_model(head=head).eval(), images) for head in ("point", "histogram"))
    assert {f"backbone.{name}": shape for name, shape in plain.items()} == wrapped
