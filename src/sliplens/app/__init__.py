"""Pages in a browser: of a running sensor, of a simulated gripper, and one on which labels are repaired by hand."""

from sliplens.app.gripper import GripSource
from sliplens.app.labels import LabelPage
from sliplens.app.server import LivePage

__all__ = ["GripSource", "LabelPage", "LivePage"]
