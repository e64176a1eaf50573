"""Markers: detection, tracking, displacement fields, and estimators of the margin."""

from sliplens.markers.detect import KINDS, Appearance, MarkerKind, Markers, detect_markers
from sliplens.markers.tracker import Tracker, track_markers
from sliplens.markers.tracks import DisplacementField, MarkerStatus, TrackedFrame, Tracks, interpolate_field

__all__ = [
    "KINDS", "Appearance", "DisplacementField", "MarkerKind", "MarkerStatus", "Markers", "TrackedFrame",
    "Tracker", "Tracks", "detect_markers", "interpolate_field", "track_markers",
]  # fmt: skip
