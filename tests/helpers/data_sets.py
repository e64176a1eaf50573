"""Data sets of trials that a test has made, and what their folders hold."""

from collections.abc import Sequence
from pathlib import Path

from sliplens.recordings import Dataset, Recording, load_dataset
from sliplens.recordings.dataset import trial_info, trial_path, write_dataset_table
from sliplens.recordings.store import save_recording


def save_dataset(
    folder: Path, *recordings: Recording, split: str | Sequence[str] = "train", simulated: bool = False
) -> Dataset:
    """Write trials and their table into a folder; they are all of one split, or each of its own."""
    table = []
    for recording, name in zip(recordings, [split] * len(recordings) if isinstance(split, str) else split, strict=True):
        save_recording(recording, path := trial_path(folder, recording.trial))
        table.append(trial_info(path, split=name))
    write_dataset_table(folder, table, simulated=simulated)
    return load_dataset(folder)


def contents(folder: Path) -> dict[str, bytes]:
    """Bytes of every file of a folder, by its path there."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
