"""A data set on disk: one Parquet file a trial, frames without loss beside their labels."""

import shlex
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa
from filelock import FileLock, Timeout

from sliplens.codec import Result, from_builtins, one_line
from sliplens.errors import InputError, RecordingError, SliplensError
from sliplens.files import (
    hash_file,
    hash_json,
    parse_json,
    read_json,
    require_file,
    require_folder,
    to_builtins,
    write_json,
)
from sliplens.images import encode_image, read_image
from sliplens.progress import OnProgress, add_note, fold_equal, number_of, report_file, reporting
from sliplens.recordings import store
from sliplens.recordings.capture import Capture, Forces, Frame, capture_recording
from sliplens.recordings.labelling import LabelBasis, Labelling, ReferenceChoice
from sliplens.recordings.sensor import SENSORS_FOLDER, SensorProfile, load_profile
from sliplens.recordings.store import SCHEMA_VERSION, StoredFacts, forces_path, load_recording, read_header
from sliplens.recordings.trial import Recording, TrialFacts, labels_of_margins

DATASET_FILE = "dataset.json"
JOURNAL_FOLDER = "recording"  #: Folder of a data set with the journals of recordings that run or were cut off.
LOCK_FILE = "lock"


@dataclass(frozen=True, kw_only=True)
class TrialInfo(StoredFacts):
    """Row of a data set's table: a trial, its split, and the hashes of its files."""

    split: str
    sha256: str
    forces_sha256: str = ""  #: Hash of the samples of the force sensor; empty where none are kept.


@dataclass(frozen=True, kw_only=True)
class LeftOut:
    """Recording of many that could not be imported."""

    trial: str  #: Name that its trial would have.
    source: str  #: File or folder.
    why: str  #: Error and its cure.


@dataclass(frozen=True, kw_only=True)
class Dataset(Result):
    """A data set on disk; trials are read one at a time."""

    folder: Path
    trials: tuple[TrialInfo, ...]
    simulated: bool = False
    left_out: tuple[LeftOut, ...] = ()  #: Recordings that could not be imported.

    @property
    def source(self) -> str:
        """Origin of the frames: "simulated" or "real"."""
        return "simulated" if self.simulated else "real"

    @property
    def hash(self) -> str:
        """Hash of the table, which holds the hash of every trial: equal data have equal hashes."""
        return hash_json([asdict(trial) for trial in self.trials])

    @property
    def doubts(self) -> dict[str, tuple[str, ...]]:
        """Doubts about the labels of each trial that has any, a sentence each."""
        return {trial: basis.doubts for trial, basis in self.read_bases().items() if basis.doubts}

    @property
    def frames(self) -> int:
        """Number of frames of all trials."""
        return sum(trial.frames for trial in self.trials)

    def find(self, trial: str) -> TrialInfo:
        """Return the trial of a name; a `RecordingError` lists the trials if there is none."""
        for info in self.trials:
            if info.trial == trial:
                return info
        some = ", ".join(dict.fromkeys(info.trial for info in (*self.trials[:5], self.trials[-1])))
        raise RecordingError(f"{self.folder} has no trial {trial}; it has {some}")

    def select(
        self, *, split: str | None = None, condition: str | None = None, trial: str | None = None
    ) -> tuple[TrialInfo, ...]:
        """Return the trials of a split, a condition and a name; a `RecordingError` lists those there are if none is."""
        chosen = [info for info in self.trials if split in {None, info.split} and condition in {None, info.condition}]
        if not chosen:
            present = sorted({f"{info.split}/{info.condition}" for info in self.trials})
            wanted = f"split {split or 'any'} and condition {condition or 'any'}"
            raise RecordingError(f"{self.folder} has no trial with {wanted}; it has {', '.join(present)}")
        return tuple(chosen) if trial is None else (replace(self, trials=tuple(chosen)).find(trial),)

    def load(self, info: TrialInfo, *, truth: bool = True) -> Recording:
        """Read one trial with its frames, and with the ground truth of a simulated one unless `truth` is False."""
        return load_recording(trial_path(self.folder, info.trial), truth=truth)

    def profile(self, sensor: str) -> SensorProfile | None:
        """Load the profile that the frames of a sensor went through on import; None where there was none."""
        paths = (self.folder / SENSORS_FOLDER).glob("*.toml")
        return next((load_profile(path) for path in paths if path.stem == sensor), None)

    def read_labels(self, info: TrialInfo) -> Recording:
        """Read the labels of one trial, with its reference and without its frames."""
        return load_recording(trial_path(self.folder, info.trial), pixels=False)

    def read_bases(self) -> dict[str, LabelBasis]:
        """Read the estimates behind the labels of the trials that were labelled from forces and can be read."""
        bases = {}
        for info in self.trials:
            with suppress(SliplensError):
                labelling = read_header(trial_path(self.folder, info.trial)).labelling
                bases |= {info.trial: labelling.basis} if labelling and labelling.basis else {}
        return bases

    def open(self, info: TrialInfo, *, samples: bool = True) -> Capture:
        """Open one trial as a recording, with or without the samples of its forces; no frame is read yet."""
        stored, forces = self.read_labels(info), None
        force_n = np.stack([stored.tangential_force_n, np.zeros(len(stored)), stored.normal_force_n], axis=-1)
        measured = np.isfinite(force_n).all(axis=1)
        if samples and info.forces_sha256:
            forces = store.load_forces(forces_path(self.folder, info.trial))
        elif samples and measured.any():
            source = f"the frames of {info.trial}"
            forces = Forces(time_s=stored.time_s[measured], force_n=force_n[measured], source=source)
        return replace(
            capture_recording(stored),
            source=f"{info.trial} of {self.folder}",
            read_frames=partial(store.stream_frames, trial_path(self.folder, info.trial)),
            forces=forces,
            split=info.split,
            simulated=self.simulated,
            opened=str(self.folder),
        )


def load_dataset(folder: Dataset | Path | str) -> Dataset:
    """Open a data set that `import_recordings` or `simulate` made; trials are loaded on request.

    A recording that was cut off is noted, and no trial of the data set until `recover_dataset` finishes it. An open
    data set is returned as it is.

    See Also
    --------
    import_recordings : Make a data set of recordings.
    simulate : Simulate a data set.

    Examples
    --------
    >>> import sliplens as sl
    >>> data = sl.load_dataset("data")  # doctest: +SKIP
    >>> data.load(data.trials[0]).frames.shape  # doctest: +SKIP
    (240, 224, 224, 3)
    """
    if isinstance(folder, Dataset):
        return folder
    if not isinstance(folder, Path | str):
        raise InputError(f"{folder!r} is no data set; give its folder, or the Dataset that was made or loaded")
    folder = require_folder(Path(folder), what="the data set")
    data, unfinished = _read(folder), ""
    if (folder / JOURNAL_FOLDER).is_dir():
        cure = f"stop it, or finish it with `{shlex.join(['sliplens', 'recover', str(folder)])}`"
        unfinished = f"{folder} holds a recording that still runs or was cut off; {cure}"
    if not data.trials:
        raise RecordingError(unfinished or f"{folder} lists no trials; make or import a data set first")
    if unfinished:
        add_note(unfinished)
    return data


def recover_dataset(folder: Path | str, *, on_progress: OnProgress | None = None) -> Dataset:
    """Make trials of recordings that were cut off, up to the last whole frame, and open the data set.

    A data set without such a recording stays as it is.

    See Also
    --------
    load_dataset : Open a data set without changing it.
    check_dataset : List the defects of a data set.

    Examples
    --------
    >>> import sliplens as sl
    >>> [trial.trial for trial in sl.recover_dataset("recorded").trials]  # doctest: +SKIP
    ['live-1']
    """
    folder = require_folder(Path(folder), what="the data set")
    with reporting(on_progress):
        if (folder / JOURNAL_FOLDER).is_dir():
            finish_recording(folder)
            if not (folder / DATASET_FILE).is_file():
                raise RecordingError(f"{folder} held no whole frame and was removed; record again")
        else:
            add_note(f"{folder} holds no recording that was cut off; nothing was changed")
        return load_dataset(folder)


def _read(folder: Path) -> Dataset:
    path = folder / DATASET_FILE
    missing = f"make a data set of recordings with `sliplens import {folder} -o DATA`, and name that"
    values = read_json(path, missing=missing)
    if not isinstance(values, dict) or values.get("schema_version") != SCHEMA_VERSION:
        raise RecordingError(f"{path} is not a sliplens data set of schema {SCHEMA_VERSION}; make it again")
    return from_builtins({**values, "folder": str(folder)}, Dataset, where=path, command="sliplens import")


def begin_recording(folder: Path, *, simulated: bool) -> tuple[FileLock, tuple[str, ...]]:
    """Prepare a new or an existing data set for trials to be recorded into it, after recovering what was cut off."""
    exists = (folder / DATASET_FILE).is_file()
    # a recording that was killed before it wrote its table leaves these alone
    leftovers = {folder / JOURNAL_FOLDER, folder / JOURNAL_FOLDER / LOCK_FILE, folder / f".{DATASET_FILE}.part"}
    if folder.exists() and not exists and not (folder.is_dir() and set(folder.rglob("*")) <= leftovers):
        raise RecordingError(f"{folder} exists and is no data set of sliplens; choose another folder")
    if exists and (folder / JOURNAL_FOLDER).is_dir():
        finish_recording(folder)
        exists = (folder / DATASET_FILE).is_file()  # removed where nothing had been recorded
    table = _read(folder) if exists else Dataset(folder=folder, trials=(), simulated=simulated)
    if table.simulated != simulated:
        kind = "simulated" if simulated else "real"
        raise RecordingError(f"{folder} holds {table.source} trials, these are {kind}; choose another folder")
    lock = lock_journals(folder)
    # also without a trial: whoever opens the folder sees a data set, and recovers it if it was cut off
    write_dataset_table(folder, table.trials, simulated=simulated, left_out=table.left_out)
    return lock, tuple(info.trial for info in table.trials)


def finish_recording(folder: Path, lock: FileLock | None = None) -> None:
    """Make trials of the journals of a data set; a data set without a trial is removed."""
    lock = lock or lock_journals(folder)
    try:
        table = _read(folder)
        trials = {info.trial: info for info in table.trials}
        for journal in sorted((folder / JOURNAL_FOLDER).glob("*.arrow")):
            path = trial_path(folder, journal.stem)
            if finish_journal(journal, path):
                trials[journal.stem] = trial_info(path, split="test")  # nothing was trained on it
        write_dataset_table(folder, [*trials.values()], simulated=table.simulated, left_out=table.left_out)
        shutil.rmtree(folder / JOURNAL_FOLDER)
    finally:
        lock.release()
    if not trials:
        shutil.rmtree(folder / SENSORS_FOLDER, ignore_errors=True)
        (folder / DATASET_FILE).unlink()  # without it the rest would be nobody's
        with suppress(OSError):  # where something else is in it
            folder.rmdir()


def report_flags(data: Dataset) -> None:
    """Note the flags on the labels of trials, equal ones of several trials once."""
    for message in fold_equal(f"{trial}: {flag}" for trial, basis in data.read_bases().items() for flag in basis.flags):
        add_note(message)


def report_dataset(folder: Dataset | Path, *, existed: bool) -> Dataset:
    """Open a data set that was written, or was there already, and report it and the flags on its labels."""
    report_flags(data := load_dataset(folder))
    count = f"{number_of(len(data.trials), 'trial')}, {number_of(data.frames, 'frame')}"
    report_file(data.folder, count, kept=existed)
    return data


def trial_path(folder: Path, trial: str) -> Path:
    """Return the file of a trial of a data set."""
    return folder / "trials" / f"{trial}.parquet"


def trial_info(path: Path, *, split: str) -> TrialInfo:
    """Make the row of the data set's table for the trial stored at `path`."""
    header, samples = read_header(path), forces_path(path.parent.parent, path.stem)
    values = {field.name: getattr(header, field.name) for field in fields(StoredFacts)}
    forces = hash_file(samples) if samples.is_file() else ""
    return TrialInfo(**values, split=split, sha256=hash_file(path), forces_sha256=forces)


def write_dataset_table(
    folder: Path, trials: Sequence[TrialInfo], *, simulated: bool = False, left_out: Sequence[LeftOut] = ()
) -> None:
    """Write `dataset.json`, the last file of a data set."""
    table = {"schema_version": SCHEMA_VERSION, "simulated": simulated, "trials": [*trials], "left_out": [*left_out]}
    write_json(folder / DATASET_FILE, table)


_HEADER, _REFERENCE = b"sliplens", b"reference"
_NUMBER = pa.float64()
_NUMBERS = {
    **dict.fromkeys(("time_s", "safety_margin"), _NUMBER),
    **dict.fromkeys(("force_time_s", "force_n"), pa.list_(_NUMBER)),
}
_SCHEMA = pa.schema(_NUMBERS | {"image": pa.binary()})


@dataclass(frozen=True, kw_only=True)
class JournalHeader:
    """Facts of a trial before its first frame."""

    facts: TrialFacts
    source: str  #: Camera, stream or file.
    size: tuple[int, int]  #: Height and width of the frames, in pixels.
    forces: str | None = None  #: Source of the forces; None where there is none.


class Journal:
    """Journal of one trial of a data set; frames are appended one by one, with rising times."""

    def __init__(self, data: Path, header: JournalHeader, *, reference: Frame | None) -> None:
        metadata = {_HEADER: msgspec.json.encode(to_builtins(header))}
        if reference is not None:
            metadata[_REFERENCE] = encode_image(reference)
        self.path = data / JOURNAL_FOLDER / f"{header.facts.trial}.arrow"
        self._file = self.path.open("xb")
        self._writer = pa.ipc.new_stream(pa.PythonFile(self._file, mode="w"), _SCHEMA.with_metadata(metadata))

    def append(
        self, image: Frame, *, time_s: float, safety_margin: float | None = None, forces: Forces | None = None
    ) -> None:
        """Append a frame, completely when this returns; an `OSError` where there is no room."""
        samples = ([], []) if forces is None else (forces.time_s.tolist(), forces.force_n.ravel().tolist())
        row = [[value] for value in (time_s, safety_margin, *samples, store.encode_pixels(image))]
        self._writer.write_batch(pa.record_batch(row, schema=_SCHEMA))
        self._file.flush()

    def close(self) -> None:
        """Close the file; its content stays."""
        with suppress(OSError):  # of a frame for which there was no room
            self._file.close()


def lock_journals(data: Path) -> FileLock:
    """Lock a data set for recording into it; the system releases the lock when the process ends, even killed."""
    folder = data / JOURNAL_FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / LOCK_FILE, blocking=False)
    try:
        lock.acquire()
    except Timeout:
        raise RecordingError(f"{data} is being recorded; stop the recording first, or choose another folder") from None
    return lock


def finish_journal(journal: Path, trial: Path) -> bool:
    """Make a trial, and the file of its force samples, of a journal; False where it holds no complete frame."""
    require_file(journal, missing="move it away")
    try:
        with pa.memory_map(str(journal)) as file:  # images are read from the disk when they are written
            rows, metadata = _rows(file)
            if not rows:
                return False
            where = "the header of a journal"
            values = parse_json(metadata.get(_HEADER, b""), where=where, cure="move it away")
            header = from_builtins(values, JournalHeader, where=where, command="sliplens live")
            numbers = {name: pa.chunked_array([row[name] for row in rows]).combine_chunks() for name in _NUMBERS}
            if (picture := metadata.get(_REFERENCE)) is None:
                first = rows[0]["image"][0].as_py()
                reference = store.decode_pixels(first, size=(*header.size, 3), where=f"the first frame of {journal}")
                notes = ("No picture of the untouched sensor was taken: the first frame stands for it.",)
                choice = ReferenceChoice(index=0, method="assumed")
            else:
                reference, notes = read_image(picture, where=f"the reference frame of {journal}"), ()
                choice = ReferenceChoice(method="recorded apart from the frames")
            labelling = Labelling(source=header.source, forces=header.forces, notes=notes, reference=choice)
            samples_s, samples_n = (numbers[name].flatten().to_numpy() for name in ("force_time_s", "force_n"))
            # a sensor slower than the camera repeats its samples
            rising = samples_s > np.maximum.accumulate(np.append(-np.inf, samples_s))[:-1]
            if rising.any():
                source, force_n = header.forces or "the force sensor", samples_n.reshape(-1, 3)[rising]
                forces = Forces(time_s=samples_s[rising], force_n=force_n, source=source)
                store.save_forces(forces, forces_path(trial.parent.parent, trial.stem))
            margin = numbers["safety_margin"].to_numpy(zero_copy_only=False)
            store.write_trial(
                trial,
                (row["image"][0].as_py() for row in rows),
                facts=header.facts,
                time_s=numbers["time_s"].to_numpy(),
                labels=replace(labels_of_margins(margin), labelling=labelling),
                reference=reference,
            )
    except pa.ArrowException as error:
        raise RecordingError(f"{journal} is damaged ({one_line(error)}); move it away") from None
    return True


def _rows(file: pa.NativeFile) -> tuple[list[pa.RecordBatch], dict[bytes, bytes]]:
    """Read the complete frames of a journal, and its metadata; none where it ends before its header does."""
    rows: list[pa.RecordBatch] = []
    try:
        reader = pa.ipc.open_stream(file)
    except pa.ArrowInvalid:
        return rows, {}
    except OSError as error:  # of no disk: the file is mapped
        raise pa.ArrowInvalid(str(error)) from None
    if not reader.schema.equals(_SCHEMA):
        raise pa.ArrowInvalid("it has other columns than a recording")
    with suppress(StopIteration, pa.ArrowInvalid, OSError):  # the frame that was being written
        while True:
            rows.append(reader.read_next_batch())
    for row in rows:
        row.validate(full=True)
        gaps = any(row[name].null_count for name in _SCHEMA.names if name != "safety_margin")
        if len(row) != 1 or gaps or len(row["force_n"][0]) != 3 * len(row["force_time_s"][0]):
            raise pa.ArrowInvalid("a row is no frame")
    return rows, reader.schema.metadata or {}
