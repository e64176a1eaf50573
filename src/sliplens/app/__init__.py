"""Pages in a browser: that of a running sensor, and that on which labels are repaired by hand."""

from sliplens.app.labels import LabelPage
from sliplens.app.server import LivePage

__all__ = ["LabelPage", "LivePage"]
