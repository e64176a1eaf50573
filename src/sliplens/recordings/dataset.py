"""A data set on disk: one Parquet file a trial, frames as lossless PNG beside their labels."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from sliplens.errors import RecordingError
from sliplens.files import hash_file, hash_json, read_json, require_folder, write_json
from sliplens.recordings.capture import forces_path
from sliplens.recordings.store import SCHEMA_VERSION, load_recording, read_header, reading
from sliplens.recordings.trial import Recording

DATASET_FILE = "dataset.json"


@dataclass(frozen=True, kw_only=True)
class TrialInfo:
    """What the data set's table says of one trial."""

    trial: str
    sensor: str
    day: int
    condition: str
    split: str
    frames: int
    height: int
    width: int
    sha256: str
    object: str = ""
    """What was held; empty where it is not told."""
    forces_sha256: str = ""
    """Hash of the samples of the force sensor; empty where none are kept."""


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """A data set on disk; trials are read one at a time."""

    folder: Path
    trials: tuple[TrialInfo, ...]
    simulated: bool = False

    @classmethod
    def open(cls, folder: Path) -> "Dataset":
        """Open a data set that `save_recording` and `write_dataset_table` made.

        Raises
        ------
        InputError
            If the folder or its table is missing.
        RecordingError
            If the table is of another schema, or lists no trial.
        """
        require_folder(folder, what="the data set")
        table = read_json(folder / DATASET_FILE)
        if not isinstance(table, dict) or table.get("schema_version") != SCHEMA_VERSION:
            raise RecordingError(f"{folder / DATASET_FILE} is not a sliplens data set of schema {SCHEMA_VERSION}")
        if not table.get("trials"):
            raise RecordingError(f"{folder} lists no trials; make or import a data set first")
        try:
            trials = tuple(TrialInfo(**row) for row in table["trials"])
        except TypeError as error:
            raise RecordingError(f"{folder / DATASET_FILE} has a malformed trial ({error})") from None
        return cls(folder=folder, trials=trials, simulated=bool(table.get("simulated")))

    @property
    def source(self) -> str:
        """Where the frames come from, as results tell it: "simulated" or "real"."""
        return "simulated" if self.simulated else "real"

    @property
    def hash(self) -> str:
        """Hash of the table, which holds the hash of every trial: the same data, the same hash."""
        return hash_json([asdict(trial) for trial in self.trials])

    def select(self, *, split: str | None = None, condition: str | None = None) -> tuple[TrialInfo, ...]:
        """Trials of a split and a condition.

        Raises
        ------
        RecordingError
            If there is none; the message lists what there is.
        """
        chosen = tuple(
            trial
            for trial in self.trials
            if (split is None or trial.split == split) and (condition is None or trial.condition == condition)
        )
        if not chosen:
            present = sorted({f"{trial.split}/{trial.condition}" for trial in self.trials})
            raise RecordingError(
                f"{self.folder} has no trial with split {split or 'any'} and condition {condition or 'any'}; "
                f"it has {', '.join(present)}"
            )
        return chosen

    def load(self, info: TrialInfo, *, truth: bool = True) -> Recording:
        """Read one trial, frames included; without the ground truth of a simulated one where that is not needed."""
        return load_recording(trial_path(self.folder, info.trial), truth=truth)

    def load_all(self, trials: Sequence[TrialInfo], *, truth: bool = True) -> Iterator[Recording]:
        """Read trials one after another."""
        return (self.load(info, truth=truth) for info in trials)


def trial_path(folder: Path, trial: str) -> Path:
    """File that holds a trial of a data set."""
    return folder / "trials" / f"{trial}.parquet"


def count_labelled(path: Path) -> int:
    """Count the frames of a trial that have a safety margin, and one that can be trusted, without reading its images.

    Raises
    ------
    RecordingError
        If the file is missing or damaged.
    """
    with reading(path):
        names = [name for name in ("safety_margin", "valid") if name in pq.read_schema(path).names]
        table = pq.read_table(path, columns=names)
    columns = {name: table.column(name).to_numpy() for name in names}
    present = np.isfinite(columns["safety_margin"].astype(np.float64))
    return int(np.sum(present & columns["valid"] if "valid" in columns else present))


def trial_info(path: Path, *, split: str) -> TrialInfo:
    """Row of the data set's table for a trial saved at `path`.

    Raises
    ------
    RecordingError
        If the file is missing or damaged, or no trial.
    """
    header = asdict(read_header(path))
    del header["recipe"]
    samples = forces_path(path.parent.parent, path.stem)
    return TrialInfo(
        **header,
        split=split,
        sha256=hash_file(path),
        forces_sha256=hash_file(samples) if samples.is_file() else "",
    )


def write_dataset_table(folder: Path, trials: Sequence[TrialInfo], *, simulated: bool = False) -> None:
    """Write `dataset.json`, the last file of a data set."""
    units = {"time_s": "s", "normal_force_n": "N", "tangential_force_n": "N"}
    write_json(
        folder / DATASET_FILE,
        {
            "schema_version": SCHEMA_VERSION,
            "simulated": simulated,
            "units": units,
            "trials": [asdict(trial) for trial in trials],
        },
    )
