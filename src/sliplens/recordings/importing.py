"""Recordings imported as a labelled data set, one frame at a time; each trial is complete or absent."""

import os
import shutil
import tempfile
from abc import abstractmethod
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Any, TypeAlias, TypedDict, Unpack

import numpy as np
from jaxtyping import Bool
from threadpoolctl import threadpool_limits

from sliplens.codec import RESULT_FILE, load_record
from sliplens.errors import InputError, PartError, RecordingError, SliplensError
from sliplens.extras import require_keywords
from sliplens.files import output_folder, remove, whole_file, write_json
from sliplens.images import Soft, require_rgb, soften
from sliplens.progress import OnProgress, add_note, number_of, open_stage, report_each, report_progress, reporting
from sliplens.recordings import dataset
from sliplens.recordings.capture import Capture, Frame
from sliplens.recordings.dataset import Dataset, LeftOut, TrialInfo, load_dataset, trial_path
from sliplens.recordings.labelling import Corrections, Labelling, Reason, ReferenceChoice
from sliplens.recordings.labels.lag import describe_repeats, measure_motion
from sliplens.recordings.labels.margin import label_trial
from sliplens.recordings.manifest import ManifestRow, find_rows
from sliplens.recordings.options import LabelSettings, ReadOptions
from sliplens.recordings.sensor import SENSORS_FOLDER, SensorProfile, is_profile, load_profile, save_profile
from sliplens.recordings.source import open_source
from sliplens.recordings.splits import Group, SplitResult, assign_splits, load_splits, split_by_group
from sliplens.recordings.store import decode_pixels, encode_pixels, forces_path, in_turn, save_forces, write_trial
from sliplens.recordings.trial import label_by_friction, labels_of_margins
from sliplens.runner import MakePart, Work, part, require_executor, run_parts

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
            import_trial(job, path := trial_path(folder, job.capture.trial))
            write_json(folder / RESULT_FILE, dataset.trial_info(path, split=""))

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
    failed: dict[str, LeftOut] = {}
    with threadpool_limits(1, user_api="blas"), open_stage(title):
        try:
            run_parts(work, every, folder / PARTS, on=on)
        except PartError as error:
            if not error.errors.keys() <= (optional or {}).keys():
                raise
            for name, failure in error.errors.items():
                why = f"{failure}; the same command with --add tries it again"
                failed[name] = LeftOut(trial=name, source=(optional or {})[name], why=why)
    if len(failed) == len(trials):
        remove(folder / PARTS)
        raise RecordingError(f"no trial could be imported; the first: {failed[trials[0][1]].why}")
    rows: list[TrialInfo] = []
    for made in (folder / PARTS / each.path for each in every if each.name not in failed):
        rows.append(load_record(made / RESULT_FILE, TrialInfo, command="the interrupted command"))
        for path in (trial_path(made, rows[-1].trial), forces_path(made, rows[-1].trial)):
            if path.exists():  # else there are none, or they were moved before an interruption
                target = folder / path.relative_to(made)
                target.parent.mkdir(exist_ok=True)
                path.replace(target)
    return rows, [*failed.values()]


def require_forces(capture: Capture) -> None:
    """Refuse a recording that has neither labels nor forces to make them from."""
    if capture.labels is None and capture.forces is None:
        raise RecordingError(f"{capture.source} has no forces to label it by; give their table with --forces FILE")


def import_trial(job: TrialJob, path: Path) -> None:
    """Write a recording as a trial of a data set, with its own or automatic labels; complete or not at all."""
    capture, settings, corrections = job.capture, job.settings, job.corrections
    require_forces(capture)
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=path.parent) as file:
        footage = _Footage(capture, file)
        motion = measure_motion(footage.soften())
        labels, untouched, basis = capture.labels, np.zeros(len(capture), dtype=np.bool_), None
        try:
            if labels is None and corrections is not None and corrections.exclude:
                labels = labels_of_margins(np.full(len(capture), np.nan))
                labels = replace(labels, reason=(Reason.EXCLUDED,) * len(capture))
            elif labels is None:
                assert capture.forces is not None
                # random numbers that do not depend on the other trials
                rng = np.random.default_rng((0, *capture.trial.encode()))
                labels = label_trial(capture.frame_time_s, motion, capture.forces, settings=settings, rng=rng)
                basis, untouched = labels.basis, np.array([reason is Reason.NO_CONTACT for reason in labels.reason])
                if (doubt := describe_repeats(motion, capture.frame_time_s)) is not None:
                    basis = replace(basis, doubts=(*basis.doubts, doubt))
            elif settings.mu is not None and not labels.labelled.any():
                labels = label_by_friction(labels, settings.mu)
            index = capture.reference_index if settings.reference_frame is None else settings.reference_frame
            if capture.reference is not None and index is None:
                method = "came with the recording" if basis is None else "recorded apart from the frames"
                reference, choice = capture.reference, capture.reference_choice or ReferenceChoice(method=method)
            else:
                choice = choose_reference(footage.read, untouched, index=index)
                if index is not None and settings.reference_frame is None:
                    choice = capture.reference_choice or choice
                (reference,) = footage.read([choice.index or 0])
        except RecordingError as error:
            raise RecordingError(f"{capture.source}: {error}{job.cure}") from None
        # for who takes the correction back
        replaced = capture.reference is not None and corrections is not None and corrections.reference_frame is not None
        first = capture.reference_choice or ReferenceChoice(method="came with the recording")
        labelling = labels.labelling or Labelling(
            source=capture.source,
            forces=capture.forces.source if capture.forces else None,
            notes=capture.notes,
            reference=choice,
            basis=basis,
            corrections=corrections,
            first_reference=first if replaced else None,
        )
        # before the trial, whose file means that all of it is there
        if capture.forces is not None:
            save_forces(capture.forces, forces_path(path.parent.parent, path.stem))
        write_trial(
            path,
            map(footage.image, range(len(capture))),
            facts=capture,
            time_s=capture.frame_time_s,
            labels=replace(labels, labelling=labelling),
            reference=reference,
            first_reference=capture.reference if labelling.first_reference else None,
        )


class _Footage:
    """Frames of a recording, decoded once and spooled to a temporary file, to be read again in any order."""

    def __init__(self, capture: Capture, file: IO[bytes]) -> None:
        self.capture, self._file, self._ends = capture, file, array("q", [0])

    def soften(self) -> Iterator[Soft]:
        """Decode, check and spool the frames; yields them softened."""
        capture, count = self.capture, 0

        def encode(item: tuple[int, Frame]) -> tuple[bytes, Soft]:
            number, frame = item
            require_rgb(frame, what=f"levels of frame {number} of {capture.source}")
            if frame.shape[:2] != capture.frame_size:
                raise RecordingError(f"frame {number} of {capture.source} is of another size; cut the recording there")
            return encode_pixels(frame), soften(frame)

        for count, (image, soft) in enumerate(in_turn(encode, enumerate(capture.read_frames())), start=1):
            self._file.write(image)
            self._ends.append(self._file.tell())
            yield soft
            report_progress(count, len(capture))
        if count != len(capture):
            raise RecordingError(f"{capture.source} promised {len(capture)} frames but gave {count}; copy it again")

    def image(self, place: int) -> bytes:
        """Read an encoded frame."""
        self._file.seek(self._ends[place])
        return self._file.read(self._ends[place + 1] - self._ends[place])

    def read(self, places: Sequence[int]) -> Iterator[Frame]:
        """Read some frames."""
        for place in places:
            where = f"frame {place} of {self.capture.source}"
            yield decode_pixels(self.image(place), size=(*self.capture.frame_size, 3), where=where)


def choose_reference(
    read: Callable[[Sequence[int]], Iterable[Frame]],
    untouched: Bool[np.ndarray, " frames"],
    *,
    index: int | None = None,
) -> ReferenceChoice:
    """Choose the reference among the untouched frames before the contact, or take the one that is named.

    The least energy of contact decides: the mean absolute difference from the median of the untouched frames, after the
    slow part of the image is subtracted. A contact changes markers and rims, a lamp that warms up changes all of the
    image alike, and the first frame often holds the hand that started the recording. Only the first stretch of
    untouched frames counts, of a long one 200 frames, evenly spread.

    `read` reads frames of rising numbers; `index` is the reference by hand, which may touch. Without either, and for a
    number that is not there, a `RecordingError` is raised.
    """
    if index is not None and not 0 <= index < len(untouched):
        raise RecordingError(f"the reference is frame {index} of {len(untouched)}; name one from 0 on that is there")
    if index is not None:
        return ReferenceChoice(index=index, method="named")
    places = np.flatnonzero(untouched)
    if not len(places):
        raise RecordingError("no frame is known to be untouched; name the reference frame by hand")
    from scipy.ndimage import uniform_filter  # noqa: PLC0415 (takes as long to import as all else here)

    before = places[places - places[:1] == np.arange(len(places))]
    # no more at a time, to bound the memory
    compared = before[np.linspace(0, len(before) - 1, min(len(before), 200)).round().astype(int)].tolist()
    soft = np.stack(list(map(soften, read(compared))))
    difference = (soft - np.median(soft, axis=0)).astype(np.float64)
    # the slow part of an image is a mean over 9 blocks: wider than a contact's rim, narrower than the light's fall
    difference -= uniform_filter(difference, 9, mode="mirror", axes=(1, 2))
    energies = [float(np.mean(np.abs(image))) for image in difference]
    return ReferenceChoice(index=compared[int(np.argmin(energies))], method="least contact energy")


class ImportOptions(TypedDict, total=False):
    """More options of `import_recordings`, each None or False if left out."""

    reference: Path | str | None
    """Image of the untouched sensor, where a manifest names none."""
    day: int | None
    """Day of the recordings, counted from 1."""
    condition: str | None
    """State of the surface, such as dry or wet."""
    object: str | None
    """Name of the object."""
    format: str | None
    """Name of a format (docs/recordings.md); recognised by file names if None."""
    validation_trials: int | None
    """Number of trials to validate: the last before those that test."""
    test_trials: int | None
    """Number of trials to test: the last ones."""


def import_recordings(
    sources: Path | str | Sequence[Path | str],
    *,
    out: Path | str,
    forces: Path | str | None = None,
    sensor: SensorProfile | Path | str | None = None,
    splits: Mapping[str, str] | Path | str | None = None,
    reading: ReadOptions | None = None,
    labelling: LabelSettings | None = None,
    add: bool = False,
    on: str = "serial",
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
    **options: Unpack[ImportOptions],
) -> Dataset:
    """Import recordings and label every frame with its safety margin.

    Tare, axes, sign, lag and friction are estimated from each trial unless `labelling` gives them (docs/recordings.md).
    Labels that come with a recording stay; `Dataset.doubts` lists doubts about the others. An import that was
    interrupted goes on where it stopped.

    Parameters
    ----------
    sources
        Bags, videos, folders of images, arrays, tables of stills or data sets of sliplens. In a folder of
        recordings or a manifest (`sliplens.recordings.manifest`) a trial that cannot be imported, or that ended its
        process three times, does not stop the others: `Dataset.left_out` lists it, and `add` tries it again.
    out
        Folder to make.
    forces
        Table of forces beside a video or folder of images (CSV); short for `reading.forces`.
    sensor
        Name of the sensor, or its profile (`SensorProfile`, its TOML file, the name of one that comes with sliplens),
        which prepares the frames and is stored with them.
    splits
        Split of each trial, a table of them (CSV), or `trial`, `object` or `day` to assign them: see `split_dataset`.
    reading
        Facts about the sources.
    labelling
        Facts about forces and friction.
    add
        If True, add to the data set in `out`. Its trials stay, and so do their splits unless `splits` assigns all of
        them.
    on
        Where trials are made: `serial` (several side by side in threads), `processes`, `processes=4`, `ray`.
    **options
        `ImportOptions`. By default the reference is that of the source, else one of the frames before the contact.

    See Also
    --------
    make_profile : Make the profile of a sensor from a recording.
    split_dataset : Assign trials to training, validation and test.
    label_dataset : Compute labels again.

    Examples
    --------
    >>> import sliplens as sl
    >>> data = sl.import_recordings("cup.mp4", forces="cup.csv", out="data", sensor="tip")  # doctest: +SKIP
    >>> data.trials[0].trial  # doctest: +SKIP
    'cup'
    """
    require_keywords(import_recordings, options)
    require_executor(on)
    paths = [Path(source) for source in ([sources] if isinstance(sources, Path | str) else sources)]
    reading, labelling = reading or ReadOptions(), labelling or LabelSettings()
    reading = reading if forces is None else replace(reading, forces=Path(forces))
    last = options.get("validation_trials"), options.get("test_trials")
    if splits is not None and last != (None, None):
        raise InputError("splits come from a file or from numbers of trials, not from both; leave one out")
    work = _prepare_work(paths, sensor=sensor, reading=reading, labelling=labelling, options=options)
    with reporting(on_progress):
        before = load_dataset(out) if add else None
        old, left_out = ((), ()) if before is None else (before.trials, before.left_out)
        with open_stage("Opening the recordings"):
            lost = work.open_all()
        names = {info.trial for info in old}
        jobs = {item: job for item, job in work.jobs.items() if job.capture.trial not in names}
        if existing := [job.capture.trial for item, job in work.jobs.items() if item not in jobs]:
            count = number_of(len(existing), "trial")
            add_note(f"already in {out}, and left as it is: {count}, such as {existing[0]}")
        if before is not None and not jobs:
            dataset.report_dataset(before, existed=True)
            return replace(before, left_out=tuple(lost))
        captures = [job.capture for job in jobs.values()]
        _require_names(captures, lost)
        plan = None if splits is None else load_splits(splits)
        assigned = _assign(old, captures, plan, last)  # a mistake in the splits is found before anything slow
        config = {**work.recipe(), "splits": plan, "last_trials": last}
        config |= {} if before is None else {"added_to": before.hash}
        with output_folder(Path(out), stage="import", config=config, overwrite=overwrite or add) as output:
            if not output.complete:
                folder = output.folder
                if before is not None:
                    _link_trials(before.folder, folder)
                trials = [(item, job.capture.trial, len(job.capture)) for item, job in jobs.items()]
                listed = [job.capture for item, job in jobs.items() if work.rows[item[0]].trial]
                optional = {capture.trial: capture.source for capture in listed}
                new, failed = write_trials(work, trials, folder, title="Importing frames", on=on, optional=optional)
                names = {info.trial for info in new}
                written = [job for job in jobs.values() if job.capture.trial in names]
                assigned = _assign(old, [job.capture for job in written], plan, last)
                for used in {job.profile.name: job.profile for job in written if job.profile}.values():
                    save_profile(used, folder / SENSORS_FOLDER / f"{used.name}.toml")
                table = [replace(info, split=split) for info, split in zip([*old, *new], assigned.splits, strict=True)]
                # trials left out before stay listed
                missing = {trial.trial: trial for trial in (*left_out, *lost, *failed)}
                missing = [trial for name, trial in missing.items() if name not in {info.trial for info in table}]
                simulated = all(job.capture.simulated for job in written) and (before is None or before.simulated)
                dataset.write_dataset_table(folder, table, simulated=simulated, left_out=missing)
                remove(folder / PARTS)
        for message in assigned.notes:
            add_note(message)
        return dataset.report_dataset(Path(out), existed=output.complete)


def _prepare_work(
    paths: Sequence[Path],
    *,
    sensor: SensorProfile | Path | str | None,
    reading: ReadOptions,
    labelling: LabelSettings,
    options: ImportOptions,
) -> "_ImportWork":
    """List the recordings, each with the facts that its manifest or else the call gives."""
    if reading.forces is not None and len(paths) > 1:
        raise InputError("one table of forces goes with one recording; name what belongs together in a manifest (CSV)")
    reference, format = options.get("reference"), options.get("format")
    if reference is not None and labelling.reference_frame is not None:
        raise InputError("the untouched sensor is named twice; give --reference or --reference-frame, not both")
    defaults = ManifestRow(
        trial="",
        video=Path(),
        sensor=load_profile(sensor) if sensor is not None and is_profile(sensor) else sensor and str(sensor),
        day=options.get("day"),
        object=options.get("object"),
        condition=options.get("condition"),
        mu=labelling.mu,
        reference=labelling.reference_frame if reference is None else Path(reference),
    )
    rows = []
    for path in paths:
        # a path that is one recording becomes a row without a name
        single = format is not None or reading.forces is not None
        for row in (None if single else find_rows(path)) or (replace(defaults, video=path),):
            listed = {name: value for name, value in vars(row).items() if value is not None}
            options_of_row = {name: getattr(row.reading, name) for name in row.reading.given()}
            rows.append(replace(defaults, **listed | {"reading": replace(reading, **options_of_row)}))
    return _ImportWork(rows=tuple(rows), labelling=labelling, format=format)


_Item: TypeAlias = tuple[int, int]  #: Number of a row, and of a trial in it.


@dataclass(frozen=True, kw_only=True)
class _ImportWork(TrialWork):
    """Work on recordings, which every process opens again by their paths."""

    rows: tuple[ManifestRow, ...]  # recordings; those without a name of their own must not be left out
    labelling: LabelSettings
    format: str | None
    jobs: dict[_Item, TrialJob] = field(default_factory=dict)

    def __getstate__(self) -> dict:
        return {**vars(self), "jobs": {}}  # every process opens its own

    def open_all(self) -> list[LeftOut]:
        """Open all recordings; return those of a manifest or a folder that cannot be opened."""
        left_out = []
        for number, row in enumerate(report_each(self.rows)):
            try:
                self._open_row(number)
            except SliplensError as error:
                if not row.trial:
                    raise
                left_out.append(LeftOut(trial=row.trial, source=str(row.video), why=str(error)))
        return left_out

    def open(self, item: _Item) -> TrialJob:
        if item not in self.jobs:
            self.jobs.clear()  # of another row
            self._open_row(item[0])
        return self.jobs[item]

    def _open_row(self, number: int) -> None:
        row = self.rows[number]
        profile = load_profile(row.sensor) if row.sensor is not None and is_profile(row.sensor) else None
        index, image = (row.reference, None) if isinstance(row.reference, int) else (None, row.reference)
        opened = open_source(
            row.video, reference=image, format=self.format, options=row.reading, sensor=profile, whole=True
        )
        # a profile names the sensor itself
        facts = {"day": row.day, "object": row.object, "condition": row.condition}
        facts |= {"sensor": None if profile else row.sensor, "trial": (row.trial or None) if len(opened) == 1 else None}
        facts = {name: fact for name, fact in facts.items() if fact is not None}
        captures = [replace(capture, **facts) for capture in opened]
        if row.trial:
            _require_names(captures)
            for capture in captures:
                require_forces(capture)
        settings = replace(self.labelling, reference_frame=index, mu=row.mu)
        settings = settings if profile is None else profile.settings(settings)
        for place, capture in enumerate(captures):
            self.jobs[number, place] = TrialJob(capture=capture, settings=settings, profile=profile)

    def recipe(self) -> dict:
        """Return all that shapes the trials; a change of a file beside them changes nothing."""

        def describe(value: object) -> object:
            if isinstance(value, ManifestRow | ReadOptions):
                return {name: describe(each) for name, each in vars(value).items()}
            if not isinstance(value, Path):
                return value
            files = [value] if value.is_file() else [file for file in value.rglob("*") if file.is_file()]
            stats = [file.stat() for file in files]  # quicker than to read all of it
            changed = max((each.st_mtime_ns for each in stats), default=0)
            return str(value.resolve()), sum(each.st_size for each in stats), changed

        return {"rows": [*map(describe, self.rows)], "labelling": self.labelling, "format": self.format}


def _link_trials(source: Path, folder: Path) -> None:
    """Link the trials of a data set into another folder, or copy them where links are impossible."""

    def link(file: str, target: str) -> None:
        if not Path(target).exists():
            try:
                os.link(file, target)
            except OSError:  # another disk, or one that has no links
                with whole_file(Path(target)) as part:
                    shutil.copyfile(file, part)

    for name in ("trials", "forces", "audit", SENSORS_FOLDER):
        if (source / name).is_dir():
            shutil.copytree(source / name, folder / name, copy_function=link, dirs_exist_ok=True)


def _require_names(captures: Sequence[Capture], left_out: Sequence[LeftOut] = ()) -> None:
    if not captures:
        first = f"no trial could be imported; the first: {left_out[0].why}" if left_out else ""
        raise RecordingError(first or "there is no trial to import; name a recording")
    if twice := [name for name, count in Counter(capture.trial for capture in captures).items() if count > 1]:
        raise InputError(f"several recordings are named {', '.join(twice)}; rename their files")
    for capture in captures:
        if not capture.sensor:
            raise InputError(f"{capture.source} does not name its sensor, and a network is of one; add --sensor")


def _assign(
    old: Sequence[TrialInfo],
    captures: Sequence[Capture],
    plan: Mapping[str, str] | Group | None,
    last: tuple[int | None, int | None],
) -> SplitResult:
    """Assign the splits of all trials, the old ones first: by a plan, or the last new trials validate and test."""
    if plan is not None:
        trials = [*old, *captures]
        return assign_splits(trials, plan) if isinstance(plan, Mapping) else split_by_group(trials, by=plan)
    splits, (validation, test) = [capture.split or "train" for capture in captures], (number or 0 for number in last)
    if validation < 0 or test < 0:
        raise InputError(f"numbers of trials are not negative, got {validation} and {test}; give 0 or more")
    if (training := len(captures) - validation - test) < 0:
        raise InputError(f"{validation} to validate and {test} to test are more than {len(captures)}; give fewer")
    if last != (None, None):
        splits = ["train"] * training + ["validation"] * validation + ["test"] * test
    names = tuple(trial.trial for trial in (*old, *captures))
    return SplitResult(trials=names, splits=(*(info.split for info in old), *splits), notes=())
