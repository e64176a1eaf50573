"""Poly-CAM as the public code ran it, against a re-derivation of that code one mask at a time."""

import pytest
import torch
from captum import attr
from poly_cam_by_hand import by_hand
from quick import saliency
from torchcam.methods import GradCAM
from torchvision import models

from sliplens.errors import InputError, ModelError
from sliplens.explainers.attribution import spread
from sliplens.explainers.cam import find_layers, find_published_layers
from sliplens.explainers.poly_cam import PolyCam
from sliplens.explainers.table import get_explainer

PUBLISHED = ["conv1", "maxpool", *(f"stage{n}{part}" for n in (2, 3, 4) for part in (".0.branch1", ".0.branch2.2", ""))]


def test_finds_the_ten_layers_of_the_public_code():
    # at 64 px the maps of TorchVision's ShuffleNetV2 shrink where they shrink at 224 px
    model = models.shufflenet_v2_x1_0(weights=None)
    layers = find_published_layers(model, torch.zeros(1, 3, 64, 64))
    assert list(layers) == PUBLISHED[:-1]  # all but the last stage
    assert sum(shape[0] for shape in layers.values()) == 1208


def test_a_network_that_keeps_its_size_has_no_such_layer():
    model = torch.nn.Sequential(torch.nn.Conv2d(3, 2, 3, padding=1), torch.nn.Flatten(), torch.nn.Linear(2 * 64, 1))
    with pytest.raises(ModelError, match=r"has no layer where the size of the map changes, .*; use poly-cam"):
        PolyCam(published=True)(model, torch.full((1, 3, 8, 8), 0.5))


@pytest.mark.parametrize("level", [0, 1])
def test_equals_the_public_code(level, network, images, monkeypatch):
    model, layers = network("gap"), ("first", "second")
    with torch.no_grad():
        # the answers near zero, where the sigmoid of a percentage still tells channels apart
        model.fc.bias.sub_(model(images[:1])[0])
        model.fc.weight.mul_(0.05)
    expected = by_hand(model, images[0], torch.zeros_like(images[0]), layers=layers[level:], published=True)
    expected = torch.from_numpy(expected / expected.max()).float()
    chosen = {name: find_layers(model, images)[name] for name in layers}
    monkeypatch.setattr("sliplens.explainers.poly_cam.find_published_layers", lambda *_: chosen)
    explanation = PolyCam(published=True, level=level)(model, images[:1], reference=images[1])
    torch.testing.assert_close(saliency(explanation)[0], expected, atol=1e-5, rtol=0)


def test_its_weights_are_all_one_where_the_sigmoid_is_saturated(network, images):
    model = network("small shufflenet").float()
    with torch.no_grad():
        model.fc.bias.add_(5)  # 17 % is far below every masked image's answer
    explanation = PolyCam(published=True)(model, images[:1].float())
    chose_nothing = [text for text in explanation.warnings if "has the weight 1, so the masked passes chose" in text]
    assert len(chose_nothing) == len(find_published_layers(model, images.float()))


def test_a_level_that_is_not_there_is_told(network, images):
    with pytest.raises(InputError, match=r"Poly-CAM has no level 50 for [0-9]+ layers; count from 0, the finest"):
        PolyCam(published=True, level=50)(network("small shufflenet"), images[:1])


def test_grad_cam_of_the_thesis_is_torch_cams_above_zero_in_its_order(network, images, reference):
    """It is of f itself, so that the reference sets the scale of the map alone."""
    model = network("shufflenet")
    with GradCAM(model, target_layer="conv5") as extractor:
        oracle = extractor(0, model(images.clone().requires_grad_()), normalized=False)[0]
    shown = spread(oracle, (images.shape[-2], images.shape[-1]))
    explanation = get_explainer("grad-cam-thesis")(model, images, reference=reference)
    expected = shown * (explanation.change.abs() / shown.sum(dim=(1, 2)))[:, None, None]
    torch.testing.assert_close(explanation.relevance, expected.float(), atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(explanation.influence, explanation.relevance)


@pytest.mark.parametrize("green", [0.5, 1.0])  # the answer rises, and falls
def test_grad_cam_of_the_thesis_shows_what_raises_the_answer_whichever_way_it_went(green):
    class RedLessGreen(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.conv = torch.nn.Conv2d(3, 2, 1, bias=False)
            with torch.no_grad():
                self.conv.weight.copy_(torch.eye(2, 3)[:, :, None, None])

        def forward(self, images):
            means = torch.relu(self.conv(images)).mean(dim=(2, 3))
            return (means[:, 0] - 1.5 * means[:, 1])[:, None]

    image = torch.zeros(1, 3, 16, 16)
    image[0, 0, 2:6, 2:6] = 1
    image[0, 1, 10:14, 10:14] = green
    explanation = get_explainer("grad-cam-thesis")(RedLessGreen(), image, reference=torch.zeros(3, 16, 16))
    assert bool(explanation.change[0] > 0) == (green < 1)
    for shown in (explanation.relevance, explanation.influence):
        assert float(shown[0, 3, 3]) == float(shown.max()) > 0
        assert float(shown[0, 11, 11]) == float(shown.min()) == 0
    assert float(explanation.relevance.sum()) == pytest.approx(abs(float(explanation.change[0])), rel=1e-5)


def test_integrated_gradients_of_the_thesis_are_captums_from_black(network, images, reference):
    model = network("gap")
    integrated = attr.IntegratedGradients(model).attribute(images, n_steps=50)
    explanation = get_explainer("integrated-gradients-thesis")(model, images, reference=reference)
    torch.testing.assert_close(explanation.relevance, integrated.sum(dim=1).float(), atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(explanation.reference_prediction, model(reference[None]).detach().float().expand(3))
