"""Live margin of a running sensor: sources, the loop that reads them, its health, and outputs."""

from sliplens.live.contract import LiveOptions, LiveSource, SourceKind
from sliplens.live.health import HealthMonitor
from sliplens.live.loop import LiveReader, read_live
from sliplens.live.mailbox import Outlet
from sliplens.live.reading import Check, Latency, LiveFrame, MarkerReading, Reading, SlipState
from sliplens.live.recorder import ForceStream, Recorder
from sliplens.live.slip import SlipDetector
from sliplens.live.sources import SOURCES, CameraSource, ReplaySource, SimulatedSource, list_cameras, open_live

__all__ = [
    "SOURCES", "CameraSource", "Check", "ForceStream", "HealthMonitor", "Latency", "LiveFrame", "LiveOptions",
    "LiveReader", "LiveSource", "MarkerReading", "Outlet", "Reading", "Recorder", "ReplaySource", "SimulatedSource",
    "SlipDetector", "SlipState", "SourceKind", "list_cameras", "open_live", "read_live",
]  # fmt: skip
