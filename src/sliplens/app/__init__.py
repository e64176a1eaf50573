"""Page in a browser: the live readings of a running sensor."""

from sliplens.app.server import LivePage

__all__ = ["LivePage"]
