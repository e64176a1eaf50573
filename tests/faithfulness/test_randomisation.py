import numpy as np
import pytest
import torch
from torch import nn

from sliplens.faithfulness.controls import edges
from sliplens.faithfulness.randomisation import (
    cascade,
    histogram_entropy,
    randomisation_scores,
    smooth_maps,
    weighted_layers,
)


@pytest.fixture
def model() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(
        nn.Conv2d(3, 4, 3, padding=1), nn.BatchNorm2d(4), nn.ReLU(), nn.Conv2d(4, 4, 3, padding=1), nn.ReLU(),
        nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(4, 1),
    ).eval()  # fmt: skip


def gradients(model: nn.Module, images: torch.Tensor) -> np.ndarray:
    inputs = images.clone().requires_grad_()
    (slope,) = torch.autograd.grad(model(inputs).sum(), inputs)
    return slope.sum(dim=1).numpy().astype(np.float64)


def test_layers_lose_their_weights_from_the_output_on_and_the_model_keeps_its_own(model: nn.Module):
    before = {name: value.clone() for name, value in model.state_dict().items()}
    assert weighted_layers(model) == ["0", "1", "3", "7"]
    for step, expected in zip(cascade(model, seed=1), (["7"], ["7", "3"], ["7", "3", "1"], ["7", "3", "1", "0"]),
                              strict=True):  # fmt: skip
        assert (step.layer, step.randomised) == (expected[-1], len(expected))
        changed = {name.split(".")[0] for name, value in step.model.state_dict().items()
                   if not torch.equal(value, before[name])}  # fmt: skip
        assert changed <= set(expected)
        assert {"7"} <= changed
    for name, value in model.state_dict().items():
        assert torch.equal(value, before[name])


def test_the_same_seed_draws_the_same_weights_however_many_stages(model: nn.Module):
    ends = [list(cascade(model, seed=3, stages=stages))[-1] for stages in (1, 2, 4)]
    assert {step.randomised for step in ends} == {4}
    for step in ends[1:]:
        for name, value in step.model.state_dict().items():
            assert torch.equal(value, ends[0].model.state_dict()[name])
    other = list(cascade(model, seed=4, stages=1))[-1]
    assert not torch.equal(other.model.state_dict()["0.weight"], ends[0].model.state_dict()["0.weight"])


def test_new_normalisation_has_the_statistics_of_the_images_and_the_network_still_tells_them_apart():
    torch.manual_seed(0)
    blocks = [layer for _ in range(12) for layer in (nn.Conv2d(8, 8, 3, padding=1), nn.BatchNorm2d(8), nn.ReLU())]
    deep = nn.Sequential(nn.Conv2d(3, 8, 1), *blocks[1:], nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(8, 1)).eval()
    images = torch.rand(6, 3, 16, 16, generator=torch.Generator().manual_seed(2))
    (dead,), (alive,) = (list(cascade(deep, seed=0, stages=1, images=given)) for given in (None, images))
    assert isinstance(alive.model, nn.Sequential)
    for name, value in alive.model.named_parameters():
        assert torch.equal(value, dict(dead.model.named_parameters())[name])
    assert not any(module.training for module in alive.model.modules())
    assert all(module.momentum == 0.1 for module in alive.model.modules() if isinstance(module, nn.BatchNorm2d))
    with torch.no_grad():
        assert dead.model(images).std() < 1e-6
        assert alive.model(images).std() > 1e-3
        before, normal = alive.model[:1](images), alive.model[1]
    # means of 1,536 float32 numbers below 1: a few units of the seventh digit
    torch.testing.assert_close(normal.running_mean, before.mean(dim=(0, 2, 3)), atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(normal.running_var, before.var(dim=(0, 2, 3)), atol=1e-6, rtol=1e-4)


def test_normalisation_that_was_not_drawn_anew_keeps_its_statistics(model: nn.Module):
    images = torch.rand(4, 3, 16, 16, generator=torch.Generator().manual_seed(2))
    first, second, *_ = [
        {name: value.clone() for name, value in step.model.state_dict().items()}
        for step in cascade(model, seed=1, images=images)
    ]
    for name, value in model.state_dict().items():
        if name.startswith("1."):
            assert torch.equal(first[name], value)
            assert torch.equal(second[name], value)


def test_a_map_that_ignores_the_network_stays_and_a_gradient_does_not(model: nn.Module):
    images = torch.rand(3, 3, 16, 16, generator=torch.Generator().manual_seed(1))
    blind = randomisation_scores(lambda _, inputs: edges(inputs).numpy(), model, images, seed=0, stages=2)
    np.testing.assert_allclose(blind.similarity, 1, atol=1e-6)
    np.testing.assert_allclose(blind.complexity_rise, 0)
    seeing = randomisation_scores(gradients, model, images, seed=0, stages=4)
    assert seeing.layers == (1, 2, 3, 4)
    assert np.all(np.abs(seeing.similarity[-1]) < 0.9)
    known = randomisation_scores(gradients, model, images, seed=0, stages=4, before=gradients(model, images))
    np.testing.assert_array_equal(known.similarity, seeing.similarity)


def test_entropy_has_its_closed_forms():
    assert histogram_entropy(np.ones((4, 4))) == 0
    assert histogram_entropy(np.arange(100.0).reshape(10, 10)) == pytest.approx(np.log(100))
    halves = np.zeros((10, 10))
    halves[:5] = 1
    assert histogram_entropy(halves) == pytest.approx(np.log(2))


def test_smoothed_maps_of_a_linear_network_are_its_maps():
    model = nn.Sequential(nn.Flatten(), nn.Linear(3 * 64, 1))
    images = torch.full((2, 3, 8, 8), 0.5)
    found = smooth_maps(gradients, model, images, samples=3)
    np.testing.assert_allclose(found, gradients(model, images), atol=1e-7)
