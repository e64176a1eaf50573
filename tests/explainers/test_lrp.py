import pytest
import torch
from torch import nn

from sliplens.errors import InputError
from sliplens.explainers.gradients import Lrp
from sliplens.models.backbones import HistogramRegressor


def test_says_what_to_install(network, images, monkeypatch):
    monkeypatch.setattr("sliplens.extras.find_spec", lambda _: None)
    with pytest.raises(InputError, match=r'LRP needs zennit, which is not installed; install with `pip install "slip'):
        Lrp()(network("gap"), images)


@pytest.fixture
def zennit():
    return pytest.importorskip("zennit", reason="zennit, the extra lrp, is not installed")


class Toy(nn.Module):
    """A layer for the flat rule, one for the plus rule, and a linear one for epsilon."""

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Conv2d(3, 2, 1, bias=False)
        self.second = nn.Conv2d(2, 2, 1, bias=False)
        self.last = nn.Linear(2, 1, bias=False)

    def forward(self, images):
        return self.last(torch.relu(self.second(torch.relu(self.first(images)))).mean(dim=(2, 3)))


@pytest.mark.usefixtures("zennit")
def test_equals_the_rules_by_hand_and_keeps_the_total():
    model = Toy().double()
    with torch.no_grad():
        model.first.weight.copy_(torch.tensor([[1.0, 2, 3], [0.5, 0.1, 0.2]])[..., None, None])
        model.second.weight.copy_(torch.tensor([[1.0, -1], [2, 0.5]])[..., None, None])
        model.last.weight.copy_(torch.tensor([[0.7, 0.2]]))
    images = torch.rand(1, 3, 4, 4, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    explanation = Lrp()(model, images)
    # epsilon is 1e-6 of zennit, on values of about 1
    torch.testing.assert_close(explanation.relevance.sum(), explanation.prediction[0], atol=1e-4, rtol=1e-4)
    with torch.no_grad():
        one = torch.relu(model.first(images))[0]
        two = torch.relu(model.second(one[None]))[0]
    relevance = model.last.weight[0].detach()[:, None, None] * two / 16
    plus = model.second.weight[..., 0, 0].detach().clamp_min(0)
    inner = one * torch.einsum("oi,ohw->ihw", plus, relevance / torch.einsum("oi,ihw->ohw", plus, one))
    torch.testing.assert_close(explanation.relevance[0], inner.sum(dim=0).float(), atol=1e-4, rtol=1e-3)


@pytest.mark.usefixtures("zennit")
def test_a_sum_of_branches_hands_back_what_it_got():
    class Branches(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.first = nn.Conv2d(3, 4, 1, bias=False)
            self.last = nn.Linear(4, 1, bias=False)

        def forward(self, images):
            features = torch.relu(self.first(images))
            return self.last((features + 2 * features).mean([2, 3]))

    images = torch.rand(2, 3, 4, 4, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    with torch.random.fork_rng():
        torch.manual_seed(3)  # with some weights f(x) is near zero, and epsilon is not
        model = Branches().double()
    explanation = Lrp()(model, images)
    # a product with a number is no module: what it is given it hands on times the number, as a gradient
    assert bool((explanation.relevance.sum(dim=(1, 2)) != 0).all())
    single = explanation.relevance.sum(dim=(1, 2)) / explanation.prediction
    torch.testing.assert_close(single, torch.full((2,), 1 / 3 + 2 * 2 / 3), atol=1e-4, rtol=1e-4)
    assert any("image 0: LRP hands back 1.67 times f(x)" in text for text in explanation.warnings)


@pytest.mark.usefixtures("zennit")
def test_works_on_networks_and_leaves_them_alone(network, images):
    model = network("small shufflenet").train()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    explanation = Lrp()(model, images)
    assert explanation.relevance.shape == (3, 64, 64)
    assert bool(explanation.relevance.any(dim=2).any())
    assert model.training
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    assert not any(module._forward_hooks or module._forward_pre_hooks for module in model.modules())
    alone = torch.cat([Lrp()(model, images[index, None]).relevance for index in range(3)])
    torch.testing.assert_close(explanation.relevance, alone, atol=1e-6, rtol=1e-4)


@pytest.mark.usefixtures("zennit")
def test_a_histogram_is_handed_back_through_its_logits(images):
    with torch.random.fork_rng():
        torch.manual_seed(1)  # some weights leave every channel dark
        backbone = nn.Sequential(nn.Conv2d(3, 4, 3), nn.ReLU(), nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(4, 6))
    model = HistogramRegressor(backbone, bins=6)
    explanation = Lrp()(model, images[..., :8, :8].float())
    assert bool(explanation.relevance.isfinite().all())
    assert bool(explanation.relevance.any())
