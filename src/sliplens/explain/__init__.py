"""Why the network predicts this margin: explanations of f(x) - f(reference), signed and in margin units."""

from sliplens.explain.cam import GradCam
from sliplens.explain.explanation import Explainer, Explanation, Level, Progress
from sliplens.explain.gradients import IntegratedGradients
from sliplens.explain.layers import Layer, capture, find_layers
from sliplens.explain.poly_cam import PolyCam

EXPLAINERS: dict[str, Explainer] = {
    "grad-cam": GradCam(),
    "integrated-gradients": IntegratedGradients(),
    "poly-cam": PolyCam(),
}
"""The explainers by name, with their default options; use `dataclasses.replace` for others."""

__all__ = [
    "EXPLAINERS",
    "Explainer",
    "Explanation",
    "GradCam",
    "IntegratedGradients",
    "Layer",
    "Level",
    "PolyCam",
    "Progress",
    "capture",
    "find_layers",
]
