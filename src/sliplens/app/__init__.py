"""Pages in a browser: of a running sensor, and one on which labels are repaired by hand."""

from sliplens.app.labels import LabelPage
from sliplens.app.server import LivePage

__all__ = ["LabelPage", "LivePage"]
