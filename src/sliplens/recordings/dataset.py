"""A data set on disk: one Parquet file a trial, frames without loss beside their labels."""

import shutil
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path

from sliplens.codec import from_builtins, save_record
from sliplens.errors import RecordingError
from sliplens.files import StoredPath, as_path, hash_file, hash_json, read_json, require_folder, whole_file
from sliplens.progress import OnProgress, fold_equal, note
from sliplens.recordings.journal import JOURNAL_FOLDER, LOCK_FILE, JournalLock, finish_journal, journals_of
from sliplens.recordings.labelling import Labelling
from sliplens.recordings.sensor import SENSORS_FOLDER, SensorProfile, load_profile, profile_text
from sliplens.recordings.store import SCHEMA_VERSION, forces_path, load_recording, read_header, require_stored
from sliplens.recordings.trial import Recording, TrialFacts

DATASET_FILE = "dataset.json"


@dataclass(frozen=True, kw_only=True)
class TrialInfo(TrialFacts):
    """Row of a data set's table: a trial, its split, and the hashes of its files."""

    split: str
    frames: int
    height: int
    """Rows of its frames, in pixels."""
    width: int
    sha256: str
    forces_sha256: str = ""
    """Hash of the samples of the force sensor; empty where none are kept."""

    def __post_init__(self) -> None:
        require_stored(self)


@dataclass(frozen=True, kw_only=True)
class LeftOut:
    """Recording of many that could not be imported."""

    trial: str
    """Name that its trial would have."""
    source: str
    """File or folder, for people."""
    why: str
    """What was wrong with it, and the cure."""


@dataclass(frozen=True, kw_only=True)
class _Table:
    """What `dataset.json` holds."""

    schema_version: int = SCHEMA_VERSION
    simulated: bool = False
    units: dict[str, str] = field(
        default_factory=lambda: {"time_s": "s", "normal_force_n": "N", "tangential_force_n": "N"}
    )
    trials: tuple[TrialInfo, ...]
    left_out: tuple[LeftOut, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """A data set on disk; trials are read one at a time."""

    folder: Path
    trials: tuple[TrialInfo, ...]
    simulated: bool = False
    left_out: tuple[LeftOut, ...] = ()
    """Recordings that were given and could not be imported."""

    @property
    def source(self) -> str:
        """Where the frames come from, as results tell it: "simulated" or "real"."""
        return "simulated" if self.simulated else "real"

    @property
    def hash(self) -> str:
        """Hash of the table, which holds the hash of every trial: the same data, the same hash."""
        return hash_json([asdict(trial) for trial in self.trials])

    @property
    def frames(self) -> int:
        """Number of frames of all trials."""
        return sum(trial.frames for trial in self.trials)

    def find(self, trial: str) -> TrialInfo:
        """Trial of a name; a `RecordingError` lists what there is if there is none."""
        for info in self.trials:
            if info.trial == trial:
                return info
        names = [info.trial for info in self.trials]
        more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
        raise RecordingError(f"{self.folder} has no trial {trial}; it has {', '.join(names[:_NAMED])}{more}")

    def select(self, *, split: str | None = None, condition: str | None = None) -> tuple[TrialInfo, ...]:
        """Trials of a split and a condition; a `RecordingError` lists what there is if there is none."""
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

    def profile(self, sensor: str) -> SensorProfile | None:
        """Profile that the frames of a sensor went through on import; None where there was none."""
        kept = (self.folder / SENSORS_FOLDER).glob("*.toml")
        return next((load_profile(path) for path in kept if path.stem == sensor), None)

    def read_labels(self, info: TrialInfo) -> Recording:
        """Labels of one trial, with its reference and without its frames."""
        return load_recording(trial_path(self.folder, info.trial), pixels=False)


_RECORDED_SPLIT = "test"  # nothing was trained on it
_NAMED = 10  # trials named in a message before the rest is counted


def load_dataset(folder: Path | str) -> Dataset:
    """Open a data set that `import_recordings` or `simulate` made; its trials are read when they are asked for.

    Raises
    ------
    InputError
        If the folder or its table is missing, damaged or of another schema, or lists no trial.
    """
    folder = as_path(folder)
    require_folder(folder, what="the data set")
    if (folder / JOURNAL_FOLDER).is_dir():
        if isinstance(folder, StoredPath):
            raise RecordingError(f"{folder} holds a recording that was cut off; open it on a disk, and copy it again")
        finish_recording(folder)
    table = _read_table(folder)
    if not table.trials:
        raise RecordingError(f"{folder} lists no trials; make or import a data set first")
    return Dataset(folder=folder, trials=table.trials, simulated=table.simulated, left_out=table.left_out)


def _read_table(folder: Path) -> _Table:
    path = folder / DATASET_FILE
    values = read_json(
        path, missing=f"make a data set of recordings with `sliplens import {folder} -o DATA`, and name that"
    )
    if not isinstance(values, dict) or values.get("schema_version") != SCHEMA_VERSION:
        raise RecordingError(
            f"{path} is not a sliplens data set of schema {SCHEMA_VERSION}; make it again with this version"
        )
    return from_builtins(values, _Table, where=path, command="sliplens import")


def begin_recording(folder: Path, *, simulated: bool) -> tuple[JournalLock, tuple[str, ...]]:
    """Make a data set ready for trials to be recorded into it, a new one or one that is there.

    Gives what holds it until it is closed, and the names of its trials. What was cut off before is finished first.

    Raises
    ------
    RecordingError
        If the folder is something else, is being recorded, or holds trials of the other kind, real or simulated.
    """
    known = (folder / DATASET_FILE).is_file()
    if folder.exists() and not known and not (folder.is_dir() and _is_hardly_begun(folder)):
        raise RecordingError(f"{folder} exists and is no data set of sliplens; choose another folder")
    if known and (folder / JOURNAL_FOLDER).is_dir():
        finish_recording(folder)
        known = (folder / DATASET_FILE).is_file()  # gone where nothing had been recorded
    table = _read_table(folder) if known else _Table(trials=(), simulated=simulated)
    if table.simulated != simulated:
        kinds = ("simulated", "real") if table.simulated else ("real", "simulated")
        raise RecordingError(f"{folder} holds {kinds[0]} trials, these are {kinds[1]}; choose another folder")
    lock = JournalLock(folder)
    # also where it lists no trial yet: whoever opens the folder sees a data set, and finishes it if it was cut off
    write_dataset_table(folder, table.trials, simulated=simulated, left_out=table.left_out)
    return lock, tuple(info.trial for info in table.trials)


def _is_hardly_begun(folder: Path) -> bool:
    """Whether nothing is in a folder but what a recording leaves that was killed before it wrote its table."""
    left = {folder / JOURNAL_FOLDER, folder / JOURNAL_FOLDER / LOCK_FILE, folder / f".{DATASET_FILE}.part"}
    return set(folder.rglob("*")) <= left


def finish_recording(folder: Path, lock: JournalLock | None = None) -> None:
    """Make trials of what was recorded into a data set, whether it was ended or cut off.

    `lock`: what `begin_recording` gave; taken here if None, so that nobody finishes what is still being recorded. A
    data set without a trial is removed.
    """
    held = lock or JournalLock(folder)
    try:
        table = _read_table(folder)
        found = {info.trial: info for info in table.trials}
        for journal in journals_of(folder):
            path = trial_path(folder, journal.stem)
            if finish_journal(journal, path) is not None:
                found[journal.stem] = trial_info(path, split=_RECORDED_SPLIT)
        write_dataset_table(folder, tuple(found.values()), simulated=table.simulated, left_out=table.left_out)
        held.discard()
    finally:
        held.release()
    if not found:
        shutil.rmtree(folder / SENSORS_FOLDER, ignore_errors=True)
        (folder / DATASET_FILE).unlink()  # without it the rest would be nobody's
        with suppress(OSError):  # where something else is in it
            folder.rmdir()


def tell_flags(trials: Iterable[tuple[str, Labelling | None]], on_progress: OnProgress | None) -> None:
    """Note all that puts the labels of trials in doubt, what is said of several once."""
    bases = [(trial, labelling.basis) for trial, labelling in trials if labelling and labelling.basis]
    for message in fold_equal(f"{trial}: {flag}" for trial, basis in bases for flag in basis.flags):
        note(on_progress, message)


def keep_profile(folder: Path, profile: SensorProfile) -> None:
    """Keep, in the folder of a data set, the profile that frames went through."""
    path = folder / SENSORS_FOLDER / f"{profile.name}.toml"
    with whole_file(path) as part:
        part.write_text(profile_text(profile), encoding="utf-8")


def trial_path(folder: Path, trial: str) -> Path:
    """File that holds a trial of a data set."""
    return folder / "trials" / f"{trial}.parquet"


def trial_info(path: Path, *, split: str) -> TrialInfo:
    """Row of the data set's table for a trial saved at `path`."""
    header = read_header(path)
    samples = forces_path(path.parent.parent, path.stem)
    shared = {one.name: getattr(header, one.name) for one in fields(TrialInfo) if hasattr(header, one.name)}
    return TrialInfo(
        **shared, split=split, sha256=hash_file(path), forces_sha256=hash_file(samples) if samples.is_file() else ""
    )


def write_dataset_table(
    folder: Path, trials: Sequence[TrialInfo], *, simulated: bool = False, left_out: Sequence[LeftOut] = ()
) -> None:
    """Write `dataset.json`, the last file of a data set."""
    table = _Table(trials=tuple(trials), simulated=simulated, left_out=tuple(left_out))
    save_record(table, folder / DATASET_FILE)
