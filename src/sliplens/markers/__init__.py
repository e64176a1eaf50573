"""Markers: detection, tracking, and traction."""

from sliplens.markers.detect import KINDS, Appearance, MarkerKind, Markers, detect_markers
from sliplens.markers.estimators import MarkerTraction, TractionModel, calibrate_traction
from sliplens.markers.tracker import MarkerStatus, Tracker, Tracks, track_markers

__all__ = [
    "KINDS", "Appearance", "MarkerKind", "MarkerStatus", "MarkerTraction", "Markers", "Tracker", "Tracks",
    "TractionModel", "calibrate_traction", "detect_markers", "track_markers",
]  # fmt: skip
