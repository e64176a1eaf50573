"""sliplens: how close a soft fingertip is to losing its grip, from its camera images, and why the network says so."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sliplens._version import __version__

if TYPE_CHECKING:
    from sliplens.demo import run_demo
    from sliplens.doctor import examine_installation
    from sliplens.errors import SliplensError
    from sliplens.friction import Friction
    from sliplens.grip.episodes import run_episodes
    from sliplens.grip.hold import hold_grip
    from sliplens.live.loop import LiveReader, read_live
    from sliplens.live.viewer import view
    from sliplens.markers.tracking import track
    from sliplens.models.checkpoint import load
    from sliplens.models.onnx import export_onnx
    from sliplens.models.predictions import predict
    from sliplens.plots.figure import make_profile, plot
    from sliplens.recordings.check import check_dataset
    from sliplens.recordings.corrections import draft_corrections, label_dataset
    from sliplens.recordings.dataset import load_dataset, recover_dataset
    from sliplens.recordings.exporting import export_lerobot, export_mcap
    from sliplens.recordings.importing import import_recordings
    from sliplens.recordings.splits import split_dataset
    from sliplens.report.page import write_report
    from sliplens.results.study import StudyConfig
    from sliplens.runner import read_status
    from sliplens.simulation.sharing import compare_datasets
    from sliplens.simulation.trials import simulate
    from sliplens.study.diagnose import diagnose
    from sliplens.study.explaining import explain
    from sliplens.study.run import run_study
    from sliplens.study.scoring import score
    from sliplens.training.evaluation import evaluate
    from sliplens.training.fitting import train

# where each name lives: importing sliplens alone imports neither torch nor NumPy
_MODULES = {
    "LiveReader": "sliplens.live.loop",
    "Friction": "sliplens.friction",
    "SliplensError": "sliplens.errors",
    "StudyConfig": "sliplens.results.study",
    "check_dataset": "sliplens.recordings.check",
    "compare_datasets": "sliplens.simulation.sharing",
    "diagnose": "sliplens.study.diagnose",
    "draft_corrections": "sliplens.recordings.corrections",
    "evaluate": "sliplens.training.evaluation",
    "examine_installation": "sliplens.doctor",
    "explain": "sliplens.study.explaining",
    "export_lerobot": "sliplens.recordings.exporting",
    "export_mcap": "sliplens.recordings.exporting",
    "export_onnx": "sliplens.models.onnx",
    "hold_grip": "sliplens.grip.hold",
    "import_recordings": "sliplens.recordings.importing",
    "label_dataset": "sliplens.recordings.corrections",
    "load": "sliplens.models.checkpoint",
    "load_dataset": "sliplens.recordings.dataset",
    "make_profile": "sliplens.plots.figure",
    "plot": "sliplens.plots.figure",
    "predict": "sliplens.models.predictions",
    "read_live": "sliplens.live.loop",
    "read_status": "sliplens.runner",
    "recover_dataset": "sliplens.recordings.dataset",
    "run_episodes": "sliplens.grip.episodes",
    "run_study": "sliplens.study.run",
    "score": "sliplens.study.scoring",
    "run_demo": "sliplens.demo",
    "simulate": "sliplens.simulation.trials",
    "split_dataset": "sliplens.recordings.splits",
    "track": "sliplens.markers.tracking",
    "train": "sliplens.training.fitting",
    "view": "sliplens.live.viewer",
    "write_report": "sliplens.report.page",
}

__all__ = [
    "Friction",
    "LiveReader",
    "SliplensError",
    "StudyConfig",
    "__version__",
    "check_dataset",
    "compare_datasets",
    "diagnose",
    "draft_corrections",
    "evaluate",
    "examine_installation",
    "explain",
    "export_lerobot",
    "export_mcap",
    "export_onnx",
    "hold_grip",
    "import_recordings",
    "label_dataset",
    "load",
    "load_dataset",
    "make_profile",
    "plot",
    "predict",
    "read_live",
    "read_status",
    "recover_dataset",
    "run_demo",
    "run_episodes",
    "run_study",
    "score",
    "simulate",
    "split_dataset",
    "track",
    "train",
    "view",
    "write_report",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is asked for."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return __all__
