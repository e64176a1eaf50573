"""sliplens: how close a soft fingertip is to losing its grip, from its camera images, and why the network says so."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sliplens._version import __version__

if TYPE_CHECKING:
    from sliplens.errors import SliplensError
    from sliplens.explainers.table import explain
    from sliplens.faithfulness.scoring import score
    from sliplens.markers.tracking import track
    from sliplens.models.checkpoint import load
    from sliplens.models.onnx import export_onnx
    from sliplens.models.predictions import predict
    from sliplens.training.evaluate import evaluate
    from sliplens.training.fit import train

# where each name lives: importing sliplens alone imports neither torch nor NumPy
_MODULES = {
    "evaluate": "sliplens.training.evaluate",
    "explain": "sliplens.explainers.table",
    "export_onnx": "sliplens.models.onnx",
    "load": "sliplens.models.checkpoint",
    "predict": "sliplens.models.predictions",
    "score": "sliplens.faithfulness.scoring",
    "SliplensError": "sliplens.errors",
    "track": "sliplens.markers.tracking",
    "train": "sliplens.training.fit",
}

__all__ = [
    "SliplensError",
    "__version__",
    "evaluate",
    "explain",
    "export_onnx",
    "load",
    "predict",
    "score",
    "track",
    "train",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is asked for."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return __all__
