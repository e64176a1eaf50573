"""The laws that depend on a network's parts, over four of TorchVision's."""

import copy
from itertools import islice

import pytest
import torch
from quick import QUICK, SHORT

from sliplens.explainers import poly_cam
from sliplens.explainers.cam import find_layers
from sliplens.explainers.poly_cam import PolyCam

pytestmark = pytest.mark.usefixtures("short_guess")
every_network = pytest.mark.parametrize("name", ["shufflenet", "resnet", "mobilenet", "vgg"])
# the thesis's level is one of ShuffleNetV2's layers
CHEAP = {name: explain for name, explain in QUICK.items() if name != "poly-cam-thesis"}


@every_network
def test_integrated_gradients_are_complete_or_say_so(name, network, images):
    explanation = SHORT(network(name).float(), images[:2].float())
    assert explanation.completeness_gap is not None
    for index in range(2):
        incomplete = bool(explanation.completeness_gap[index] > 0.01 * explanation.change[index].abs())
        told = any(f"image {index}: the map leaves" in text for text in explanation.warnings)
        assert told == incomplete


@every_network
def test_a_network_is_left_as_it_was_and_in_place_layers_do_no_harm(name, network, images, monkeypatch):
    # one small layer for Poly-CAM
    monkeypatch.setattr(poly_cam, "find_layers", lambda *batch: dict(islice(find_layers(*batch).items(), 1)))
    model = network(name).float().train()
    before = copy.deepcopy(model.state_dict())
    relevance = {}
    for method, explain in CHEAP.items():
        chosen = PolyCam(budget=0.3) if method == "poly-cam" else explain
        relevance[method] = chosen(model, images[:1].float()).relevance
        assert all(module.training for module in model.modules())
        assert all(parameter.requires_grad and parameter.grad is None for parameter in model.parameters())
        assert not any(module._forward_hooks or module._forward_pre_hooks for module in model.modules())
    for key, value in model.state_dict().items():
        assert torch.equal(value, before[key])
    for method, one in relevance.items():
        assert bool(one.isfinite().all()), method
        assert bool(one.any()), method
