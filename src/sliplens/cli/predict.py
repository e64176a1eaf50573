"""`sliplens predict`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from sliplens.cli.console import Terminal, wrote


@dataclass(frozen=True, kw_only=True)
class Predict:
    """Read the safety margin of every frame: of a data set, a folder of images, a video, or any recording.

    Writes a row a frame: trial, frame, time, prediction, and how sure the network is, where it tells. Memory does not
    grow with the recording.
    """

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="run", metavar="RUN")]
    """Folder of a trained network."""
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Data set, folder of images, video, ROS 2 bag, or whatever `sliplens import` reads."""
    output: Annotated[Path, tyro.conf.arg(aliases=("-o",), metavar="FILE.parquet")]
    """File to write."""
    reference: Path | None = None
    """Image of the untouched sensor. Images of a folder without it are taken for difference images."""
    reference_frame: int | None = None
    """Number of the frame that shows the untouched sensor, in place of --reference."""
    split: str | None = None
    """Trials of a data set; all if not given."""
    engine: Literal["auto", "eager", "folded", "compiled", "onnxruntime", "openvino"] = "auto"
    """What runs the network; auto is the fastest at hand."""
    onnx: Annotated[Path | None, tyro.conf.arg(metavar="FILE.onnx")] = None
    """The network as `sliplens export` wrote it, which onnxruntime and openvino otherwise wait for."""
    batch_size: int = 8
    """Frames predicted together; on a processor more are slower, their layers no longer fit its cache."""
    device: str = "cpu"
    """cpu or cuda."""
    format: str | None = None
    """rosbag, lerobot, thesis, gelsight, images or video; recognised if not given."""
    frame_rate: float | None = None
    """Frames a second, for images, or where a video's stamps are missing or wrong."""
    image_topic: str | None = None
    """Topic of the images; the only one if not given."""
    camera_key: str | None = None
    """Feature of a LeRobot data set with the images."""
    overwrite: bool = False
    """Write the file anew if it exists."""

    def run(self) -> None:
        """Predict and write."""
        from sliplens.models.predictions import predict
        from sliplens.recordings.options import ReadOptions

        predictions = predict(
            self.model,
            self.source,
            reference=self.reference,
            reference_frame=self.reference_frame,
            split=self.split,
            format=self.format,
            options=ReadOptions(frame_rate=self.frame_rate, image_topic=self.image_topic, camera_key=self.camera_key),
            engine=self.engine,
            onnx_file=self.onnx,
            batch_size=self.batch_size,
            device=self.device,
            out=self.output,
            overwrite=self.overwrite,
            on_progress=Terminal(),
        )
        wrote(self.output, f"{predictions.frames:,} frames, by {predictions.engine}")
