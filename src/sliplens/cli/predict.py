"""`sliplens predict`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sliplens._version import __version__
from sliplens.cli.console import OUT, progress_bar, say, wrote
from sliplens.cli.devices import require_device
from sliplens.errors import InputError
from sliplens.files import hash_file

if TYPE_CHECKING:
    from sliplens.models.sources import SourceOptions


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
    engine: Literal["eager", "folded", "compiled", "onnxruntime", "openvino"] | None = None
    """What runs the network; the fastest at hand if not given."""
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
        from sliplens.models import load_checkpoint
        from sliplens.models.checkpoint import find_run
        from sliplens.models.engines import fastest_engine, make_engine
        from sliplens.models.predict import write_predictions
        from sliplens.models.sources import open_source

        self._check()
        run = find_run(self.model)
        trained = load_checkpoint(run, device=self.device)
        with OUT.status("Opening the source"):
            source = open_source(self.source, trained, self._options())
        for note in source.notes:
            say(f"note: {note}")
        name = self.engine or fastest_engine(trained, onnx_file=self.onnx, frames=source.frames)
        with OUT.status(f"Making {name} ready"):
            engine = make_engine(name, trained, onnx_file=self.onnx)
        metadata = {
            "sliplens.version": __version__,
            "sliplens.engine": name,
            "sliplens.source": str(self.source),
            "sliplens.manifest_sha256": hash_file(run / "manifest.json"),
            "sliplens.weights_sha256": trained.manifest.weights_sha256,
        }
        with progress_bar(f"Predicting frames ({trained.manifest.input}, {name})") as bar:
            write_predictions(engine, source, self.output, metadata=metadata, batch_size=self.batch_size, on_frames=bar)
        wrote(self.output, f"{source.frames:,} frames, by {name}")

    def _check(self) -> None:
        if self.output.suffix != ".parquet":
            raise InputError(f"{self.output} does not end in .parquet; name the file to write so")
        if self.output.exists() and not self.overwrite:
            raise InputError(f"{self.output} exists; choose another file or pass --overwrite")
        if self.batch_size < 1:
            raise InputError(f"--batch-size must be at least 1, got {self.batch_size}")
        if self.onnx is not None and self.engine not in {None, "onnxruntime", "openvino"}:
            raise InputError(f"--onnx is for onnxruntime and openvino, not for {self.engine}; leave it out")
        require_device(self.device)

    def _options(self) -> "SourceOptions":
        from sliplens.models.sources import SourceOptions
        from sliplens.recordings.formats import ReadOptions

        return SourceOptions(
            split=self.split,
            reference=self.reference,
            reference_frame=self.reference_frame,
            format=self.format,
            read=ReadOptions(frame_rate=self.frame_rate, image_topic=self.image_topic, camera_key=self.camera_key),
        )
