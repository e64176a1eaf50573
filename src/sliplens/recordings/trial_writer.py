"""Recordings written as labelled trials of a data set, each complete or not at all."""

import tempfile
from abc import abstractmethod
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
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
    decode_pixels,
    encode_pixels,
    forces_path,
    in_turn,
    save_forces,
    write_trial,
)
from sliplens.recordings.trial import label_by_friction, labels_of_margins
from sliplens.runner import MakePart, Work, part, run_parts

PARTS = "parts"  #: Folder of a data set in the making, with a data set of each trial; the caller removes it.


@dataclass(frozen=True, kw_only=True)
class TrialJob:
    """Trial to be labelled and written."""

    capture: Capture
    settings: LabelSettings
    corrections: Corrections | None = None  #: Corrections by hand, which `settings` follow already.
    cure: str = ""  #: End of an error message, where corrections may be the cause.
    profile: SensorProfile | None = None  #: Profile that its frames go through.


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

        def make(item: Any, folder: Path) -> None:
            job = self.open(item)
            trial, samples = trial_path(folder, job.capture.trial), forces_path(folder, job.capture.trial)
            try:
                import_trial(
                    job.capture, trial, settings=job.settings, corrections=job.corrections, forces_file=samples
                )
            except SliplensError as error:
                raise RecordingError(f"{error}{job.cure}") from None
            save_record(trial_info(trial, split=""), folder / RESULT_FILE)

        return make


def write_trials(
    work: TrialWork,
    trials: Sequence[tuple[Any, str, int]],
    folder: Path,
    *,
    title: str,
    on: str,
    optional: Mapping[str, str] | None = None,
) -> tuple[list[TrialInfo], list[LeftOut]]:
    """Write trials (item, name, number of frames) into the folder of a data set; return their rows.

    Those of `optional`, names and sources, are left out where they fail; without any other the error is raised.
    """
    # the folder is of these recordings and settings alone (`files.output_folder`)
    every = [part(item, trial=name, frames=frames, recipe="trial", content=name) for item, name, frames in trials]
    left_out: list[LeftOut] = []
    with threadpool_limits(1, user_api="blas"), open_stage(title):
        try:
            run_parts(work, every, folder / PARTS, title=title, on=on)
        except PartError as error:
            if not error.errors.keys() <= (optional or {}).keys():
                raise
            for name, failure in error.errors.items():
                why = f"{failure}; the same command with --add tries it again"
                left_out.append(LeftOut(trial=name, source=(optional or {})[name], why=why))
    if len(left_out) == len(trials):
        remove(folder / PARTS)
        raise RecordingError(f"no trial could be imported; the first: {left_out[0].why}")
    rows: list[TrialInfo] = []
    failed = {trial.trial for trial in left_out}
    for made in (folder / PARTS / each.path for each in every if each.name not in failed):
        rows.append(load_record(made / RESULT_FILE, TrialInfo, command="the interrupted command"))
        for path in (trial_path(made, rows[-1].trial), forces_path(made, rows[-1].trial)):
            if path.exists():  # else there are none, or they were moved before an interruption
                target = folder / path.relative_to(made)
                target.parent.mkdir(exist_ok=True)
                path.replace(target)
    return rows, left_out


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
    forces_file: Path | None = None,
) -> None:
    """Write a recording as a trial of a data set, with its own or automatic labels; complete or not at all."""
    require_forces(capture)
    path.parent.mkdir(parents=True, exist_ok=True)
    settings = settings or LabelSettings()
    with tempfile.TemporaryFile(dir=path.parent) as file:
        footage = _Footage(capture, file)
        motion = measure_motion(footage.soften())
        labels, untouched, basis = capture.labels, None, None
        try:
            if labels is None and corrections is not None and corrections.exclude:
                labels = labels_of_margins(np.full(len(capture), np.nan))
                labels = replace(labels, reason=(Reason.EXCLUDED,) * len(capture))
            elif labels is None:
                assert capture.forces is not None
                # random numbers that do not depend on the other trials
                rng = np.random.default_rng((settings.seed, *capture.trial.encode()))
                labels = label_trial(capture.frame_time_s, motion, capture.forces, settings=settings, rng=rng)
                basis, untouched = labels.basis, np.array([reason is Reason.NO_CONTACT for reason in labels.reason])
                if (doubt := describe_repeats(motion, capture.frame_time_s)) is not None:
                    basis = replace(basis, doubts=(*basis.doubts, doubt))
            elif settings.mu is not None and not labels.labelled.any():
                labels = label_by_friction(labels, settings.mu)
            index = capture.reference_index if settings.reference_frame is None else settings.reference_frame
            if capture.reference is not None and index is None:
                method = "came with the recording" if untouched is None else "recorded apart from the frames"
                reference, choice = capture.reference, capture.reference_choice or ReferenceChoice(method=method)
            else:
                of_forces = np.zeros(len(capture), dtype=np.bool_) if untouched is None else untouched
                choice = choose_reference(footage.read, of_forces, index=index)
                choice = choice if untouched is not None else replace(choice, contact_energy=None)
                (reference,) = footage.read([choice.index or 0])
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
            footage.images(),
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
        """Decode, check and spool the frames; yields them softened."""
        capture = self.capture

        def encode(item: tuple[int, Frame]) -> tuple[bytes, Soft]:
            number, frame = item
            require_rgb(frame, what=f"levels of frame {number} of {capture.source}")
            if frame.shape[:2] != capture.frame_size:
                raise RecordingError(f"frame {number} of {capture.source} is of another size; cut the recording there")
            return encode_pixels(frame), soften(frame)

        for image, soft in in_turn(encode, enumerate(capture.read_frames())):
            self._file.write(image)
            self._ends.append(self._file.tell())
            yield soft
            report_progress(len(self._ends) - 1, len(capture))
        if (count := len(self._ends) - 1) != len(capture):
            raise RecordingError(f"{capture.source} promised {len(capture)} frames but gave {count}; copy it again")

    def _image(self, place: int) -> bytes:
        self._file.seek(self._ends[place])
        return self._file.read(self._ends[place + 1] - self._ends[place])

    def read(self, places: Sequence[int]) -> Iterator[Frame]:
        """Read some frames."""
        for place in places:
            where = f"frame {place} of {self.capture.source}"
            yield decode_pixels(self._image(place), size=(*self.capture.frame_size, 3), where=where)

    def images(self) -> Iterator[bytes]:
        """Yield the encoded frames."""
        return map(self._image, range(len(self.capture)))
