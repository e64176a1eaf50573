"""sliplens: how close a soft fingertip is to losing its grip, from its camera images, and why the network says so."""

from typing import TYPE_CHECKING, Any

from sliplens._version import __version__

if TYPE_CHECKING:
    from sliplens.models.checkpoint import load

__all__ = ["__version__", "load"]


def __getattr__(name: str) -> Any:
    """Find `load` when it is asked for: importing sliplens alone imports neither torch nor NumPy."""
    if name == "load":
        from sliplens.models.checkpoint import load  # noqa: PLC0415 (that is the point)

        return load
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
