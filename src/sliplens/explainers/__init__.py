"""Why the network predicts this margin: explanations of f(x) - f(reference), signed and in margin units."""

from sliplens.explainers.activations import Layer, capture, find_layers
from sliplens.explainers.cam import GradCam, HiResCam, LayerCam
from sliplens.explainers.contract import Explainer
from sliplens.explainers.explanation import Approximation, Explanation, Level
from sliplens.explainers.gradients import ExpectedGradients, IntegratedGradients, SmoothGrad
from sliplens.explainers.lrp import Lrp
from sliplens.explainers.occlusion import Occlusion, find_markers
from sliplens.explainers.poly_cam import PolyCam
from sliplens.explainers.poly_cam_budget import Likeness
from sliplens.extras import Table

_ROWS: dict[str, Explainer] = {
    "grad-cam": GradCam(),
    "integrated-gradients": IntegratedGradients(),
    "poly-cam": PolyCam(),
    "hires-cam": HiResCam(),
    "layer-cam": LayerCam(),
    "expected-gradients": ExpectedGradients(),
    "smooth-grad": SmoothGrad(),
    "occlusion": Occlusion(),
    "occlusion-marker": Occlusion(markers_px=find_markers),
    "lrp": Lrp(),
}
EXPLAINERS = Table("method", "sliplens.explainers", _ROWS)
"""The explainers by name, with their default options; use `dataclasses.replace` for others. `lrp` needs an extra.

An installed package adds its own by the entry point `sliplens.explainers`.
"""

__all__ = [
    "EXPLAINERS",
    "Approximation",
    "ExpectedGradients",
    "Explainer",
    "Explanation",
    "GradCam",
    "HiResCam",
    "IntegratedGradients",
    "Layer",
    "LayerCam",
    "Level",
    "Likeness",
    "Lrp",
    "Occlusion",
    "PolyCam",
    "SmoothGrad",
    "capture",
    "find_layers",
    "find_markers",
]
