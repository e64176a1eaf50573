"""Journal of a running recording: an Arrow stream, appended frame by frame, that becomes a trial.

Each frame is passed to the system before the next is taken: a process that is killed loses the one it was writing.
"""

import shutil
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa
from filelock import FileLock, Timeout

from sliplens.codec import from_builtins, one_line, to_builtins
from sliplens.errors import RecordingError
from sliplens.files import parse_json, require_file
from sliplens.images import decode_png, encode_png
from sliplens.recordings.capture import Forces, Frame
from sliplens.recordings.labelling import Labelling, ReferenceChoice
from sliplens.recordings.store import ROW_GROUP, decode_pixels, encode_pixels, forces_path, save_forces, write_trial
from sliplens.recordings.trial import TrialFacts, labels_of_margins

JOURNAL_FOLDER = "recording"  #: Folder of a data set with the journals of recordings that run or were cut off.
LOCK_FILE = "lock"
_HEADER, _REFERENCE = b"sliplens", b"reference"
_SCHEMA = pa.schema(
    {
        "time_s": pa.float64(),
        "safety_margin": pa.float64(),
        "force_time_s": pa.list_(pa.float64()),
        "force_n": pa.list_(pa.float64()),
        "image": pa.binary(),
    }
)


@dataclass(frozen=True, kw_only=True)
class JournalHeader:
    """Facts of a trial before its first frame."""

    facts: TrialFacts
    source: str  #: Camera, stream or file.
    simulated: bool
    size: tuple[int, int]  #: Height and width of the frames, in pixels.
    forces: str | None = None  #: Source of the forces; None where there is none.


class Journal:
    """Journal of one trial; frames are appended one by one, with rising times."""

    def __init__(self, folder: Path, header: JournalHeader, *, reference: Frame | None) -> None:
        metadata = {_HEADER: msgspec.json.encode(to_builtins(header))}
        if reference is not None:
            metadata[_REFERENCE] = encode_png(reference)
        self.path = folder / f"{header.facts.trial}.arrow"
        self._file = self.path.open("xb")
        self._writer = pa.ipc.new_stream(pa.PythonFile(self._file, mode="w"), _SCHEMA.with_metadata(metadata))

    def append(
        self, image: Frame, *, time_s: float, safety_margin: float | None = None, forces: Forces | None = None
    ) -> None:
        """Append a frame, completely when this returns; an `OSError` where there is no room."""
        samples = ([], []) if forces is None else (forces.time_s.tolist(), forces.force_n.ravel().tolist())
        self._writer.write_batch(
            pa.record_batch(
                [[time_s], [safety_margin], [samples[0]], [samples[1]], [encode_pixels(image)]], schema=_SCHEMA
            )
        )
        self._file.flush()

    def close(self) -> None:
        """Close the file; its content stays."""
        with suppress(OSError):  # of a frame for which there was no room
            self._file.close()


class JournalLock:
    """Lock of a data set into which trials are recorded; the system releases it when the process ends, even killed."""

    def __init__(self, data: Path) -> None:
        self.folder = data / JOURNAL_FOLDER
        self.folder.mkdir(parents=True, exist_ok=True)
        self._lock = FileLock(self.folder / LOCK_FILE, blocking=False)
        try:
            self._lock.acquire()
        except Timeout:
            message = f"{data} is being recorded; stop the recording first, or choose another folder"
            raise RecordingError(message) from None

    def release(self) -> None:
        """Release the lock; the journals stay to be recovered."""
        self._lock.release()

    def discard(self) -> None:
        """Remove the journals, which are trials now, and release the lock."""
        shutil.rmtree(self.folder)
        self.release()


def journals_of(data: Path) -> list[Path]:
    """List the journals of a data set that are no trials yet."""
    return sorted((data / JOURNAL_FOLDER).glob("*.arrow"))


def finish_journal(journal: Path, trial: Path) -> JournalHeader | None:
    """Make a trial, and the file of its force samples, of a journal; None where it holds no complete frame."""
    require_file(journal, missing="move it away")
    try:
        with pa.memory_map(str(journal)) as file:
            head = _read_head(file)
            rows = [] if head is None else [row.drop_columns(["image"]) for row in _rows(file)]
        if head is None or not rows:
            return None
        header, picture = head
        numbers = pa.Table.from_batches(rows)
        labels = labels_of_margins(numbers.column("safety_margin").to_numpy())
        with pa.memory_map(str(journal)) as file:
            images = (row.column("image")[0].as_py() for row in _rows(file))
            if picture is None:
                first = next(images)
                images = chain([first], images)
                reference = decode_pixels(first, size=(*header.size, 3), where=f"the first frame of {journal}")
                notes = ("No picture of the untouched sensor was taken: the first frame stands for it.",)
                choice = ReferenceChoice(index=0, method="assumed")
            else:
                reference, notes = decode_png(picture, where=f"the reference frame of {journal}"), ()
                choice = ReferenceChoice(method="recorded apart from the frames")
            labelling = Labelling(source=header.source, forces=header.forces, notes=notes, reference=choice)
            _save_forces(numbers, header, forces_path(trial.parent.parent, trial.stem))
            write_trial(
                trial,
                iter(lambda: list(islice(images, ROW_GROUP)), []),
                facts=header.facts,
                time_s=numbers.column("time_s").to_numpy(),
                labels=replace(labels, labelling=labelling),
                reference=reference,
            )
    except pa.ArrowException as error:
        raise RecordingError(f"{journal} is damaged ({one_line(error)}); move it away") from None
    return header


def _read_head(file: pa.NativeFile) -> tuple[JournalHeader, bytes | None] | None:
    """Read the facts of the trial and the image of the untouched sensor; None where the journal ends before them."""
    try:
        schema = pa.ipc.open_stream(file).schema
    except pa.ArrowInvalid:
        return None
    except OSError as error:  # of no disk: the file is mapped
        raise pa.ArrowInvalid(str(error)) from None
    file.seek(0)
    if not schema.equals(_SCHEMA):
        raise pa.ArrowInvalid("it has other columns than a recording")
    where, metadata = "the header of a journal", schema.metadata or {}
    values = parse_json(metadata.get(_HEADER, b""), where=where, cure="move it away")
    header = from_builtins(values, JournalHeader, where=where, command="sliplens live")
    return header, metadata.get(_REFERENCE)


def _rows(file: pa.NativeFile) -> Iterator[pa.RecordBatch]:
    """Read the complete frames, from the first to the end of the journal."""
    reader = pa.ipc.open_stream(file)
    while True:
        try:
            row = reader.read_next_batch()
        except (StopIteration, pa.ArrowInvalid, OSError):
            return
        row.validate(full=True)
        gaps = any(row.column(name).null_count for name in _SCHEMA.names if name != "safety_margin")
        if len(row) != 1 or gaps or len(row["force_n"][0]) != 3 * len(row["force_time_s"][0]):
            raise pa.ArrowInvalid("a row is no frame")
        yield row


def _save_forces(numbers: pa.Table, header: JournalHeader, path: Path) -> None:
    """Write the samples, without repeated ones."""
    time_s = numbers.column("force_time_s").combine_chunks().flatten().to_numpy()
    force_n = numbers.column("force_n").combine_chunks().flatten().to_numpy().reshape(-1, 3)
    rising = time_s > np.maximum.accumulate(np.concatenate([[-np.inf], time_s]))[:-1]
    if rising.any():
        source = header.forces or "the force sensor"
        save_forces(Forces(time_s=time_s[rising], force_n=force_n[rising], source=source), path)
