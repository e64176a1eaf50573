"""Layer-wise relevance propagation, and the folding of batch normalisation that it needs."""

from collections.abc import Callable
from threading import Thread

import pytest
import torch
from torch import Tensor, nn

from sliplens.errors import InputError
from sliplens.explainers.lrp import Lrp, fold_batch_norm
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
        backbone = nn.Sequential(nn.Conv2d(3, 4, 3), nn.ReLU(), nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(4, 60))
    model = HistogramRegressor(backbone)
    explanation = Lrp()(model, images[..., :8, :8].float())
    assert bool(explanation.relevance.isfinite().all())
    assert bool(explanation.relevance.any())


def count_norms(model: nn.Module) -> int:
    return sum(isinstance(module, nn.BatchNorm2d) for module in model.modules())


def test_folding_leaves_no_batch_normalisation_and_the_network_as_it_was(network, images):
    model = network("small shufflenet").float().requires_grad_(requires_grad=False)
    before, expected = {name: value.clone() for name, value in model.state_dict().items()}, model(images.float())
    folded = fold_batch_norm(model)
    assert (count_norms(folded), count_norms(model) > 0) == (0, True)
    torch.testing.assert_close(folded(images.float()), expected, atol=1e-4, rtol=1e-4)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


class Normed(nn.Module):
    """A network that may branch on values, which cannot be traced, or do something else meanwhile."""

    def __init__(self, *, branches: bool = False, meanwhile: Callable[[], None] = lambda: None) -> None:
        super().__init__()
        self.inner = nn.Sequential(nn.Conv2d(3, 4, 3), nn.BatchNorm2d(4), nn.Flatten())
        self.branches, self.meanwhile = branches, meanwhile

    def forward(self, images: Tensor) -> Tensor:
        if self.branches and images.sum() < 0:
            return self.inner(-images)
        self.meanwhile()
        return self.inner(images)


def test_a_network_that_cannot_be_traced_is_copied(images):
    model = Normed(branches=True).eval()
    assert torch.equal(fold_batch_norm(model)(images.float()), model(images.float()))


def test_a_network_that_another_thread_runs_meanwhile_predicts_the_same():
    other, image, answers = Normed().eval(), torch.ones(1, 3, 8, 8), []

    def run_elsewhere() -> None:
        thread = Thread(target=lambda: answers.append(other(image)))
        thread.start()
        thread.join()

    assert count_norms(fold_batch_norm(Normed(meanwhile=run_elsewhere).eval())) == 0
    torch.testing.assert_close(answers[0], other(image))
