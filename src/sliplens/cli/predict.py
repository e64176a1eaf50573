"""`sliplens predict`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from sliplens.cli.command import Device, Friction, Network, Source, SourceCommand, TableFile
from sliplens.cli.console import wrote


@dataclass(frozen=True, kw_only=True)
class Predict(SourceCommand):
    """Read the safety margin of every frame: of a data set, a folder of images, a video, or any recording.

    Writes a row a frame: trial, frame, time, prediction, and how sure the network is, where it tells. Memory does not
    grow with the recording. Images of a folder are taken for difference images if no reference is named.
    """

    model: Network
    source: Source
    output: TableFile
    engine: str = "auto"
    """What runs the network: eager, folded, compiled, onnxruntime or openvino; auto takes the fastest at hand."""
    onnx: Annotated[Path | None, tyro.conf.arg(metavar="FILE.onnx")] = None
    """The network as `sliplens export` wrote it; without it onnxruntime and openvino convert the network first."""
    friction: Friction = None
    batch_size: int = 8
    """Frames predicted together; on a CPU more are slower, as they no longer fit its cache."""
    device: Device = "cpu"

    def run(self) -> None:
        """Predict and write."""
        from sliplens.models.predictions import predict

        named = {"run": self.model, "options": self.options, "onnx_file": self.onnx, "out": self.output}
        predictions = self.call(predict, **named)
        wrote(self.output, f"{predictions.frames:,} frames, by {predictions.engine}")
