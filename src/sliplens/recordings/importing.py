"""From recordings to a labelled data set on disk, one frame at a time; and its labels made anew."""

import shutil
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from sliplens.errors import InputError, RecordingError
from sliplens.files import output_folder
from sliplens.progress import OnProgress, note, stage, wrote
from sliplens.recordings.capture import Capture, Frame
from sliplens.recordings.dataset import Dataset, load_dataset, tell_flags, trial_info, trial_path, write_dataset_table
from sliplens.recordings.formats.stored import read_stored
from sliplens.recordings.labelling import Labelling, ReferenceChoice
from sliplens.recordings.labels import Reason, choose_reference, label_trial, measure_motion
from sliplens.recordings.options import LabelSettings, ReadOptions
from sliplens.recordings.source import open_source
from sliplens.recordings.splits import SPLITS_FILE, SplitPlan, assign_splits, read_splits, write_split_record
from sliplens.recordings.store import encode_frames, forces_path, read_header, save_forces, write_trial
from sliplens.recordings.trial import Labels


def import_recordings(
    sources: Path | str | Sequence[Path | str],
    *,
    out: Path | str,
    forces: Path | str | None = None,
    sensor: str | None = None,
    day: int | None = None,
    condition: str | None = None,
    object: str | None = None,
    format: str | None = None,
    splits: SplitPlan | Path | str | None = None,
    validation_trials: int | None = None,
    test_trials: int | None = None,
    reading: ReadOptions | None = None,
    labelling: LabelSettings | None = None,
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
) -> Dataset:
    """Import recordings and label every frame with its safety margin.

    Tare, axes, sign, lag and friction are found from each trial itself unless `labelling` gives them. What brings its
    own labels keeps them. An import that was interrupted goes on where it stopped.

    Parameters
    ----------
    sources
        Bags, videos, folders of images, LeRobot data sets, lists of the thesis or data sets of sliplens.
    out
        Folder to make.
    forces
        Table of forces beside a video or folder of images (CSV); short for `reading.forces`.
    sensor, day, condition, object
        What the trials are; as the source tells where None.
    format
        Row of `FORMATS`; recognised by names if None.
    splits
        Rules that deal the trials to splits, or their file (TOML).
    validation_trials, test_trials
        So many of the last trials test, and so many before them validate, in place of rules.
    reading
        What is known of the sources.
    labelling
        What is known of forces and friction.

    Raises
    ------
    InputError
        If a source is missing, damaged or of no known format, or `out` holds something else.
    RecordingError
        If a trial has neither labels nor forces, nothing touches, or it never slips and no friction is given.
    """
    reading, labelling = reading or ReadOptions(), labelling or LabelSettings()
    paths = [Path(source) for source in ([sources] if isinstance(sources, Path | str) else sources)]
    if forces is not None:
        reading = replace(reading, forces=Path(forces))
    if reading.forces is not None and len(paths) > 1:
        raise InputError("one table of forces goes with one recording; import the trials one by one")
    facts = {"sensor": sensor, "day": day, "condition": condition, "object": object}
    with stage(on_progress, "Opening the recordings"):
        found = [one for path in paths for one in open_source(path, format=format, options=reading, whole=True)]
    captures = [replace(one, **{name: fact for name, fact in facts.items() if fact is not None}) for one in found]
    _require_names(captures)
    if splits is not None and (validation_trials is not None or test_trials is not None):
        raise InputError("splits come from a file or from numbers of trials, not from both; leave one out")
    plan = splits if splits is None or isinstance(splits, SplitPlan) else read_splits(Path(splits))
    dealt = None if plan is None else assign_splits(plan, captures)
    names = _deal(captures, validation_trials, test_trials) if dealt is None else dealt.splits
    config = {
        **facts,
        "format": format,
        "validation_trials": validation_trials,
        "test_trials": test_trials,
        "sources": [_fingerprint(path) for path in paths],
        "reading": {
            name: _fingerprint(value) if isinstance(value, Path) else value
            for name in reading.given()
            for value in [getattr(reading, name)]
        },
        "labelling": labelling,
        "splits": None if plan is None else plan.rules,
    }
    with output_folder(Path(out), stage="import", config=config, overwrite=overwrite) as output:
        if not output.complete:
            _write_trials(output.folder, captures, names, labelling, on_progress, title="Importing frames")
            if plan is not None and dealt is not None:
                write_split_record(output.folder, plan, captures, dealt)
    for message in dealt.notes if dealt else ():
        note(on_progress, message)
    return _tell(load_dataset(out), on_progress, kept=output.complete)


def label_dataset(
    data: Dataset | Path | str,
    *,
    out: Path | str,
    labelling: LabelSettings | None = None,
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
) -> Dataset:
    """Label the trials of a data set anew, from the frames and the force samples that it keeps; splits stay.

    Parameters
    ----------
    data
        Data set that keeps its force samples, or its folder.
    out
        Folder to make. The data set's own gets the new labels once all of them are there.
    labelling
        What is known of forces and friction.

    Raises
    ------
    InputError
        If a trial has no forces, or its labels did not come from them and would be overwritten.
    RecordingError
        If nothing touches, or a trial never slips and no friction is given.
    """
    data = data if isinstance(data, Dataset) else load_dataset(data)
    labelling, out = labelling or LabelSettings(), Path(out)
    captures = read_stored(data.folder)
    in_place = out.resolve() == data.folder.resolve()
    for capture in captures:
        kept = capture.labels.labelling if capture.labels else None
        if capture.forces is None:
            raise InputError(
                f"{capture.trial} of {data.folder} has no forces, and without them there is no label; "
                "import it again with its table of forces"
            )
        if in_place and (kept is None or kept.basis is None):
            raise InputError(
                f"the labels of {capture.trial} did not come from its forces and would be lost; "
                "name a new folder with --output"
            )
    config = {"labelling": labelling, "data_hash": data.hash}
    with output_folder(out, stage="label", config=config, overwrite=overwrite or in_place) as output:
        if not output.complete:
            bare, names = [_without_labels(one) for one in captures], [info.split for info in data.trials]
            _write_trials(output.folder, bare, names, labelling, on_progress, title="Labelling frames")
            if (data.folder / SPLITS_FILE).is_file():
                shutil.copyfile(data.folder / SPLITS_FILE, output.folder / SPLITS_FILE)
    return _tell(load_dataset(out), on_progress, kept=output.complete)


def _tell(data: Dataset, on_progress: OnProgress | None, *, kept: bool) -> Dataset:
    for info in data.trials:
        tell_flags(info.trial, read_header(trial_path(data.folder, info.trial)).labelling, on_progress)
    wrote(on_progress, data.folder, f"{len(data.trials)} trials, {data.frames:,} frames", kept=kept)
    return data


def _require_names(captures: Sequence[Capture]) -> None:
    if not captures:
        raise RecordingError("there is no trial to import; name a recording")
    twice = [name for name, count in Counter(one.trial for one in captures).items() if count > 1]
    if twice:
        raise InputError(f"several recordings are named {', '.join(twice)}; rename their files")
    for capture in captures:
        if not capture.sensor:
            raise InputError(f"{capture.source} does not tell its sensor, and a network is of one; add --sensor")


def _deal(captures: Sequence[Capture], validation_trials: int | None, test_trials: int | None) -> list[str]:
    count = len(captures)
    if validation_trials is None and test_trials is None:
        return [capture.split or "train" for capture in captures]
    validation, test = validation_trials or 0, test_trials or 0
    if validation < 0 or test < 0:
        raise InputError("numbers of trials are not negative; give 0 or more")
    training = count - validation - test
    if training < 0:
        raise InputError(
            f"{validation} trials to validate and {test} to test are more than the {count} there are; give fewer"
        )
    return ["train"] * training + ["validation"] * validation + ["test"] * test


def _fingerprint(path: Path) -> list[object]:
    """What tells a file that changed from one that did not, without reading all of it."""
    if not path.exists():
        raise InputError(f"{path} does not exist; check the path")
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    stats = [file.stat() for file in files]
    return [
        str(path.resolve()),
        sum(stat.st_size for stat in stats),
        max((stat.st_mtime_ns for stat in stats), default=0),
    ]


def _without_labels(capture: Capture) -> Capture:
    """A stored trial as if it came from where it was recorded, with what was noted then."""
    kept = capture.labels.labelling if capture.labels else None
    if kept is None:
        return replace(capture, labels=None)
    return replace(capture, labels=None, source=kept.source, notes=kept.notes, reference_choice=kept.reference)


def _write_trials(
    folder: Path,
    captures: Sequence[Capture],
    splits: Iterable[str],
    settings: LabelSettings,
    on_progress: OnProgress | None,
    *,
    title: str,
) -> None:
    """Write the trials of a data set that are not there yet, and its table."""
    table, done, total = [], 0, sum(map(len, captures))
    with stage(on_progress, title) as count:
        for number, (capture, split) in enumerate(zip(captures, splits, strict=True)):
            path = trial_path(folder, capture.trial)
            # a trial is there whole or not at all, and the folder is of this very command
            if not path.is_file():
                import_trial(
                    capture,
                    path,
                    settings=settings,
                    rng=np.random.default_rng((settings.seed, number)),
                    forces_file=forces_path(folder, capture.trial),
                    on_progress=lambda written, _, before=done: count(before + written, total),
                )
            done += len(capture)
            count(done, total)
            table.append(trial_info(path, split=split))
    write_dataset_table(folder, table, simulated=all(capture.simulated for capture in captures))


def import_trial(
    capture: Capture,
    path: Path,
    *,
    settings: LabelSettings | None = None,
    rng: np.random.Generator,
    forces_file: Path | None = None,
    on_progress: OnProgress | None = None,
) -> None:
    """Write a recording as a trial of a data set, with the labels that came with it, or found; whole or not at all.

    The frames are read several times, never all at once: to see the image move, to find the untouched sensor, and to
    write them. The samples of the force sensor, from which labels can be made anew, are kept in `forces_file`.
    """
    settings = settings or LabelSettings()
    if capture.labels is None and capture.forces is None:
        raise RecordingError(
            f"{capture.source} has no forces, and without them there is no label; give the table of the force sensor"
        )
    try:
        reference, labels = _label(capture, settings, rng)
    except RecordingError as error:
        raise RecordingError(f"{capture.source}: {error}") from None
    # before the trial, whose file tells that all of it is there
    if forces_file is not None and capture.forces is not None:
        save_forces(capture.forces, forces_file)
    images = encode_frames(_frames(capture, on_progress))
    write_trial(path, images, facts=capture, time_s=capture.frame_time_s, labels=labels, reference=reference)


def _label(capture: Capture, settings: LabelSettings, rng: np.random.Generator) -> tuple[Frame, Labels]:
    """Image of the untouched sensor, and the labels that came with the recording, or are found."""
    index = capture.reference_index if settings.reference_frame is None else settings.reference_frame
    labels, found, image = capture.labels, None, capture.reference
    if labels is None:
        assert capture.forces is not None
        motion = measure_motion(_frames(capture))
        labels = found = label_trial(capture.frame_time_s, motion, capture.forces, settings=settings, rng=rng)
    if image is not None and index is None:
        method = "recorded apart from the frames" if found else "came with the recording"
        choice = capture.reference_choice or ReferenceChoice(method=method)
    elif found is not None:
        untouched = np.array([reason is Reason.NO_CONTACT for reason in found.reason])
        choice = choose_reference(capture.read_frames, untouched, index=index, method=settings.reference)
    elif index is None:
        raise RecordingError("no frame is known to be untouched; name one with --reference-frame")
    elif not 0 <= index < len(capture):
        raise RecordingError(f"the reference is frame {index} of {len(capture)}; name one from 0 on that is there")
    else:
        choice = ReferenceChoice(index=index, method="named")
    if image is None or index is not None:
        image = next(islice(capture.read_frames(), choice.index, None))
    labelling = labels.labelling or Labelling(
        source=capture.source,
        forces=capture.forces.source if capture.forces else None,
        notes=capture.notes,
        reference=choice,
        clip=capture.clip,
        basis=found.basis if found else None,
    )
    return image, replace(labels, labelling=labelling)


def _frames(capture: Capture, on_progress: OnProgress | None = None) -> Iterator[Frame]:
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
        if on_progress is not None:
            on_progress(read, len(capture))
    if read != len(capture):
        raise RecordingError(
            f"{capture.source} promised {len(capture)} frames but gave {read}; copy or export it again"
        )
