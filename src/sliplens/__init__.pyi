"""Public names of sliplens and the modules that define them."""

from ._version import __version__ as __version__
from .demo import run_demo as run_demo
from .errors import SliplensError as SliplensError
from .friction import Friction as Friction
from .grip.episodes import run_episodes as run_episodes
from .grip.hold import hold_grip as hold_grip
from .live.loop import LiveReader as LiveReader
from .live.loop import read_live as read_live
from .live.slip_clips import evaluate_slip as evaluate_slip
from .live.viewer import view as view
from .markers.tracking import track as track
from .models.checkpoint import load as load
from .models.onnx import export_onnx as export_onnx
from .models.predictions import predict as predict
from .models.wrapping import wrap as wrap
from .plots.figure import make_profile as make_profile
from .plots.figure import plot as plot
from .recordings.check import check_dataset as check_dataset
from .recordings.corrections import draft_corrections as draft_corrections
from .recordings.corrections import label_dataset as label_dataset
from .recordings.dataset import load_dataset as load_dataset
from .recordings.dataset import recover_dataset as recover_dataset
from .recordings.importing import import_recordings as import_recordings
from .recordings.splits import split_dataset as split_dataset
from .report.page import write_report as write_report
from .results.study import StudyConfig as StudyConfig
from .simulation.trials import simulate as simulate
from .study.explaining import explain as explain
from .study.run import run_study as run_study
from .study.scoring import score as score
from .training.evaluation import evaluate as evaluate
from .training.fitting import train as train

__all__: list[str]
