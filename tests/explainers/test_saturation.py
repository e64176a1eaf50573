"""Gradients that vanish where there is something to explain are told."""

import pytest
import torch
from quick import QUICK
from torch import nn

from sliplens.explainers.gradients import IntegratedGradients, SmoothGrad

# noise as small as a flat network is flat for
METHODS = QUICK | {"integrated-gradients": IntegratedGradients(), "smooth-grad": SmoothGrad(samples=4, noise=0.01)}
BY_GRADIENT = ("grad-cam", "smooth-grad", "integrated-gradients")


class Sigmoid(nn.Module):
    """sigmoid(steepness (mean - 1/4)) of the copied image: at white images its argument is 3/4 of the steepness."""

    def __init__(self, *, steepness: float) -> None:
        super().__init__()
        self.copy = nn.Conv2d(3, 1, 1, bias=False)
        nn.init.constant_(self.copy.weight, 1 / 3)
        self.steepness = steepness

    def forward(self, images):
        return torch.sigmoid(self.steepness * (self.copy(images).mean(dim=(1, 2, 3)) - 0.25))


def told(explanation) -> list[str]:
    return [text for text in explanation.warnings if "the network is saturated there" in text]


@pytest.mark.parametrize("name", BY_GRADIENT)
def test_a_saturated_network_is_told(name):
    images = torch.stack([torch.ones(3, 8, 8), torch.full((3, 8, 8), 0.25)])
    # at white the slope is 40 sigmoid(30) sigmoid(-30), about 4e-12; at a quarter it is 10
    (sentence,) = told(METHODS[name](Sigmoid(steepness=40), images))
    assert sentence.startswith("image 0: the gradients at the image make up ")
    assert "less than 0.1" in sentence


@pytest.mark.parametrize("name", BY_GRADIENT)
def test_a_network_that_is_not_saturated_is_not(name):
    # the slope at white is 4 sigmoid(3) sigmoid(-3) = 0.18 where 0.68 is to be explained: 0.26 of it
    assert not told(METHODS[name](Sigmoid(steepness=4), torch.ones(1, 3, 8, 8)))


def test_integrated_gradients_look_at_the_last_piece_of_the_line():
    # all of the rise is at a quarter of the way, the line is complete, and the image itself is on the plateau
    explanation = IntegratedGradients()(Sigmoid(steepness=40).double(), torch.ones(1, 3, 8, 8).double())
    assert explanation.completeness_gap is not None
    assert float(explanation.completeness_gap) < 0.01
    assert len(told(explanation)) == 1
