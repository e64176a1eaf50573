"""The margin of a running sensor: sources, the loop that reads them, and what it says of its own health."""

from sliplens.live.loop import LiveReader, read_live
from sliplens.live.reading import Check, Latency, LiveFrame, Reading, SlipState
from sliplens.live.sources import (
    SOURCES,
    LiveSource,
    ReplaySource,
    SimulatedSource,
    SourceKind,
    SourceOptions,
    open_live,
)

__all__ = [
    "SOURCES", "Check", "Latency", "LiveFrame", "LiveReader", "LiveSource", "Reading", "ReplaySource",
    "SimulatedSource", "SlipState", "SourceKind", "SourceOptions", "open_live", "read_live",
]  # fmt: skip
