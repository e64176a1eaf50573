"""Laws that every explainer obeys."""

import copy
from contextlib import nullcontext
from functools import partial

import pytest
import torch
from quick import QUICK, saliency
from small import Returning

from sliplens.errors import ImageError, InputError, ModelError
from sliplens.explainers.gradients import SmoothGrad
from sliplens.explainers.occlusion import Occlusion
from sliplens.explainers.poly_cam import PolyCam
from sliplens.explainers.shapley import Shapley
from sliplens.explainers.table import EXPLAINERS
from sliplens.progress import reporting

# what the thesis ran is of f itself, and obeys no law: test_thesis.py
NAMES = [name for name in EXPLAINERS if not name.endswith("-thesis")]
pytestmark = pytest.mark.usefixtures("short_guess")
every_explainer = pytest.mark.parametrize("name", NAMES)
CAMS = ["grad-cam", "poly-cam"]
HOOKS = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")


def state_of(model: torch.nn.Module):
    """Everything that a call must leave alone."""
    return {
        "tensors": {name: value.clone() for name, value in model.state_dict().items()},
        "training": {name: module.training for name, module in model.named_modules()},
        "trainable": {name: parameter.requires_grad for name, parameter in model.named_parameters()},
        "gradients": {name: copy.deepcopy(parameter.grad) for name, parameter in model.named_parameters()},
        "hooks": {name: [list(getattr(module, kind)) for kind in HOOKS] for name, module in model.named_modules()},
    }


def in_use(model):
    """Put a network into the middle of a training: mixed flags, gradients, and a hook of the user's."""
    model.train()
    model.stage2.eval()
    model.conv1[0].weight.requires_grad_(False)
    model.fc.weight.grad = torch.ones_like(model.fc.weight)
    model.stage3.register_forward_hook(lambda *_: None)
    return model


def assert_same(one, other):
    for key in ("training", "trainable", "hooks"):
        assert one[key] == other[key]
    for key in ("tensors", "gradients"):
        assert one[key].keys() == other[key].keys()
        for name, value in one[key].items():
            expected = other[key][name]
            same = expected is None if value is None else torch.equal(value, expected)
            assert same, name


@pytest.mark.parametrize(
    ("name", "call"),
    [(name, call) for name in NAMES for call in (1, 2)]  # predicting, or looking for layers, or explaining
    + [(name, 3) for name in NAMES if name not in CAMS[:3]]
    + [("poly-cam", 4), ("poly-cam", 5), *((name, 4) for name in NAMES[-4:])],
)
def test_model_is_given_back_as_it_was_after_an_exception(name, call, network, images):
    model = in_use(network("small shufflenet"))
    calls = []

    def fail(*_):
        calls.append(1)
        if len(calls) == call:
            raise RuntimeError("out of memory")

    model.get_submodule("stage4").register_forward_hook(fail)
    before = state_of(model)
    with pytest.raises(RuntimeError, match="out of memory"):
        QUICK[name](model, images[:1])
    assert_same(state_of(model), before)


@every_explainer
@pytest.mark.parametrize("error", [None, KeyboardInterrupt])
def test_model_is_given_back_as_it_was(name, error, network, images):
    def report(*_):
        if error is not None:
            raise error

    model = in_use(network("small shufflenet"))
    before = state_of(model)
    with pytest.raises(error) if error else nullcontext(), reporting(report):
        QUICK[name](model, images[:2])
    assert_same(state_of(model), before)


@every_explainer
def test_images_are_left_alone_and_the_result_has_no_graph(name, network, images, reference):
    x, b = images.clone(), reference.clone()
    explanation = QUICK[name](network("small shufflenet"), x, reference=b)
    assert torch.equal(x, images)
    assert torch.equal(b, reference)
    assert not x.requires_grad
    assert not explanation.relevance.requires_grad
    assert not explanation.prediction.requires_grad
    assert explanation.relevance.dtype == torch.float32


@every_explainer
def test_a_batch_gives_what_its_images_alone_give(name, network, images):
    model = network("small shufflenet").float()
    references = images.flip(0).float()
    together = QUICK[name](model, images.float(), reference=references)
    alone = [QUICK[name](model, images[i, None].float(), reference=references[i, None]) for i in range(len(images))]
    torch.testing.assert_close(together.relevance, torch.cat([one.relevance for one in alone]), atol=1e-5, rtol=0)
    torch.testing.assert_close(saliency(together), torch.cat([saliency(one) for one in alone]), atol=1e-3, rtol=0)


@every_explainer
@pytest.mark.parametrize("scale", [0.3, -3.0])
def test_affine_law(name, scale, network, images, reference):
    model = network("small shufflenet")
    plain = QUICK[name](model, images, reference=reference)
    scaled = QUICK[name](Returning(lambda answers: scale * answers + 0.4, model), images, reference=reference)
    expected = scale * plain.relevance
    torch.testing.assert_close(scaled.relevance, expected, atol=1e-5 * float(expected.abs().max()), rtol=0)
    # the evidence for the change is the same, whichever way the output points; Grad-CAM's sign is the output's own
    torch.testing.assert_close(saliency(scaled), saliency(plain), atol=1e-4, rtol=0)


@every_explainer
def test_map_moves_with_the_image(name, network):
    def with_patch(at: int):
        images = torch.zeros(1, 3, 96, 96, dtype=torch.float64)
        generator = torch.Generator().manual_seed(5)
        images[..., at : at + 24, at : at + 24] = torch.rand(3, 24, 24, generator=generator, dtype=torch.float64)
        return images

    model = network("gap")
    # noise does not move with the image; markers do
    places = torch.tensor([[30.0, 30.0], [40.0, 28.0], [33.0, 41.0]])
    moving = {
        "smooth-grad": lambda _: SmoothGrad(samples=1, noise=0.0),
        "occlusion": lambda _: Occlusion(),
        "occlusion-marker": lambda at: Occlusion(markers_px=places + at - 24),
        "shapley": lambda _: Shapley(tile_px=16),
        "shapley-marker": lambda at: Shapley(markers_px=places + at - 24),
    }
    explain = moving.get(name, lambda _: QUICK[name])
    one = explain(24)(model, with_patch(24)).relevance[0, 16:56, 16:56]
    other = explain(40)(model, with_patch(40)).relevance[0, 32:72, 32:72]
    correlation = torch.corrcoef(torch.stack([one.flatten(), other.flatten()]))[0, 1]
    assert float(correlation) >= 0.99


@every_explainer
@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode, partial(torch.autocast, "cpu", torch.bfloat16)])
def test_gradients_and_precision_of_the_caller_change_nothing(name, mode, network, images):
    model = network("small shufflenet").float()
    expected = QUICK[name](model, images[:1].float()).relevance
    with mode():
        inside = QUICK[name](model, images[:1].float().clone()).relevance
    torch.testing.assert_close(inside, expected, atol=1e-7, rtol=1e-4)


@every_explainer
def test_outputs_with_and_without_an_axis_of_one_agree(name, network, images):
    model = network("small shufflenet")
    flat = Returning(lambda answers: answers[:, 0], model)
    torch.testing.assert_close(QUICK[name](flat, images[:1]).relevance, QUICK[name](model, images[:1]).relevance)


@every_explainer
def test_reference_defaults_to_zeros_and_may_be_shared(name, network, images):
    model = network("small shufflenet")
    default = QUICK[name](model, images[:2])
    shared = QUICK[name](model, images[:2], reference=torch.zeros_like(images[0]))
    each = QUICK[name](model, images[:2], reference=torch.zeros_like(images[:2]))
    for other in (shared, each):
        torch.testing.assert_close(other.relevance, default.relevance)
        torch.testing.assert_close(other.reference_prediction, default.reference_prediction)


@every_explainer
def test_a_reference_without_a_margin_is_told(name, network, images):
    model = network("small shufflenet")
    for shift in (0.0, 5.0):
        shifted = Returning(lambda answers, shift=shift: answers + shift, model)
        warnings = QUICK[name](shifted, images[:1], reference=images[1]).warnings
        told = any("is no safety margin, so the reference lies far from the data" in text for text in warnings)
        assert told == (shift > 0)


@every_explainer
def test_image_equal_to_its_reference_has_nothing_to_explain(name, network, images):
    explanation = QUICK[name](network("small shufflenet"), images[:1], reference=images[:1])
    assert not explanation.influence.any()
    assert "so there is next to nothing to explain" in explanation.warnings[0]


def filled(value: float, *, shape=(2, 3, 8, 8)):
    return torch.full(shape, value)


BAD_SHAPES = [(3, 8, 8), (0, 3, 8, 8), (2, 1, 8, 8), (2, 3, 0, 8)]
BAD_IMAGES = [
    *((filled(0.5, shape=shape), r"which is not \(batch, 3, height, width\) of") for shape in BAD_SHAPES),
    (filled(0.5).to(torch.uint8), "image values are torch.uint8 instead of float; divide 8-bit images by 255"),
    (filled(torch.nan), r"image 0 has values from nan to nan, outside \[0, 1\]; scale it as"),
    (filled(37.0), r"image 0 has values from 37 to 37, outside \[0, 1\]; scale it as"),
]


@every_explainer
@pytest.mark.parametrize(("images", "message"), BAD_IMAGES)
def test_rejects_images(name, images, message, network):
    with pytest.raises(ImageError, match=message):
        QUICK[name](network("gap").float(), images)


BAD_REFERENCES = [
    (filled(0.5, shape=(3, 8, 9)), r"the reference has shape \(3, 8, 9\) but the images have \(2, 3, 8, 8\); pass one"),
    (filled(0.5, shape=(3, 3, 8, 8)), r"the reference has shape \(3, 3, 8, 8\) but the images have \(2, 3, 8, 8\)"),
    (filled(-0.5, shape=(3, 8, 8)), r"reference 0 has values from -0.5 to -0.5, outside \[0, 1\]"),
    (filled(torch.inf), "reference 0 has values from inf to inf"),
]


@every_explainer
@pytest.mark.parametrize(("reference", "message"), BAD_REFERENCES)
def test_rejects_references(name, reference, message, network):
    with pytest.raises(ImageError, match=message):
        QUICK[name](network("gap").float(), filled(0.5), reference=reference)


BAD_MODELS = [
    (lambda x: x.mean(dim=(2, 3)), r"output has shape \(2, 3\) for 2 image\(s\), not one number an image; end it"),
    (lambda x: x.mean(), r"output has shape \(\) for 2 image\(s\), not one number an image"),
    (lambda x: {"margin": x}, r"output has type dict for 2 image\(s\), not one number"),
    (lambda x: x.mean(dim=(1, 2, 3)) * torch.nan, "the model predicts nan for image 0; train or load it again"),
    (lambda x: 1 / x.mean(dim=(1, 2, 3)), "the model predicts inf for reference 0; train or load it again"),
]


@every_explainer
@pytest.mark.parametrize(("make", "message"), BAD_MODELS)
def test_rejects_models(name, make, message):
    with pytest.raises(ModelError, match=message):
        QUICK[name](Returning(make), filled(0.5))


@pytest.mark.parametrize(
    ("make", "options", "message"),
    [
        (Occlusion, {"tile_px": 0}, "tiles of 0 pixels are impossible; choose 1 or more"),
        (Occlusion, {"markers_px": torch.zeros(1, 2)}, "need two or more, and there are 1; choose tiles"),
        (PolyCam, {"budget": 0.0}, "Poly-CAM's budget is 0.0; give a share of the channels, above 0 and at most 1"),
    ],
)
def test_impossible_options_are_refused(make, options, message):
    with pytest.raises(InputError, match=message):
        make(**options)


@pytest.mark.parametrize("name", ["integrated-gradients", "expected-gradients", "smooth-grad", "shapley"])
def test_a_model_without_gradients_is_refused_with_its_cure(name):
    with pytest.raises(ModelError, match="has no gradient; take torch"):
        QUICK[name](Returning(torch.no_grad()(lambda images: images.mean(dim=(1, 2, 3)))), filled(0.5))
