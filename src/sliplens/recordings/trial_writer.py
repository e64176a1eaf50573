"""Labelled trials written from recordings, each whole or not at all, wherever that is done."""

from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from sliplens.codec import RESULT_FILE, load_record, save_record
from sliplens.errors import RecordingError, ShardError, SliplensError
from sliplens.files import remove
from sliplens.images import require_rgb
from sliplens.parts import Shard, shard
from sliplens.progress import OnProgress, number_of, stage
from sliplens.recordings.capture import Capture, Frame
from sliplens.recordings.dataset import LeftOut, TrialInfo, trial_info, trial_path
from sliplens.recordings.labelling import Edit, EditKind, Labelling, ReferenceChoice
from sliplens.recordings.labels import Reason, choose_reference, label_trial, measure_motion, soften
from sliplens.recordings.labels.lag import Soft
from sliplens.recordings.options import LabelSettings
from sliplens.recordings.repeats import describe_repeats
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
from sliplens.shards import MakePart, Work, make_parts


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


@dataclass(frozen=True, kw_only=True)
class WrittenTrial:
    """What came of a trial: its row of the data set's table, or why it was left out."""

    info: TrialInfo | None = None
    left_out: LeftOut | None = None


class TrialWork(Work):
    """Work on whole trials, each of which becomes a data set of its own, to be taken into that of all."""

    in_threads = True  # decoding, arrays and compression let go of the interpreter's lock

    @abstractmethod
    def open(self, item: Any) -> TrialJob:
        """Open the trial of a shard."""

    def begin(self) -> MakePart:
        """Make data sets of one trial."""
        leave_cores()

        def make(item: Any, path: Path, on_progress: OnProgress) -> None:
            job = self.open(item)
            capture = job.capture
            trial, samples = trial_path(path, capture.trial), forces_path(path, capture.trial)
            try:
                own = {"settings": job.settings, "edits": job.edits, "rng": trial_rng(job.settings, capture.trial)}
                import_trial(capture, trial, **own, forces_file=samples, on_progress=on_progress)
            except SliplensError as error:
                if job.undo:
                    raise RecordingError(f"{error}; {job.undo}") from None
                if not job.one_of_many:
                    raise
                samples.unlink(missing_ok=True)
                left_out = LeftOut(trial=capture.trial, source=capture.source, why=str(error))
                written = WrittenTrial(left_out=left_out)
            else:
                written = WrittenTrial(info=trial_info(trial, split=""))
            save_record(written, path / RESULT_FILE)

        return make


def trial_rng(settings: LabelSettings, trial: str) -> np.random.Generator:
    """Random numbers for the labels of a trial, whichever others there are."""
    return np.random.default_rng((settings.seed, *trial.encode()))


def leave_cores() -> AbstractContextManager:
    """Keep the threads of NumPy's matrices, which are small here, from taking cores while they spin."""
    return threadpool_limits(1, user_api="blas")


@contextmanager
def write_trials(
    work: TrialWork,
    trials: Sequence[tuple[Any, str, int]],
    folder: Path,
    *,
    title: str,
    on: str,
    retry_failed: bool,
    on_progress: OnProgress | None,
) -> Iterator[tuple[list[TrialInfo], list[LeftOut]]]:
    """Write trials into the folder of a data set; gives their rows, and what was left out of many.

    Of each trial the item of its shard, its name and its number of frames are given. What was done is kept for another
    try until all within this ends well. A trial of many that was set aside, as one that ends its process again and
    again, is left out like one that is damaged.
    """
    parts = folder / "parts"

    def shards() -> Iterator[Shard]:
        # the folder is of these recordings and settings alone (`files.output_folder`)
        return (shard(item, trial=name, frames=frames, recipe="trial", shown=name) for item, name, frames in trials)

    rows: list[TrialInfo] = []
    left_out: list[LeftOut] = []
    set_aside: dict[str, TrialJob] = {}
    with leave_cores(), stage(on_progress, title) as count:
        try:
            make_parts(work, shards, parts, title=title, on=on, retry_failed=retry_failed, on_progress=count)
        except ShardError as error:
            set_aside = {name: work.open(item) for item, name, _ in trials if name in error.why}
            if len(set_aside) == len(trials) or not all(job.one_of_many for job in set_aside.values()):
                raise
            cure = "the same command with --add tries it again"
            left_out = [
                LeftOut(trial=name, source=job.capture.source, why=f"{error.why[name]}; {cure}")
                for name, job in set_aside.items()
            ]
    for one in shards():
        if one.name in set_aside:
            continue
        part = parts / one.part
        written = load_record(part / RESULT_FILE, WrittenTrial, command="the interrupted command")
        if written.left_out is not None:
            left_out.append(written.left_out)
        if written.info is not None:
            rows.append(written.info)
            for path in (trial_path(part, written.info.trial), forces_path(part, written.info.trial)):
                if path.exists():  # else there are none, or they were taken before an interruption
                    target = folder / path.relative_to(part)
                    target.parent.mkdir(exist_ok=True)
                    path.replace(target)
    if left_out and not rows:
        remove(parts)
        raise RecordingError(f"no trial could be imported; the first: {left_out[0].why}")
    yield rows, left_out
    remove(parts)


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
            f"{capture.source} has no forces, and without them there is no label; give the table of the force sensor "
            "with --forces FILE, or in a folder of recordings under the name of the recording"
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
        doubt = describe_repeats(footage.motion, capture.frame_time_s)
        if doubt is not None:
            basis = replace(found.basis, doubts=(*found.basis.doubts, doubt))
            labels = found = replace(found, basis=basis)
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
        require_rgb(frame, what=f"levels of frame {read} of {capture.source}")
        if frame.shape[:2] != capture.frame_size:
            raise RecordingError(
                f"frame {read} of {capture.source} is {frame.shape[0]} x {frame.shape[1]} pixels, not "
                f"{capture.frame_size[0]} x {capture.frame_size[1]} as its first; cut the recording there"
            )
        read += 1
        yield frame
    if read != len(capture):
        raise RecordingError(
            f"{capture.source} promised {number_of(len(capture), 'frame')} but gave {read}; copy or export it again"
        )
