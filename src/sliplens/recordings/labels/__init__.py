"""Labels from force samples and frames: axes, lag, friction, safety margins with uncertainty, the reference frame."""

from sliplens.recordings.labels.axes import ContactForces, ForceAxes, Found, apply_axes, infer_axes
from sliplens.recordings.labels.friction import FrictionEstimate, ImageMotion, estimate_friction, given_friction
from sliplens.recordings.labels.labelling import LabelSettings, label_trial
from sliplens.recordings.labels.lag import Lag, estimate_lag, given_lag, image_motion, measure_motion
from sliplens.recordings.labels.margin import Labels, Reason, contact_threshold, label_frames
from sliplens.recordings.labels.reference import REFERENCES, Reference, choose_reference

__all__ = [
    "REFERENCES",
    "ContactForces",
    "ForceAxes",
    "Found",
    "FrictionEstimate",
    "ImageMotion",
    "LabelSettings",
    "Labels",
    "Lag",
    "Reason",
    "Reference",
    "apply_axes",
    "choose_reference",
    "contact_threshold",
    "estimate_friction",
    "estimate_lag",
    "given_friction",
    "given_lag",
    "image_motion",
    "infer_axes",
    "label_frames",
    "label_trial",
    "measure_motion",
]
