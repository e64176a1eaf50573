"""Markers: detection, tracking, displacement fields, and traction."""

from sliplens.markers.detect import KINDS, Appearance, MarkerKind, Markers, detect_markers
from sliplens.markers.tracker import Tracker, track_markers
from sliplens.markers.tracks import DisplacementField, MarkerStatus, TrackedFrame, Tracks, interpolate_field
from sliplens.markers.traction import Traction, TractionModel, calibrate_traction

__all__ = [
    "KINDS", "Appearance", "DisplacementField", "MarkerKind", "MarkerStatus", "Markers", "TrackedFrame", "Tracker",
    "Tracks", "Traction", "TractionModel", "calibrate_traction", "detect_markers", "interpolate_field",
    "track_markers",
]  # fmt: skip
