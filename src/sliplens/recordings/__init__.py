"""Recordings: trials of a tactile sensor with forces and slip labels, in memory and on disk."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sliplens.recordings.check import check_dataset
    from sliplens.recordings.corrections import draft_corrections, label_dataset, read_corrections
    from sliplens.recordings.dataset import Dataset, TrialInfo, load_dataset, recover_dataset
    from sliplens.recordings.exporting import Export, export_lerobot, export_mcap
    from sliplens.recordings.importing import import_recordings
    from sliplens.recordings.labelling import Corrections, Labelling
    from sliplens.recordings.options import LabelSettings, ReadOptions
    from sliplens.recordings.splits import split_dataset
    from sliplens.recordings.trial import ContactState, GroundTruth, Labels, Recording, TrialFacts

# module of each name: importing the options alone, as the help of the command line does, imports no file format
_NAMES = {
    "check": ("check_dataset",),
    "corrections": ("draft_corrections", "label_dataset", "read_corrections"),
    "dataset": ("Dataset", "TrialInfo", "load_dataset", "recover_dataset"),
    "exporting": ("Export", "export_lerobot", "export_mcap"),
    "importing": ("import_recordings",),
    "labelling": ("Corrections", "Labelling"),
    "options": ("LabelSettings", "ReadOptions"),
    "splits": ("split_dataset",),
    "trial": ("ContactState", "GroundTruth", "Labels", "Recording", "TrialFacts"),
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names}

__all__ = [
    "ContactState", "Corrections", "Dataset", "Export", "GroundTruth", "LabelSettings", "Labelling", "Labels",
    "ReadOptions", "Recording", "TrialFacts", "TrialInfo", "check_dataset", "draft_corrections", "export_lerobot",
    "export_mcap", "import_recordings", "label_dataset", "load_dataset", "read_corrections", "recover_dataset",
    "split_dataset",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import a public name on first use."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
