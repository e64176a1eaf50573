"""Recordings: trials of a tactile sensor with forces and slip labels, in memory and on disk."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sliplens.recordings.check import check_dataset
    from sliplens.recordings.dataset import Dataset, TrialInfo, load_dataset
    from sliplens.recordings.exporting import Export, export_lerobot, export_mcap
    from sliplens.recordings.importing import import_recordings, label_dataset
    from sliplens.recordings.labelling import Labelling
    from sliplens.recordings.options import LabelSettings, ReadOptions
    from sliplens.recordings.splits import split_dataset
    from sliplens.recordings.trial import ContactState, GroundTruth, Labels, Recording, TrialFacts

# where each name lives: asking for options alone, as the command line's help does, reads no file format
_MODULES = {
    "ContactState": "trial",
    "Dataset": "dataset",
    "Export": "exporting",
    "GroundTruth": "trial",
    "LabelSettings": "options",
    "Labelling": "labelling",
    "Labels": "trial",
    "ReadOptions": "options",
    "Recording": "trial",
    "TrialFacts": "trial",
    "TrialInfo": "dataset",
    "check_dataset": "check",
    "export_lerobot": "exporting",
    "export_mcap": "exporting",
    "import_recordings": "importing",
    "label_dataset": "importing",
    "load_dataset": "dataset",
    "split_dataset": "splits",
}

__all__ = [
    "ContactState",
    "Dataset",
    "Export",
    "GroundTruth",
    "LabelSettings",
    "Labelling",
    "Labels",
    "ReadOptions",
    "Recording",
    "TrialFacts",
    "TrialInfo",
    "check_dataset",
    "export_lerobot",
    "export_mcap",
    "import_recordings",
    "label_dataset",
    "load_dataset",
    "split_dataset",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is asked for."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
