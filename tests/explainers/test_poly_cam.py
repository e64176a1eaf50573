"""Poly-CAM against a slow re-derivation that follows the paper's steps one mask at a time."""

import copy
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch
from torch import nn

from sliplens.errors import InputError
from sliplens.explainers.attribution import EXACT, check_rounding, effect_rounding
from sliplens.explainers.cam import capture, find_layers
from sliplens.explainers.poly_cam import PolyCam
from sliplens.progress import reporting


@lru_cache
def matrix_of_bilinear(cells: int, pixels: int) -> np.ndarray:
    """Row p holds the weights of pixel p: centres at (p + 1/2) cells / pixels, clamped at the border."""
    weights = np.zeros((pixels, cells))
    for pixel in range(pixels):
        place = min(max((pixel + 0.5) * cells / pixels - 0.5, 0), cells - 1)
        below = int(np.floor(place))
        above = min(below + 1, cells - 1)
        weights[pixel, below] += 1 - (place - below)
        weights[pixel, above] += place - below
    return weights


def resize(cells: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    rows, columns = (matrix_of_bilinear(n, m) for n, m in zip(cells.shape, size, strict=True))
    return rows @ cells @ columns.T


def mask_of(cells: np.ndarray) -> np.ndarray:
    low, high = np.quantile(cells, [0.001, 0.999])
    if high < 0:
        return np.zeros_like(cells)
    return np.clip((cells - low) / max(high, 1e-12), 0, 1)


def by_hand(model: nn.Module, image, reference, *, layers: tuple[str, ...], variant: str) -> np.ndarray:
    """Steps 1 to 5 for one image with the regression score; the finest saliency."""

    def predict(tensor) -> float:
        with torch.no_grad():
            return float(model(tensor[None]))

    size = tuple(image.shape[1:])
    with capture(model, layers) as outputs:
        prediction = predict(image)
    base = predict(reference)
    layer_maps = []
    for name in layers:
        total = 0
        for activation in outputs[name][0].numpy():
            mask = torch.from_numpy(resize(mask_of(activation), size)).to(image.dtype)
            added = predict(reference + (image - reference) * mask) - base
            lost = prediction - predict(reference + (image - reference) * (1 - mask))
            effect = {"+": added, "-": lost, "+/-": (added + lost) / 2}[variant]
            total = total + max(np.sign(prediction - base) * effect, 0) * activation
        layer_maps.append(np.maximum(total, 0))
    result = layer_maps[-1]
    for layer_map in reversed(layer_maps[:-1]):
        smooth = resize(resize(layer_map, result.shape), layer_map.shape)
        result = np.maximum(layer_map / np.maximum(smooth, 1e-12) * resize(result, layer_map.shape), 0)
    return resize(mask_of(result), size) * changed(image, reference)


def changed(image, reference) -> np.ndarray:
    """Mean difference over a square of 15 of 224 pixels, the outermost ones repeated."""
    difference = np.abs(image.numpy() - reference.numpy()).mean(axis=0)
    height, width = difference.shape
    reach = round(15 / 224 * height) // 2
    mean = np.zeros_like(difference)
    for row in range(height):
        for column in range(width):
            rows = np.clip(np.arange(row - reach, row + reach + 1), 0, height - 1)
            columns = np.clip(np.arange(column - reach, column + reach + 1), 0, width - 1)
            mean[row, column] = difference[np.ix_(rows, columns)].mean()
    return mean


@pytest.mark.parametrize("variant", ["+", "-", "+/-"])
def test_equals_the_derivation_one_mask_at_a_time(variant, network, images, reference):
    model = network("small shufflenet")
    explanation = PolyCam(variant=variant, batch_size=7)(model, images[:1], reference=reference)
    saliency = by_hand(
        model, images[0], reference, layers=("conv1", "stage2", "stage3", "stage4", "conv5"), variant=variant
    )
    expected = saliency / saliency.sum() * float(explanation.change[0])
    np.testing.assert_allclose(explanation.relevance[0], expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("name", "layers"),
    [
        ("half shufflenet", ("conv1",)),
        ("mobilenet", ("features.0", "features.1")),  # linear bottlenecks: maps of both signs
    ],
)
def test_equals_the_derivation_on_torchvision_networks(name, layers, network, images):
    model = network(name).float()
    images = images[..., :32, :32].float()
    explanation = PolyCam(layers=layers)(model, images[:1])
    saliency = by_hand(model, images[0], torch.zeros_like(images[0]), layers=layers, variant="+/-")
    expected = saliency / saliency.sum() * float(explanation.change[0])
    assert expected.any()
    np.testing.assert_allclose(explanation.relevance[0], expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


def test_weights_vary_and_change_with_the_head(network, images):
    model = network("small shufflenet")
    explain = PolyCam(levels=True)
    before = explain(model, images[:1])
    with torch.no_grad():
        model.fc.weight.copy_(model.fc.weight.flip(1))
    after = explain(model, images[:1])
    for one, other in zip(before.levels, after.levels, strict=True):
        assert one.weights.std() > 0.1 * one.weights.mean() > 0
        correlation = float(torch.corrcoef(torch.cat([one.weights, other.weights]))[0, 1])
        assert correlation < 0.95
    assert not torch.allclose(before.saliency, after.saliency, atol=0.1)


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


def test_full_mask_has_the_whole_effect():
    class Flat(nn.Module):
        """One channel, nearly constant but for a dark corner: its mask is nearly full."""

        def __init__(self) -> None:
            super().__init__()
            self.copy = nn.Conv2d(3, 1, 1, bias=False)
            nn.init.constant_(self.copy.weight, 1 / 3)

        def forward(self, images):
            return self.copy(images).mean(dim=(1, 2, 3))

    images = torch.ones(1, 3, 8, 8)
    images[..., 0, 0] = 0
    # the 0.1th percentile of 64 values lies 6 % of the way up from the smallest
    low = 0.001 * 63
    (level,) = PolyCam(levels=True)(Flat(), images).levels
    torch.testing.assert_close(level.weights, torch.tensor([[1 - low]]))


def test_levels_are_kept_on_request_fine_to_coarse(network, images):
    model = network("small shufflenet")
    explanation = PolyCam(levels=True)(model, images[:2])
    assert [level.layer for level in explanation.levels] == ["conv1", "stage2", "stage3", "stage4", "conv5"]
    for level in explanation.levels:
        assert level.saliency.shape == (2, 64, 64)
        assert bool(((level.saliency >= 0) & (level.saliency <= 1)).all())
    parts = [changed(image, torch.zeros_like(image)) for image in images[:2]]
    finest = explanation.levels[0].saliency * torch.from_numpy(np.stack(parts)).float()
    torch.testing.assert_close(explanation.saliency, finest / finest.amax(dim=(1, 2), keepdim=True))
    assert PolyCam()(model, images[:1]).levels == ()


@pytest.mark.parametrize("score", ["regression", "thesis"])
def test_layers_finer_than_the_level_cost_nothing_and_change_nothing(score, network, images):
    model = network("small shufflenet")
    seen = []
    model.register_forward_pre_hook(lambda _module, arguments: seen.append(len(arguments[0])))
    alone = PolyCam(score=score, level=2)(model, images[:1])
    cost = sum(seen)
    seen.clear()
    every = PolyCam(score=score, level=2, levels=True)(model, images[:1])
    torch.testing.assert_close(alone.relevance, every.relevance)
    finer = sum(level.weights.shape[1] for level in every.levels[:2])
    assert sum(seen) - cost == 2 * finer


def test_batch_size_does_not_change_the_map(network, images):
    model = network("small shufflenet")
    one, other = (PolyCam(batch_size=size)(model, images[:1]).relevance for size in (1, 50))
    torch.testing.assert_close(one, other)


@pytest.mark.parametrize(("variant", "passes"), [("+", 1), ("-", 1), ("+/-", 2)])
def test_constant_channels_cost_no_pass(variant, passes, network, images):
    model = network("small shufflenet")
    with torch.no_grad():
        model.conv1[1].weight[:3] = 0  # after its ReLU a channel is a constant
        model.conv1[1].bias[:3] = torch.tensor([0.5, 0, -1])
    layer = find_layers(model, images[:1])[0]
    seen = []
    model.register_forward_pre_hook(lambda _module, arguments: seen.append(len(arguments[0])))
    explanation = PolyCam(variant=variant, layers=(layer.name,), levels=True)(model, images[:1])
    preparation = [1, 1, 1, 1]  # the image, the reference, the search for layers, the activations
    assert sum(seen) == sum(preparation) + passes * (layer.channels - 3)
    assert not explanation.levels[0].weights[0, :3].any()


def test_progress_counts_the_channels_of_every_image(network, images):
    steps = []
    model = network("small shufflenet")
    with reporting(lambda done, total: steps.append((done, total))):
        PolyCam(batch_size=20)(model, images[:2])
    done, totals = zip(*steps, strict=True)
    assert set(totals) == {2 * (8 + 8 + 16 + 16 + 24)}
    assert list(done) == sorted(done)
    assert done[-1] == totals[0]


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
    # parts of the image push the output past its value on the whole: every effect is against the change
    model = Sums(output=lambda mean: torch.where(mean > 0.45, -mean, mean))
    explanation = PolyCam(variant="+")(model, images[:1].float().clamp_min(0.3))
    assert not explanation.relevance.any()
    assert not explanation.saliency.any()
    assert explanation.warnings[0] == "image 0: the map is zero everywhere and says nothing about the image"
    assert "unexplained, more than 1%" in explanation.warnings[1]
    assert explanation.warnings[2] == (
        "image 0: no channel of layer maps supports f(x) - f(reference), so the map is zero"
    )


def test_warns_where_masked_images_have_no_prediction(images):
    # defined on the whole image and on nothing, as a division by a small sum can be
    whole = float(images[0].float().mean())
    model = Sums(output=lambda mean: torch.where((mean == 0) | ((mean - whole).abs() < 1e-6), mean, torch.nan))
    explanation = PolyCam()(model, images[:1].float())
    assert explanation.warnings[0] == "image 0: the map holds NaN or infinity and must not be shown or scored"
    assert "4 of 4 channels of layer maps have no finite weight" in explanation.warnings[1]
    assert bool(explanation.relevance.isnan().any())


def test_the_error_of_small_effects_stays_within_what_is_said_of_it(network, images):
    exact_network = network("small shufflenet")
    single = copy.deepcopy(exact_network).float()
    images, explain = images.float(), PolyCam(levels=True, engine="torch")
    seen = []
    for step in (1.0, 1e-2, 1e-4):
        near = images[:1] + step * (images[1:2] - images[:1])
        ours, exact = (explain(model, images[:1].to(kind), reference=near.to(kind)) for model, kind in
                       ((single, torch.float32), (exact_network, torch.float64)))  # fmt: skip
        high, low = float(exact.prediction), float(exact.reference_prediction)
        weights = [level.weights[0] for level in ours.levels]
        told = effect_rounding(weights, prediction=high, reference_prediction=low)
        errors = [
            float((one.weights - other.weights).abs().max() / other.weights.max())
            for one, other in zip(ours.levels, exact.levels, strict=True)
        ]
        assert max(errors) <= told
        assert any("rounding" in warning for warning in ours.warnings) == (told > EXACT)
        assert not any("rounding" in warning for warning in exact.warnings)
        seen.append((max(errors), told))
    # it is the smallness of the change that makes both the error and what is said of it
    assert seen[0][1] < EXACT < seen[2][0]
    with pytest.raises(ValueError, match="argument"):  # no image is passed over in silence
        list(check_rounding([], predictions=[(0.5, 0.4)]))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"variant": "++"}, r"Poly-CAM has no variant '\+\+'; choose among \+, -, \+/-"),
        ({"score": "softmax"}, "Poly-CAM has no score 'softmax'; choose among regression, thesis"),
        ({"budget": 0.0}, "Poly-CAM's budget is 0.0; give a share of the channels, above 0 and at most 1"),
        ({"batch_size": 0}, "Poly-CAM's batch_size is 0; give at least 1"),
    ],
)
def test_rejects_options(options, message):
    with pytest.raises(InputError, match=message):
        replace(PolyCam(), **options)


def test_the_engine_does_not_change_the_map(network, images):
    pytest.importorskip("openvino")
    model, image = network("small shufflenet").float().requires_grad_(requires_grad=False), images[:1].float()
    plain = PolyCam(engine="torch", batch_size=1)(model, image)
    fast = PolyCam(engine="openvino")(model, image)
    assert (plain.engine, fast.engine) == ("torch", "openvino")
    torch.testing.assert_close(fast.saliency, plain.saliency, atol=1e-4, rtol=0)
