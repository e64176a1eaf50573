"""`sliplens export`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from sliplens.cli.command import Command, Output, require_network, require_path
from sliplens.cli.console import OUT, wrote
from sliplens.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Export(Command):
    """Write a network or a data set for other programs.

    A network becomes an ONNX file (--onnx), checked against the network before it appears; needs the extra `onnx`. A
    data set becomes a LeRobot data set (--lerobot) or MCAP files (--mcap, the extra `ros`), without loss.
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Folder of a trained network, or data set."""
    output: Output
    """File to write (--onnx), or folder to make."""
    onnx: bool = False
    """The network as an ONNX file, for ONNX Runtime or OpenVINO, from C++ or Python."""
    lerobot: bool = False
    """The data set as a LeRobot v3 data set, one episode a trial."""
    mcap: bool = False
    """The data set as MCAP files of ROS 2 messages, one a trial."""
    trials: tuple[str, ...] = ()
    """Names of trials of the data set; all if not given."""

    def check(self) -> None:
        """Refuse what is wrong at first sight."""
        if self.onnx:
            require_network(self.source)
        elif self.lerobot or self.mcap:
            require_path(self.source, what="the data set")

    def run(self) -> None:
        """Export."""
        from sliplens.recordings.dataset import DATASET_FILE

        kinds = [name for name in ("onnx", "lerobot", "mcap") if getattr(self, name)]
        if len(kinds) != 1:
            options = " and ".join(f"--{name}" for name in kinds) or "none"
            raise InputError(f"choose what to write with one of --onnx, --lerobot and --mcap, got {options}")
        is_run, is_data = ((self.source / name).is_file() for name in ("manifest.json", DATASET_FILE))
        if self.onnx:
            if is_data and not is_run:
                raise InputError(
                    f"{self.source} is a data set, and --onnx writes a network; name the folder of a run, "
                    "or choose --lerobot or --mcap"
                )
            self._export_network()
        else:
            if is_run and not is_data:
                raise InputError(
                    f"{self.source} is a run, and --{kinds[0]} writes a data set; name a data set, or choose --onnx"
                )
            from sliplens.recordings.exporting import export_lerobot, export_mcap

            self.call(export_mcap if self.mcap else export_lerobot, data=self.source, out=self.output)

    def _export_network(self) -> None:
        from sliplens.models.checkpoint import load
        from sliplens.models.onnx import export_onnx

        if self.trials:
            raise InputError("--trials chooses trials of a data set; leave it out with --onnx")
        trained = load(self.source)
        with OUT.status("Exporting and comparing"):
            export_onnx(trained, self.output, overwrite=self.overwrite)
        manifest = trained.manifest
        about = f"{manifest.backbone}, {manifest.head} head, {manifest.image_size} px, {manifest.input} images"
        wrote(self.output, f"{about}; ONNX Runtime predicts the same as the network")
