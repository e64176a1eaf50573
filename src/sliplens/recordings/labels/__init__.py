"""Labels from force samples and frames: axes, lag, friction, safety margins with uncertainty, the reference frame."""

from sliplens.recordings.labels.axes import ForceAxes, Found, infer_axes
from sliplens.recordings.labels.contact import ContactForces, apply_axes
from sliplens.recordings.labels.friction import FrictionEstimate, ImageMotion, estimate_friction, given_friction
from sliplens.recordings.labels.lag import Lag, estimate_lag, given_lag
from sliplens.recordings.labels.margin import Labels, Reason, contact_threshold, label_frames
from sliplens.recordings.labels.motion import image_motion, measure_motion
from sliplens.recordings.labels.reference import REFERENCES, Reference, choose_reference
from sliplens.recordings.labels.trial import LabelSettings, label_trial

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
