"""Explainers with fewer passes than by default, and networks whose maps are known."""

import torch
from torch import nn

from sliplens.explainers.attribution import Attribution
from sliplens.explainers.gradients import ExpectedGradients, IntegratedGradients, SmoothGrad
from sliplens.explainers.occlusion import Occlusion
from sliplens.explainers.shapley import Shapley
from sliplens.explainers.table import EXPLAINERS, get_explainer

# an untrained network is so rough that integrated gradients would go to their most steps in every test
SHORT = IntegratedGradients(steps=4, max_steps=8)
MARKERS = torch.tensor([[10.0, 12.0], [40.0, 20.0], [25.0, 50.0]])
QUICK = {name: get_explainer(name) for name in EXPLAINERS} | {
    "integrated-gradients": SHORT,
    "expected-gradients": ExpectedGradients(steps=4, max_steps=8),
    "smooth-grad": SmoothGrad(samples=3),
    "occlusion": Occlusion(tile_px=32),
    "occlusion-marker": Occlusion(markers_px=MARKERS),
    "shapley": Shapley(tile_px=32),
    "shapley-marker": Shapley(markers_px=MARKERS, pairs=8),
}


class Linear(nn.Module):
    """Weighted sum of the pixels."""

    def __init__(self, weights: torch.Tensor) -> None:
        super().__init__()
        self.weights = nn.Parameter(weights)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return (images * self.weights).sum(dim=(1, 2, 3))


class Count(nn.Module):
    """Counts the images of each pass through a network."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network
        self.batches: list[int] = []

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        self.batches.append(len(images))
        return self.network(images)


def saliency(attribution: Attribution) -> torch.Tensor:
    """Supporting evidence over its largest value, as `Explanation.saliency`."""
    supporting = torch.relu(attribution.influence)
    return supporting / supporting.amax(dim=(1, 2), keepdim=True).clamp_min(1e-30)
