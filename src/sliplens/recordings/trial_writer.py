"""Labelled trials written from recordings, each whole or not at all, several side by side."""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event, Lock

import numpy as np
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from sliplens.errors import RecordingError, SliplensError
from sliplens.progress import OnProgress, stage
from sliplens.recordings.capture import Capture, Frame
from sliplens.recordings.dataset import LeftOut, TrialInfo, trial_info, trial_path
from sliplens.recordings.labelling import Edit, EditKind, Labelling, ReferenceChoice
from sliplens.recordings.labels import Reason, choose_reference, label_trial, measure_motion, soften
from sliplens.recordings.labels.lag import Soft
from sliplens.recordings.options import LabelSettings
from sliplens.recordings.sensor import SensorProfile
from sliplens.recordings.store import (
    ROW_GROUP,
    Spool,
    decode_pixels,
    encode_pixels,
    forces_path,
    in_turn,
    save_forces,
    write_trial,
)
from sliplens.recordings.trial import Labels


@dataclass(frozen=True, kw_only=True)
class TrialJob:
    """A trial to be imported."""

    capture: Capture
    settings: LabelSettings
    edits: tuple[Edit, ...] = ()
    """Repairs by hand that its labels follow."""
    undo: str = ""
    """How the last of them is taken back; empty where there is none."""
    profile: SensorProfile | None = None
    """What its frames went through."""
    one_of_many: bool = False
    """Whether it is left out where it cannot be imported, rather than stopping the others."""


def write_trials(
    folder: Path, jobs: Sequence[TrialJob], on_progress: OnProgress | None, *, title: str, first: int = 0
) -> tuple[list[TrialInfo], list[LeftOut]]:
    """Write the trials of a data set that are not there yet; gives their rows, and what was left out of many."""
    total, done, lock = sum(len(job.capture) for job in jobs), [0] * len(jobs), Lock()

    def write(number: int, count: OnProgress) -> TrialInfo | LeftOut:
        job = jobs[number]
        capture, path = job.capture, trial_path(folder, job.capture.trial)
        samples = forces_path(folder, capture.trial)

        def tell(written: int, _: int) -> None:
            if stopped.is_set():
                raise KeyboardInterrupt
            with lock:
                done[number] = written
                count(sum(done), total)

        # a trial is there whole or not at all, and the folder is of this very command
        if not path.is_file():
            rng = np.random.default_rng((job.settings.seed, first + number))
            try:
                own = {"settings": job.settings, "edits": job.edits, "rng": rng}
                import_trial(capture, path, **own, forces_file=samples, on_progress=tell)
            except SliplensError as error:
                samples.unlink(missing_ok=True)
                if job.undo:
                    raise RecordingError(f"{error}; {job.undo}") from None
                if not job.one_of_many:
                    raise
                return LeftOut(trial=capture.trial, source=capture.source, why=str(error))
        tell(len(capture), total)
        return trial_info(path, split="")

    stopped = Event()
    # decoding, arrays and compression run beside one another in threads; each holds one frame of its trial
    workers = min(os.cpu_count() or 1, len(jobs))
    # and the threads of NumPy's matrices, which are small here, would only take the cores from these while they spin
    blas = threadpool_limits(1, user_api="blas")
    with blas, stage(on_progress, title) as count, ThreadPoolExecutor(max_workers=workers) as pool:
        try:
            rows = [future.result() for future in [pool.submit(write, number, count) for number in range(len(jobs))]]
        except BaseException:
            stopped.set()
            pool.shutdown(cancel_futures=True)
            raise
    failed = [row for row in rows if isinstance(row, LeftOut)]
    return [row for row in rows if isinstance(row, TrialInfo)], failed


def import_trial(
    capture: Capture,
    path: Path,
    *,
    settings: LabelSettings | None = None,
    edits: Sequence[Edit] = (),
    rng: np.random.Generator,
    forces_file: Path | None = None,
    on_progress: OnProgress | None = None,
) -> None:
    """Write a recording as a trial of a data set, with the labels that came with it, or found; whole or not at all.

    The frames are decoded once, never all at once. The samples of the force sensor, from which labels can be made anew,
    are kept in `forces_file`. `edits` are those by hand that the settings follow, to be kept with the trial.
    """
    require_forces(capture)
    with Spool(path.parent) as images:
        footage = _read_footage(capture, images, on_progress)
        try:
            reference, labels = label_footage(
                capture, footage, settings=settings or LabelSettings(), edits=edits, rng=rng
            )
        except RecordingError as error:
            raise RecordingError(f"{capture.source}: {error}") from None
        # before the trial, whose file tells that all of it is there
        if forces_file is not None and capture.forces is not None:
            save_forces(capture.forces, forces_file)
        write_trial(
            path,
            images.chunks(ROW_GROUP),
            facts=capture,
            time_s=capture.frame_time_s,
            labels=labels,
            reference=reference,
            first_reference=capture.reference if labels.labelling and labels.labelling.first_reference else None,
        )


@dataclass(frozen=True, kw_only=True)
class Footage:
    """Frames of a recording for whoever labels it, decoded once before."""

    motion: Float[np.ndarray, " frames"]
    """See `measure_motion`."""
    read: Callable[[Sequence[int]], Iterator[Frame]]
    """Gives frames of rising numbers."""


def _read_footage(capture: Capture, images: Spool, on_progress: OnProgress | None) -> Footage:
    """Decode the frames of a recording and put them by, encoded as they are stored."""

    def keep() -> Iterator[Soft]:
        for image, soft in in_turn(lambda frame: (encode_pixels(frame), soften(frame)), _frames(capture)):
            images.append(image)
            yield soft
            if on_progress is not None:
                on_progress(len(images), len(capture))

    def read(places: Sequence[int]) -> Iterator[Frame]:
        for place in places:
            where = f"frame {place} of {capture.source}"
            yield decode_pixels(images[place], size=(*capture.frame_size, 3), where=where)

    return Footage(motion=measure_motion(keep()), read=read)


def require_forces(capture: Capture) -> None:
    """Refuse a recording that has neither labels nor forces to find them from."""
    if capture.labels is None and capture.forces is None:
        raise RecordingError(
            f"{capture.source} has no forces, and without them there is no label; give the table of the force sensor"
        )


def label_footage(
    capture: Capture, footage: Footage, *, settings: LabelSettings, edits: Sequence[Edit], rng: np.random.Generator
) -> tuple[Frame, Labels]:
    """Image of the untouched sensor, and the labels that came with the recording, or are found."""
    index = capture.reference_index if settings.reference_frame is None else settings.reference_frame
    labels, found, image = capture.labels, None, capture.reference
    if labels is None:
        assert capture.forces is not None
        labels = found = label_trial(capture.frame_time_s, footage.motion, capture.forces, settings=settings, rng=rng)
    if image is not None and index is None:
        method = "recorded apart from the frames" if found else "came with the recording"
        choice = capture.reference_choice or ReferenceChoice(method=method)
    elif found is not None:
        untouched = np.array([reason is Reason.NO_CONTACT for reason in found.reason])
        choice = choose_reference(footage.read, untouched, index=index, method=settings.reference_method)
    elif index is None:
        raise RecordingError("no frame is known to be untouched; name one with --reference-frame")
    elif not 0 <= index < len(capture):
        raise RecordingError(f"the reference is frame {index} of {len(capture)}; name one from 0 on that is there")
    else:
        choice = ReferenceChoice(index=index, method="named")
    if image is None or index is not None:
        assert choice.index is not None  # without an image it is one of the frames
        (image,) = footage.read([choice.index])
    labelling = labels.labelling or Labelling(
        source=capture.source,
        forces=capture.forces.source if capture.forces else None,
        notes=capture.notes,
        reference=choice,
        clip=capture.clip,
        basis=found.basis if found else None,
        edits=tuple(edits),
        first_reference=_first_reference(capture, edits),
    )
    return image, replace(labels, labelling=labelling)


def _first_reference(capture: Capture, edits: Sequence[Edit]) -> ReferenceChoice | None:
    """What the first image of the untouched sensor was, where an edit named another: it is kept for who undoes that."""
    if capture.reference is None or all(one.kind is not EditKind.REFERENCE for one in edits):
        return None
    return capture.reference_choice or ReferenceChoice(method="came with the recording")


def _frames(capture: Capture) -> Iterator[Frame]:
    """Frames of a capture, which must be as many as it promised and of one size."""
    read = 0
    for frame in capture.read_frames():
        if frame.shape[:2] != capture.frame_size:
            raise RecordingError(
                f"frame {read} of {capture.source} is {frame.shape[0]} x {frame.shape[1]} pixels, not "
                f"{capture.frame_size[0]} x {capture.frame_size[1]} as its first; cut the recording there"
            )
        read += 1
        yield frame
    if read != len(capture):
        raise RecordingError(
            f"{capture.source} promised {len(capture)} frames but gave {read}; copy or export it again"
        )
