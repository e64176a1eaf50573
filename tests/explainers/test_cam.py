import pytest
import torch
from captum import attr
from quick import Count, saliency
from torch import nn
from torchcam.methods import GradCAM

from sliplens.errors import ModelError
from sliplens.explainers.cam import GradCam, capture


def captured(model: nn.Module, images, layer: str):
    with capture(model, [layer], differentiable=True) as outputs:
        prediction = model(images).flatten()
    (gradients,) = torch.autograd.grad(prediction.sum(), outputs[layer])
    return outputs[layer].detach(), gradients, prediction.detach()


@pytest.mark.parametrize(
    ("name", "layer"), [("shufflenet", "conv5"), ("resnet", "layer4"), ("vgg", "features"), ("gap", "second")]
)
def test_a_pooled_linear_head_is_the_sum_of_the_map_and_its_bias(name, layer, network, images):
    model = network(name)
    activations, gradients, prediction = captured(model, images, layer)
    bias = (model.classifier if name == "vgg" else model.fc).bias
    total = GradCam.cells(activations, gradients).sum(dim=(1, 2)) + bias
    tolerance = 1e-4 * torch.maximum(prediction.abs(), torch.tensor(1.0))
    assert bool(((total - prediction).abs() <= tolerance).all())


@pytest.mark.parametrize(
    ("name", "layer"),
    [
        ("shufflenet", "conv5"),
        ("shufflenet", "stage3"),
        ("mobilenet", "features"),
        ("resnet", "layer3"),
        ("vgg", "features.10"),
    ],
)
def test_equals_torch_cam_after_the_same_relu(name, layer, network, images):
    model = network(name)
    activations, gradients, _ = captured(model, images, layer)
    with GradCAM(model, target_layer=layer) as extractor:
        oracle = extractor(0, model(images.clone().requires_grad_()), normalized=False)[0]
    torch.testing.assert_close(torch.relu(GradCam.cells(activations, gradients)), oracle, atol=1e-6, rtol=0)


@pytest.mark.parametrize(("name", "layer"), [("shufflenet", "stage3"), ("resnet", "layer3"), ("vgg", "features.10")])
def test_equals_captum_with_its_sign(name, layer, network, images):
    model = network(name)
    activations, gradients, _ = captured(model, images, layer)
    oracle = torch.as_tensor(
        attr.LayerGradCam(lambda x: model(x).flatten(), model.get_submodule(layer)).attribute(images)
    )
    torch.testing.assert_close(GradCam.cells(activations, gradients), oracle[:, 0].detach(), atol=1e-9, rtol=1e-6)


def test_images_and_references_share_a_pass(network, images):
    counted = Count(network("small shufflenet"))
    GradCam()(counted, images)
    assert counted.batches == [1, 3 + 1]  # the search for layers; the images and the reference that all share
    counted.batches.clear()
    GradCam()(counted, images, reference=images)
    assert counted.batches == [1, 3 + 3]


def test_the_published_map_does_not_depend_on_the_reference(network, images, reference):
    model = network("shufflenet")
    published = GradCam(published=True)
    one, other = published(model, images), published(model, images, reference=reference)
    torch.testing.assert_close(saliency(one), saliency(other), atol=1e-6, rtol=1e-6)
    assert not torch.equal(one.reference_prediction, other.reference_prediction)
    assert one.completeness_gap is None


@pytest.mark.parametrize(("name", "size"), [("shufflenet", 64), ("shufflenet", 50), ("gap", 64)])
def test_the_contrast_adds_up_to_the_difference_for_a_pooled_linear_head(name, size, network, images, reference):
    explanation = GradCam()(network(name), images[..., :size, :size], reference=reference[..., :size, :size])
    total = explanation.relevance.sum(dim=(1, 2))
    # a float32 sum over the pixels of the image
    torch.testing.assert_close(total, explanation.change, atol=1e-4, rtol=1e-4)
    assert explanation.completeness_gap is not None
    assert float(explanation.completeness_gap.max()) <= 1e-5


def test_refuses_a_layer_that_the_output_ignores(images):
    class Ignorant(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.maps = nn.Conv2d(3, 4, 1)

        def forward(self, images):
            self.maps(images)
            return images.mean(dim=(1, 2, 3))

    with pytest.raises(ModelError, match="output of Ignorant does not depend on 'maps'"):
        GradCam()(Ignorant(), images.float())
