"""Why the network predicts this margin: explanations of f(x) - f(reference), signed and in margin units."""

from sliplens.explainers.cam import GradCam, HiResCam, Layer, LayerCam, capture, find_layers
from sliplens.explainers.contract import Explainer
from sliplens.explainers.explanation import Approximation, Explanation, Level
from sliplens.explainers.gradients import ExpectedGradients, IntegratedGradients, Lrp, SmoothGrad
from sliplens.explainers.occlusion import Occlusion, find_markers
from sliplens.explainers.poly_cam import PolyCam
from sliplens.explainers.poly_cam_budget import Likeness
from sliplens.explainers.table import EXPLAINERS, RECOMMENDED_METHOD, explain, get_explainer

__all__ = [
    "EXPLAINERS", "RECOMMENDED_METHOD", "Approximation", "ExpectedGradients", "Explainer", "Explanation", "GradCam",
    "HiResCam", "IntegratedGradients", "Layer", "LayerCam", "Level", "Likeness", "Lrp", "Occlusion", "PolyCam",
    "SmoothGrad", "capture", "explain", "find_layers", "find_markers", "get_explainer",
]  # fmt: skip
