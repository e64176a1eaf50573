"""Networks that read the safety margin, their checkpoints, and the engines that run them."""

from sliplens.models.backbones import build_model
from sliplens.models.checkpoint import Estimate, Manifest, Network, Ratio, load, save_checkpoint
from sliplens.models.engines import ENGINES, Engine, make_engine, prepare
from sliplens.models.onnx import export_onnx
from sliplens.models.predictions import Predictions, predict

__all__ = [
    "ENGINES", "Engine", "Estimate", "Manifest", "Network", "Predictions", "Ratio", "build_model",
    "export_onnx", "load", "make_engine", "predict", "prepare", "save_checkpoint",
]  # fmt: skip
