"""A data set on disk: one Parquet file a trial, frames as lossless PNG beside their labels."""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import UInt8

from sliplens.errors import RecordingError
from sliplens.images.files import decode_png, encode_png
from sliplens.provenance import hash_file, hash_json, read_json, require_folder, write_json
from sliplens.recordings.recording import SIGNALS, ContactState, Recording

DATASET_FILE = "dataset.json"
SCHEMA_VERSION = 1
_DESCRIPTION = ("trial", "sensor", "day", "condition")


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

    def load(self, info: TrialInfo) -> Recording:
        """Read one trial, frames included."""
        return load_recording(trial_path(self.folder, info.trial))

    def load_all(self, trials: Sequence[TrialInfo]) -> Iterator[Recording]:
        """Read trials one after another."""
        return (self.load(info) for info in trials)


def trial_path(folder: Path, trial: str) -> Path:
    """File that holds a trial of a data set."""
    return folder / "trials" / f"{trial}.parquet"


def save_recording(recording: Recording, path: Path) -> None:
    """Write a trial as one Parquet file: a row a frame, its image a lossless PNG; whole or not at all."""
    columns: dict[str, Any] = {"frame": np.arange(len(recording))}
    columns |= {name: getattr(recording, name) for name in SIGNALS}
    columns["contact_state"] = [str(state) for state in recording.contact_state]
    with ThreadPoolExecutor() as pool:  # zlib lets go of the interpreter's lock
        columns["image"] = pa.array(list(pool.map(encode_png, recording.frames)), type=pa.binary())
    description = {name: str(getattr(recording, name)) for name in _DESCRIPTION}
    table = pa.table(columns).replace_schema_metadata(
        {**description, b"reference": encode_png(recording.reference), b"schema_version": str(SCHEMA_VERSION)}
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    # PNG bytes, nearly all of the file, neither compress further nor repeat
    pq.write_table(table, part, compression="none", use_dictionary=False)
    part.replace(path)


def load_recording(path: Path) -> Recording:
    """Read a trial written by `save_recording`.

    Raises
    ------
    RecordingError
        If the file is missing, damaged or empty, or its labels break a law.
    ImageError
        If an image inside is damaged.
    """
    try:
        table = pq.read_table(path)
    except FileNotFoundError:
        raise RecordingError(f"{path} does not exist; make the data set again") from None
    except (pa.ArrowInvalid, OSError) as error:
        raise RecordingError(f"{path} is not a readable Parquet file ({error}); make the data set again") from None
    metadata = {key.decode(): value for key, value in (table.schema.metadata or {}).items()}
    missing = ({"reference", *_DESCRIPTION} - set(metadata)) | (
        {"image", "contact_state", *SIGNALS} - set(table.column_names)
    )
    if missing:
        raise RecordingError(f"{path} lacks {', '.join(sorted(missing))}; write it with save_recording")
    reference = decode_png(metadata["reference"], where=f"the reference frame of {path}")
    trial = metadata["trial"].decode()
    if table.num_rows == 0:
        raise RecordingError(f"trial {trial} has no frames; leave it out or record it again")
    return Recording(
        trial=trial,
        sensor=metadata["sensor"].decode(),
        day=int(metadata["day"]),
        condition=metadata["condition"].decode(),
        reference=reference,
        frames=_decode_frames(table.column("image"), reference, path),
        contact_state=tuple(ContactState(state) for state in table.column("contact_state").to_pylist()),
        **{name: table.column(name).to_numpy().astype(np.float64) for name in SIGNALS},
    )


def _decode_frames(
    images: pa.ChunkedArray, reference: UInt8[np.ndarray, "height width 3"], path: Path
) -> UInt8[np.ndarray, "frames height width 3"]:
    frames = np.empty((len(images), *reference.shape), dtype=np.uint8)

    def decode(index: int) -> UInt8[np.ndarray, "height width 3"]:
        return decode_png(images[index].as_py(), where=f"frame {index} of {path}")

    with ThreadPoolExecutor() as pool:
        decoded = list(pool.map(decode, range(len(images))))
    for index, frame in enumerate(decoded):
        if frame.shape != reference.shape:
            raise RecordingError(
                f"frame {index} of {path} is {frame.shape[:2]} pixels but the reference is {reference.shape[:2]}; "
                "record both with the same camera settings"
            )
        frames[index] = frame
    return frames


def trial_info(recording: Recording, *, split: str, path: Path) -> TrialInfo:
    """Row of the data set's table for a trial saved at `path`."""
    height, width = recording.reference.shape[:2]
    return TrialInfo(
        trial=recording.trial,
        sensor=recording.sensor,
        day=recording.day,
        condition=recording.condition,
        split=split,
        frames=len(recording),
        height=height,
        width=width,
        sha256=hash_file(path),
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
