"""Why the network predicts this margin: explanations of f(x) - f(reference), signed and in margin units."""

from sliplens.explain.budget import Likeness
from sliplens.explain.cam import GradCam, HiResCam, LayerCam
from sliplens.explain.expected import ExpectedGradients
from sliplens.explain.explanation import Approximation, Explainer, Explanation, Level, Progress
from sliplens.explain.integrated import IntegratedGradients
from sliplens.explain.layers import Layer, find_layers
from sliplens.explain.listening import capture
from sliplens.explain.lrp import Lrp
from sliplens.explain.occlusion import Occlusion
from sliplens.explain.places import find_markers
from sliplens.explain.poly_cam import PolyCam
from sliplens.explain.smooth import SmoothGrad

EXPLAINERS: dict[str, Explainer] = {
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
"""The explainers by name, with their default options; use `dataclasses.replace` for others. `lrp` needs an extra."""

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
    "Progress",
    "SmoothGrad",
    "capture",
    "find_layers",
    "find_markers",
]
