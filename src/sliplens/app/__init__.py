"""The page of a running sensor: its margin as a number, its picture with what the network looks at, and its health."""

from sliplens.app.server import LivePage

__all__ = ["LivePage"]
