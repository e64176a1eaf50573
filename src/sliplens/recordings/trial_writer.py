"""Recordings written as labelled trials of a data set, each complete or not at all."""

import tempfile
from abc import abstractmethod
from array import array
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from jaxtyping import Bool
from threadpoolctl import threadpool_limits

from sliplens.codec import RESULT_FILE, load_record, save_record
from sliplens.errors import PartError, RecordingError, SliplensError
from sliplens.files import remove
from sliplens.images import Soft, require_rgb, soften
from sliplens.progress import open_stage, report_progress
from sliplens.recordings.capture import Capture, Frame
from sliplens.recordings.dataset import LeftOut, TrialInfo, trial_info, trial_path
from sliplens.recordings.labelling import Corrections, Labelling, ReferenceChoice
from sliplens.recordings.labels import Reason, choose_reference, describe_repeats, label_trial, measure_motion
from sliplens.recordings.options import LabelSettings
from sliplens.recordings.sensor import SensorProfile
from sliplens.recordings.store import (
    ROW_GROUP,
    decode_pixels,
    encode_pixels,
    forces_path,
    in_turn,
    save_forces,
    write_trial,
)
from sliplens.recordings.trial import labels_of_margins
from sliplens.runner import MakePart, Work, part, run_parts


@dataclass(frozen=True, kw_only=True)
class TrialJob:
    """Trial to be labelled and written."""

    capture: Capture
    settings: LabelSettings
    corrections: Corrections | None = None  #: Corrections by hand, which `settings` follow already.
    cure: str = ""  #: End of an error message, where corrections may be the cause.
    profile: SensorProfile | None = None  #: Profile that its frames go through.
    one_of_many: bool = False  #: If True, a failure leaves the trial out instead of stopping the others.


@dataclass(frozen=True, kw_only=True)
class WrittenTrial:
    """Row of the data set's table for a trial, or the reason why the trial was left out."""

    info: TrialInfo | None = None
    left_out: LeftOut | None = None


class TrialWork(Work):
    """Work on whole trials: each becomes a data set of its own, which is moved into the common one."""

    in_threads = True  # decoding, arrays and compression release the interpreter's lock

    @abstractmethod
    def open(self, item: Any) -> TrialJob:
        """Open the trial of a part."""

    def begin(self) -> MakePart:
        """Make data sets of one trial."""
        # matrix products are small here: idle threads would spin on all cores
        threadpool_limits(1, user_api="blas")

        def make(item: Any, path: Path) -> None:
            job = self.open(item)
            capture, settings = job.capture, job.settings
            trial, samples = trial_path(path, capture.trial), forces_path(path, capture.trial)
            # random numbers that do not depend on the other trials
            rng = np.random.default_rng((settings.seed, *capture.trial.encode()))
            try:
                import_trial(
                    capture, trial, settings=settings, corrections=job.corrections, rng=rng, forces_file=samples
                )
                written = WrittenTrial(info=trial_info(trial, split=""))
            except SliplensError as error:
                if job.cure:
                    raise RecordingError(f"{error}{job.cure}") from None
                if not job.one_of_many:
                    raise
                samples.unlink(missing_ok=True)
                written = WrittenTrial(left_out=LeftOut(trial=capture.trial, source=capture.source, why=str(error)))
            save_record(written, path / RESULT_FILE)

        return make


@contextmanager
def write_trials(
    work: TrialWork, trials: Sequence[tuple[Any, str, int]], folder: Path, *, title: str, on: str, retry_failed: bool
) -> Iterator[tuple[list[TrialInfo], list[LeftOut]]]:
    """Write trials into the folder of a data set; yields their rows, and the trials that were left out of many."""
    parts = folder / "parts"
    # the folder is of these recordings and settings alone (`files.output_folder`)
    every = [part(item, trial=name, frames=frames, recipe="trial", content=name) for item, name, frames in trials]
    rows: list[TrialInfo] = []
    left_out: list[LeftOut] = []
    with threadpool_limits(1, user_api="blas"), open_stage(title):
        try:
            run_parts(work, every, parts, title=title, on=on, retry_failed=retry_failed)
        except PartError as error:
            failed = {name: work.open(item) for item, name, _ in trials if name in error.errors}
            if len(failed) == len(trials) or not all(job.one_of_many for job in failed.values()):
                raise
            for name, job in failed.items():
                why = f"{error.errors[name]}; the same command with --add tries it again"
                left_out.append(LeftOut(trial=name, source=job.capture.source, why=why))
    set_aside = {trial.trial for trial in left_out}
    for made in (parts / each.path for each in every if each.name not in set_aside):
        written = load_record(made / RESULT_FILE, WrittenTrial, command="the interrupted command")
        if written.left_out is not None:
            left_out.append(written.left_out)
        if written.info is not None:
            rows.append(written.info)
            for path in (trial_path(made, written.info.trial), forces_path(made, written.info.trial)):
                if path.exists():  # else there are none, or they were moved before an interruption
                    target = folder / path.relative_to(made)
                    target.parent.mkdir(exist_ok=True)
                    path.replace(target)
    if left_out and not rows:
        remove(parts)
        raise RecordingError(f"no trial could be imported; the first: {left_out[0].why}")
    yield rows, left_out
    remove(parts)


def require_forces(capture: Capture) -> None:
    """Refuse a recording that has neither labels nor forces to make them from."""
    if capture.labels is None and capture.forces is None:
        cure = "give the table of the force sensor with --forces FILE, or under the name of the recording"
        raise RecordingError(f"{capture.source} has no forces, and without them there is no label; {cure}")


def import_trial(
    capture: Capture,
    path: Path,
    *,
    settings: LabelSettings | None = None,
    corrections: Corrections | None = None,
    rng: np.random.Generator,
    forces_file: Path | None = None,
) -> None:
    """Write a recording as a trial of a data set, with its own or automatic labels; complete or not at all."""
    require_forces(capture)
    path.parent.mkdir(parents=True, exist_ok=True)
    settings = settings or LabelSettings()
    with tempfile.TemporaryFile(dir=path.parent) as file:
        footage = _Footage(capture, file)
        motion = measure_motion(footage.soften())
        try:
            labels, untouched, basis = capture.labels, None, None
            if labels is None and corrections is not None and corrections.exclude:
                labels = labels_of_margins(np.full(len(capture), np.nan))
                labels = replace(labels, reason=(Reason.EXCLUDED,) * len(capture))
            elif labels is None:
                assert capture.forces is not None
                labels = label_trial(capture.frame_time_s, motion, capture.forces, settings=settings, rng=rng)
                basis, untouched = labels.basis, np.array([reason is Reason.NO_CONTACT for reason in labels.reason])
                if (doubt := describe_repeats(motion, capture.frame_time_s)) is not None:
                    basis = replace(basis, doubts=(*basis.doubts, doubt))
            reference, choice = _choose_reference(footage, settings=settings, untouched=untouched)
        except RecordingError as error:
            raise RecordingError(f"{capture.source}: {error}") from None
        first = None
        if capture.reference is not None and corrections is not None and corrections.reference_frame is not None:
            # for who takes the correction back
            first = capture.reference_choice or ReferenceChoice(method="came with the recording")
        labelling = labels.labelling or Labelling(
            source=capture.source,
            forces=capture.forces.source if capture.forces else None,
            notes=capture.notes,
            reference=choice,
            clip=capture.clip,
            basis=basis,
            corrections=corrections,
            first_reference=first,
        )
        # before the trial, whose file means that all of it is there
        if forces_file is not None and capture.forces is not None:
            save_forces(capture.forces, forces_file)
        write_trial(
            path,
            footage.chunks(),
            facts=capture,
            time_s=capture.frame_time_s,
            labels=replace(labels, labelling=labelling),
            reference=reference,
            first_reference=capture.reference if labelling.first_reference is not None else None,
        )


class _Footage:
    """Frames of a recording, decoded once and spooled to a temporary file, to be read again in any order."""

    def __init__(self, capture: Capture, file: IO[bytes]) -> None:
        self.capture, self._file, self._ends = capture, file, array("q", [0])

    def soften(self) -> Iterator[Soft]:
        """Decode and spool the frames; yields them softened."""
        for image, soft in in_turn(lambda frame: (encode_pixels(frame), soften(frame)), self._decode()):
            self._file.write(image)
            self._ends.append(self._file.tell())
            yield soft
            report_progress(len(self._ends) - 1, len(self.capture))

    def _decode(self) -> Iterator[Frame]:
        """Read the frames, which must be of one size and as many as promised."""
        capture, count = self.capture, 0
        for count, frame in enumerate(capture.read_frames(), start=1):
            require_rgb(frame, what=f"levels of frame {count - 1} of {capture.source}")
            if frame.shape[:2] != capture.frame_size:
                raise RecordingError(
                    f"frame {count - 1} of {capture.source} is of another size; cut the recording there"
                )
            yield frame
        if count != len(capture):
            raise RecordingError(f"{capture.source} promised {len(capture)} frames but gave {count}; copy it again")

    def _image(self, place: int) -> bytes:
        self._file.seek(self._ends[place])
        return self._file.read(self._ends[place + 1] - self._ends[place])

    def read(self, places: Sequence[int]) -> Iterator[Frame]:
        """Read some frames."""
        for place in places:
            where = f"frame {place} of {self.capture.source}"
            yield decode_pixels(self._image(place), size=(*self.capture.frame_size, 3), where=where)

    def chunks(self) -> Iterator[list[bytes]]:
        """Yield the encoded frames in chunks of a row group."""
        for first in range(0, len(self.capture), ROW_GROUP):
            yield [self._image(place) for place in range(first, min(first + ROW_GROUP, len(self.capture)))]


def _choose_reference(
    footage: _Footage, *, settings: LabelSettings, untouched: Bool[np.ndarray, " frames"] | None
) -> tuple[Frame, ReferenceChoice]:
    """Return the image of the untouched sensor: the one named, the recorded one, or one of the untouched frames."""
    capture = footage.capture
    index = capture.reference_index if settings.reference_frame is None else settings.reference_frame
    if capture.reference is not None and index is None:
        method = "came with the recording" if untouched is None else "recorded apart from the frames"
        return capture.reference, capture.reference_choice or ReferenceChoice(method=method)
    if untouched is not None:
        choice = choose_reference(footage.read, untouched, index=index)
    elif index is None:
        raise RecordingError("no frame is known to be untouched; name one with --reference-frame")
    elif not 0 <= index < len(capture):
        raise RecordingError(f"the reference is frame {index} of {len(capture)}; name one from 0 on that is there")
    else:
        choice = ReferenceChoice(index=index, method="named")
    assert choice.index is not None
    (image,) = footage.read([choice.index])
    return image, choice
