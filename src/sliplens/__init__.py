"""sliplens: how close a soft fingertip is to losing its grip, from its camera images, and why the network says so."""

from sliplens._version import __version__

__all__ = ["__version__"]
