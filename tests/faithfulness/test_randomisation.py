import copy

import pytest
import torch
from torch import nn

from sliplens.faithfulness.controls import cascade


@pytest.fixture
def model() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(
        nn.Conv2d(3, 4, 3, padding=1), nn.BatchNorm2d(4), nn.ReLU(), nn.Conv2d(4, 4, 3, padding=1), nn.ReLU(),
        nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(4, 1),
    ).eval()  # fmt: skip


def noise() -> torch.Tensor:
    return torch.rand(4, 3, 16, 16, generator=torch.Generator().manual_seed(2))


def test_layers_lose_their_weights_from_the_output_on_and_the_model_keeps_its_own(model: nn.Module):
    before = {name: value.clone() for name, value in model.state_dict().items()}
    steps = cascade(model, seed=1, stages=4, images=noise())
    for (count, new), expected in zip(steps, (["7"], ["7", "3"], ["7", "3", "1"], ["7", "3", "1", "0"]), strict=True):
        assert count == len(expected)
        changed = {name.split(".")[0] for name, value in new.state_dict().items()
                   if not torch.equal(value, before[name])}  # fmt: skip
        assert changed == set(expected)
    for name, value in model.state_dict().items():
        assert torch.equal(value, before[name])


def test_the_same_seed_draws_the_same_weights_however_many_stages(model: nn.Module):
    ends = [list(cascade(model, seed=3, stages=stages, images=noise()))[-1] for stages in (1, 2, 4)]
    assert {count for count, _ in ends} == {4}
    (_, first), *others = ends
    for _, network in others:
        for name, value in network.state_dict().items():
            # at each stage a pass more is counted
            assert name.endswith("num_batches_tracked") or torch.equal(value, first.state_dict()[name])
    ((_, other),) = cascade(model, seed=4, stages=1, images=noise())
    assert not torch.equal(other.state_dict()["0.weight"], first.state_dict()["0.weight"])


def test_networks_of_neighbouring_seeds_share_no_weights():
    equal = nn.Sequential(*(nn.Linear(4, 4) for _ in range(3)), nn.Flatten(), nn.Linear(48, 1))
    images = torch.rand(2, 3, 4, 4)
    drawn = [
        value
        for seed in range(3)
        for _, network in cascade(equal, seed=seed, stages=1, images=images)
        for name, value in network.state_dict().items()
        if name in {"0.weight", "1.weight", "2.weight"}
    ]
    assert len(drawn) == 9
    assert len({tuple(value.flatten().tolist()) for value in drawn}) == 9


def test_new_normalisation_has_the_statistics_of_the_images_and_the_network_still_tells_them_apart():
    torch.manual_seed(0)
    blocks = [layer for _ in range(12) for layer in (nn.Conv2d(8, 8, 3, padding=1), nn.BatchNorm2d(8), nn.ReLU())]
    deep = nn.Sequential(nn.Conv2d(3, 8, 1), *blocks[1:], nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(8, 1)).eval()
    images = torch.rand(6, 3, 16, 16, generator=torch.Generator().manual_seed(2))
    ((_, alive),) = cascade(deep, seed=0, stages=1, images=images)
    assert isinstance(alive, nn.Sequential)
    dead, norms = copy.deepcopy(alive), [module for module in alive.modules() if isinstance(module, nn.BatchNorm2d)]
    for module in dead.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.reset_running_stats()
    assert not any(module.training for module in alive.modules())
    assert all(module.momentum == 0.1 for module in norms)
    with torch.no_grad():
        assert dead(images).std() < 1e-6
        assert alive(images).std() > 1e-3
        before, normal = alive[:1](images), norms[0]
    # means of 1,536 float32 numbers below 1: a few units of the seventh digit
    torch.testing.assert_close(normal.running_mean, before.mean(dim=(0, 2, 3)), atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(normal.running_var, before.var(dim=(0, 2, 3)), atol=1e-6, rtol=1e-4)


def test_normalisation_that_was_not_drawn_anew_keeps_its_statistics(model: nn.Module):
    first, second, *_ = [
        {name: value.clone() for name, value in network.state_dict().items()}
        for _, network in cascade(model, seed=1, stages=4, images=noise())
    ]
    for name, value in model.state_dict().items():
        if name.startswith("1."):
            assert torch.equal(first[name], value)
            assert torch.equal(second[name], value)
