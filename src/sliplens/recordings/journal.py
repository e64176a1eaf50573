"""Journal of a running recording: an Arrow stream, appended frame by frame, that becomes a trial.

Each frame is passed to the system before the next is taken: a process that is killed loses the one it was writing.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa
from filelock import FileLock, Timeout

from sliplens.codec import from_builtins, one_line, to_builtins
from sliplens.errors import RecordingError
from sliplens.files import parse_json, require_file
from sliplens.images import encode_png, read_image
from sliplens.recordings.capture import Forces, Frame
from sliplens.recordings.labelling import Labelling, ReferenceChoice
from sliplens.recordings.store import decode_pixels, encode_pixels, forces_path, save_forces, write_trial
from sliplens.recordings.trial import TrialFacts, labels_of_margins

JOURNAL_FOLDER = "recording"  #: Folder of a data set with the journals of recordings that run or were cut off.
LOCK_FILE = "lock"
_HEADER, _REFERENCE = b"sliplens", b"reference"
_NUMBER = pa.float64()
_SCHEMA = pa.schema(
    {"time_s": _NUMBER, "safety_margin": _NUMBER, "force_time_s": pa.list_(_NUMBER), "force_n": pa.list_(_NUMBER)}
    | {"image": pa.binary()}
)


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
            metadata[_REFERENCE] = encode_png(reference)
        self.path = data / JOURNAL_FOLDER / f"{header.facts.trial}.arrow"
        self._file = self.path.open("xb")
        self._writer = pa.ipc.new_stream(pa.PythonFile(self._file, mode="w"), _SCHEMA.with_metadata(metadata))

    def append(
        self, image: Frame, *, time_s: float, safety_margin: float | None = None, forces: Forces | None = None
    ) -> None:
        """Append a frame, completely when this returns; an `OSError` where there is no room."""
        samples = ([], []) if forces is None else (forces.time_s.tolist(), forces.force_n.ravel().tolist())
        row = [[value] for value in (time_s, safety_margin, *samples, encode_pixels(image))]
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
        with pa.memory_map(str(journal)) as file:
            rows = [row.drop_columns(["image"]) for row in _rows(file)]
            if not rows:
                return False
            file.seek(0)
            metadata, where = pa.ipc.open_stream(file).schema.metadata or {}, "the header of a journal"
            values = parse_json(metadata.get(_HEADER, b""), where=where, cure="move it away")
            header = from_builtins(values, JournalHeader, where=where, command="sliplens live")
            numbers = pa.Table.from_batches(rows)
            images = (row.column("image")[0].as_py() for row in _rows(file))
            if (picture := metadata.get(_REFERENCE)) is None:
                first = next(images)
                images = chain([first], images)
                reference = decode_pixels(first, size=(*header.size, 3), where=f"the first frame of {journal}")
                notes = ("No picture of the untouched sensor was taken: the first frame stands for it.",)
                choice = ReferenceChoice(index=0, method="assumed")
            else:
                reference, notes = read_image(picture, where=f"the reference frame of {journal}"), ()
                choice = ReferenceChoice(method="recorded apart from the frames")
            labelling = Labelling(source=header.source, forces=header.forces, notes=notes, reference=choice)
            samples_s, samples_n = (
                numbers.column(name).combine_chunks().flatten().to_numpy() for name in ("force_time_s", "force_n")
            )
            # a sensor slower than the camera repeats its samples
            rising = samples_s > np.maximum.accumulate(np.concatenate([[-np.inf], samples_s]))[:-1]
            if rising.any():
                source, force_n = header.forces or "the force sensor", samples_n.reshape(-1, 3)[rising]
                forces = Forces(time_s=samples_s[rising], force_n=force_n, source=source)
                save_forces(forces, forces_path(trial.parent.parent, trial.stem))
            write_trial(
                trial,
                images,
                facts=header.facts,
                time_s=numbers.column("time_s").to_numpy(),
                labels=replace(labels_of_margins(numbers.column("safety_margin").to_numpy()), labelling=labelling),
                reference=reference,
            )
    except pa.ArrowException as error:
        raise RecordingError(f"{journal} is damaged ({one_line(error)}); move it away") from None
    return True


def _rows(file: pa.NativeFile) -> Iterator[pa.RecordBatch]:
    """Read the complete frames, from the first to the end of the journal; none where it ends before its header does."""
    file.seek(0)
    try:
        reader = pa.ipc.open_stream(file)
    except pa.ArrowInvalid:
        return
    except OSError as error:  # of no disk: the file is mapped
        raise pa.ArrowInvalid(str(error)) from None
    if not reader.schema.equals(_SCHEMA):
        raise pa.ArrowInvalid("it has other columns than a recording")
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
