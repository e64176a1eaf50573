"""Explainers with fewer passes than by default, for tests that ask for their laws and not for their precision."""

import torch

from sliplens.explainers.attribution import Attribution
from sliplens.explainers.gradients import ExpectedGradients, IntegratedGradients, SmoothGrad
from sliplens.explainers.occlusion import Occlusion
from sliplens.explainers.shapley import Shapley
from sliplens.explainers.table import EXPLAINERS, get_explainer

SHORT = IntegratedGradients(steps=8, max_steps=40)
MARKERS = torch.tensor([[10.0, 12.0], [40.0, 20.0], [25.0, 50.0]])
DEFAULTS = {name: get_explainer(name) for name in EXPLAINERS}
QUICK = {
    "integrated-gradients": SHORT,
    "expected-gradients": ExpectedGradients(steps=8, max_steps=40),
    "smooth-grad": SmoothGrad(samples=2),
    "occlusion": Occlusion(tile_px=32),
    "occlusion-marker": Occlusion(markers_px=MARKERS),
    "shapley": Shapley(tile_px=32),
    "shapley-marker": Shapley(markers_px=MARKERS, pairs=8),
}


def saliency(attribution: Attribution) -> torch.Tensor:
    """Supporting evidence over its largest value, as `Explanation.saliency`."""
    supporting = torch.relu(attribution.influence)
    return supporting / supporting.amax(dim=(1, 2), keepdim=True).clamp_min(1e-30)
