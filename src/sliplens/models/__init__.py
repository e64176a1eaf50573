"""Networks that read the safety margin, and their checkpoints."""

from sliplens.models.backbones import build_model
from sliplens.models.checkpoint import Manifest, TrainedModel, load_checkpoint, save_checkpoint

__all__ = ["Manifest", "TrainedModel", "build_model", "load_checkpoint", "save_checkpoint"]
