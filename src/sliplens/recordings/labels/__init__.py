"""Labels from force samples and frames: axes, lag, friction, safety margins with uncertainty, the reference frame."""

from sliplens.recordings.labelling import ForceAxes, Found, FrictionEstimate, Lag, Reason
from sliplens.recordings.labels.axes import ContactForces, apply_axes, infer_axes
from sliplens.recordings.labels.friction import ImageMotion, estimate_friction
from sliplens.recordings.labels.lag import describe_repeats, estimate_lag, measure_motion
from sliplens.recordings.labels.margin import LARGEST_SIGMA, FoundLabels, label_frames, label_trial, require_inside
from sliplens.recordings.labels.reference import choose_reference
from sliplens.recordings.options import LabelSettings

__all__ = [
    "LARGEST_SIGMA", "ContactForces", "ForceAxes", "Found", "FoundLabels", "FrictionEstimate", "ImageMotion",
    "LabelSettings", "Lag", "Reason", "apply_axes", "choose_reference", "describe_repeats", "estimate_friction",
    "estimate_lag", "infer_axes", "label_frames", "label_trial", "measure_motion", "require_inside",
]  # fmt: skip
