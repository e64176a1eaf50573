"""Poly-CAM against a slow re-derivation that follows the paper's steps one mask at a time."""

import numpy as np
import pytest
import torch
from poly_cam_by_hand import by_hand
from quick import saliency
from torch import nn

from sliplens.explainers.cam import find_layers
from sliplens.explainers.poly_cam import PolyCam


# the linear bottlenecks of a mobilenet have maps of both signs
@pytest.mark.parametrize(("name", "count"), [("small shufflenet", 5), ("mobilenet", 2)])
def test_equals_the_derivation_one_mask_at_a_time(name, count, network, images, monkeypatch):
    reference, size = images[2], 32 if name == "mobilenet" else 64
    model, images, reference = network(name), images[..., :size, :size], reference[..., :size, :size]
    layers = dict(list(find_layers(model, images).items())[:count])
    monkeypatch.setattr("sliplens.explainers.poly_cam.find_layers", lambda *_: layers)
    explanation = PolyCam()(model, images[:1], reference=reference)
    saliency = by_hand(model, images[0], reference, layers=tuple(layers))
    expected = saliency / saliency.sum() * float(explanation.change[0])
    assert expected.any()
    np.testing.assert_allclose(explanation.relevance[0], expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


def test_sums_to_the_change_with_its_sign(network, images, reference):
    # no channel supports the change of the second image, which leaves its map zero
    explanation = PolyCam()(network("small shufflenet"), images[[0, 2]], reference=reference)
    torch.testing.assert_close(explanation.relevance.sum(dim=(1, 2)), explanation.change, rtol=1e-5, atol=0)
    assert bool((explanation.relevance * explanation.change.sign()[:, None, None] >= 0).all())
    assert explanation.completeness_gap is not None
    assert bool((explanation.completeness_gap < 1e-6).all())


def test_nothing_is_relevant_where_the_image_is_the_reference(network, images, reference):
    images = images[:1].clone()
    images[..., 20:40, 30:50] = reference[:, 20:40, 30:50]
    relevance = PolyCam()(network("small shufflenet"), images, reference=reference).relevance[0]
    assert relevance.any()
    # a pixel counts with its neighbours: two on each side in 64 px
    assert relevance[20, 40] != 0
    assert not relevance[22:38, 32:48].any()


def test_a_frame_that_moves_no_channel_has_an_empty_map():
    # without biases every activation of a black image is 0
    layers = nn.Conv2d(3, 4, 3, bias=False), nn.ReLU(), nn.Flatten(), nn.Linear(3600, 1)
    assert not PolyCam()(nn.Sequential(*layers).eval(), torch.zeros(1, 3, 32, 32)).relevance.any()


def count_passes(model: nn.Module) -> list[int]:
    passes = []
    model.register_forward_pre_hook(lambda _module, arguments: passes.append(len(arguments[0])))
    return passes


PREPARATION = 4  # passes: the image, the reference, the search for layers, the activations


def test_layers_finer_than_the_level_cost_nothing(network, images):
    model = network("small shufflenet")
    passes = count_passes(model)
    PolyCam(level=2)(model, images[:1])
    passed = sum(passes)  # before the next search for layers; some channels are constant
    assert passed <= PREPARATION + 2 * sum(shape[0] for shape in list(find_layers(model, images).values())[2:])


def test_constant_channels_cost_no_pass(network, images, monkeypatch):
    model = network("small shufflenet")
    with torch.no_grad():
        model.conv1[1].weight[:3] = 0  # after its ReLU a channel is a constant
        model.conv1[1].bias[:3] = torch.tensor([0.5, 0, -1])
    (name, shape), *_ = find_layers(model, images[:1]).items()
    monkeypatch.setattr("sliplens.explainers.poly_cam.find_layers", lambda *_: {name: shape})
    passes = count_passes(model)
    PolyCam()(model, images[:1])
    assert sum(passes) == PREPARATION - 1 + 2 * (shape[0] - 3)


class Sums(nn.Module):
    """One layer of maps, and an output that depends on the mean image only."""

    def __init__(self, *, output) -> None:
        super().__init__()
        self.maps = nn.Conv2d(3, 4, 1, bias=False)
        nn.init.constant_(self.maps.weight, 1.0)
        self.output = output

    def forward(self, images):
        return self.output(images.mean(dim=(1, 2, 3))) + 0 * self.maps(images).mean(dim=(1, 2, 3))


def test_warns_where_the_weights_are_all_alike(images):
    warnings = PolyCam()(Sums(output=lambda mean: mean), images[:1].float()).warnings
    assert len(warnings) == 1
    assert warnings[0].startswith("image 0: every channel of layer maps has the weight 0.")


def test_warns_where_no_channel_supports_the_change(images):
    # the brighter half of the image lowers the output: every effect is against the change
    image = images[:1].float()
    whole = float(image.mean())
    model = Sums(
        output=lambda mean: torch.where((mean == 0) | ((mean - whole).abs() < 1e-6), mean, 100 * (mean - whole / 2))
    )
    explanation = PolyCam()(model, image)
    assert not explanation.relevance.any()
    assert explanation.warnings[0] == "image 0: the map is zero everywhere and says nothing about the image"
    assert "no channel of layer maps supports f(x) - f(reference), so the map is zero" in explanation.warnings[-1]


def test_warns_where_masked_images_have_no_prediction(images):
    # defined on the whole image and on nothing, as a division by a small sum can be
    whole = float(images[0].float().mean())
    model = Sums(output=lambda mean: torch.where((mean == 0) | ((mean - whole).abs() < 1e-6), mean, torch.nan))
    explanation = PolyCam()(model, images[:1].float())
    assert explanation.warnings[0] == "image 0: the map holds NaN or infinity and must not be shown or scored"
    assert "4 of 4 channels of layer maps have no finite weight" in explanation.warnings[1]
    assert bool(explanation.relevance.isnan().any())


def test_the_engine_does_not_change_the_map(network, images):
    pytest.importorskip("openvino")
    model, image = network("small shufflenet").float().requires_grad_(requires_grad=False), images[:1].float()
    plain = PolyCam(engine="torch")(model, image)
    fast = PolyCam(engine="openvino")(model, image)
    assert (plain.engine, fast.engine) == ("torch", "openvino")
    torch.testing.assert_close(saliency(fast), saliency(plain), atol=1e-4, rtol=0)
