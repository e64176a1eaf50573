"""`sliplens export`."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sliplens.cli.console import OUT, progress_bar, unchanged, wrote
from sliplens.errors import InputError

if TYPE_CHECKING:
    from sliplens.recordings import Dataset, TrialInfo

_RUN_FILES = {"lerobot": "meta/sliplens/run.json", "mcap": "run.json"}
"""Where our record goes: LeRobot reads what `meta` holds by name, and tools for MCAP open single files."""
_NAMED = 10


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write a network or a data set for other programs.

    A network becomes an ONNX file (--onnx), checked against the network before it appears; needs the extra `onnx`. A
    data set becomes a LeRobot data set (--lerobot) or MCAP files (--mcap, the extra `ros`), without loss.
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Folder of a trained network, or data set."""
    output: Annotated[Path, tyro.conf.arg(aliases=("-o",))]
    """File to write (--onnx), or folder to make."""
    onnx: bool = False
    """The network as an ONNX file, for ONNX Runtime or OpenVINO, from C++ or Python."""
    lerobot: bool = False
    """The data set as a LeRobot v3 data set, one episode a trial."""
    mcap: bool = False
    """The data set as MCAP files of ROS 2 messages, one a trial."""
    trials: tuple[str, ...] = ()
    """Names of trials of the data set; all if not given."""
    overwrite: bool = False
    """Replace the output if it exists."""

    def run(self) -> None:
        """Export."""
        kinds = [name for name in ("onnx", "lerobot", "mcap") if getattr(self, name)]
        if len(kinds) != 1:
            said = " and ".join(f"--{name}" for name in kinds) or "none"
            raise InputError(f"say what to write with one of --onnx, --lerobot and --mcap, got {said}")
        if kinds[0] == "onnx":
            self._export_network()
        else:
            self._export_data(kinds[0])

    def _export_network(self) -> None:
        from sliplens.models.checkpoint import load
        from sliplens.models.onnx import export_onnx

        if _is_data(self.source) and not _is_run(self.source):
            raise InputError(
                f"{self.source} is a data set, and --onnx writes a network; name the folder of a run, "
                "or choose --lerobot or --mcap"
            )
        if self.trials:
            raise InputError("--trials chooses trials of a data set; leave it out with --onnx")
        trained = load(self.source)
        with OUT.status("Exporting and comparing"):
            export_onnx(trained, self.output, overwrite=self.overwrite)
        manifest = trained.manifest
        wrote(
            self.output,
            f"{manifest.backbone}, {manifest.head} head, {manifest.image_size} px, {manifest.input} images; "
            "answers as the network does in ONNX Runtime",
        )

    def _export_data(self, kind: str) -> None:
        from sliplens.files import exported_folder
        from sliplens.recordings import Dataset

        if _is_run(self.source) and not _is_data(self.source):
            raise InputError(
                f"{self.source} is a run, and --{kind} writes a data set; name a data set, or choose --onnx"
            )
        data = Dataset.open(self.source)
        chosen = self._choose(data)
        config = {"format": kind, "data_hash": data.hash, "trials": [info.trial for info in chosen]}
        with exported_folder(self.output, run_file=_RUN_FILES[kind], config=config, overwrite=self.overwrite) as out:
            if out.complete:
                unchanged(self.output)
                return
            with progress_bar("Writing frames") as bar:
                _writer(kind)(data, out.folder, trials=chosen, on_frames=bar)
        frames = sum(info.frames for info in chosen)
        wrote(self.output, f"{len(chosen)} trials, {frames:,} frames")

    def _choose(self, data: "Dataset") -> "tuple[TrialInfo, ...]":
        if not self.trials:
            return data.trials
        by_name = {info.trial: info for info in data.trials}
        for name in self.trials:
            if name not in by_name:
                more = f" and {len(by_name) - _NAMED} more" if len(by_name) > _NAMED else ""
                raise InputError(f"{self.source} has no trial {name}; it has {', '.join(list(by_name)[:_NAMED])}{more}")
        return tuple(by_name[name] for name in dict.fromkeys(self.trials))


def _writer(kind: str) -> Callable[..., None]:
    if kind == "mcap":
        from sliplens.recordings.formats.mcap import write_mcap

        return write_mcap
    from sliplens.recordings.formats.lerobot_export import write_lerobot

    return write_lerobot


def _is_run(source: Path) -> bool:
    return (source / "manifest.json").is_file()


def _is_data(source: Path) -> bool:
    from sliplens.recordings.dataset import DATASET_FILE

    return (source / DATASET_FILE).is_file()
