"""Folded batch normalisation: the same predictions, and the network stays as it was."""

from collections.abc import Callable
from threading import Thread

import torch
from torch import Tensor, nn

from sliplens.explainers.folding import fold_batch_norm


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
