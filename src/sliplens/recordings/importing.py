"""Recordings imported as a labelled data set, one frame at a time."""

import os
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeAlias, TypedDict, Unpack

from sliplens.errors import InputError, RecordingError, SliplensError
from sliplens.files import output_folder, remove, whole_file
from sliplens.progress import OnProgress, add_note, number_of, open_stage, report_each, reporting
from sliplens.recordings.capture import Capture
from sliplens.recordings.dataset import (
    Dataset,
    LeftOut,
    TrialInfo,
    copy_profiles,
    load_dataset,
    report_dataset,
    save_profile,
    write_dataset_table,
)
from sliplens.recordings.manifest import ManifestRow, find_rows
from sliplens.recordings.options import LabelSettings, ReadOptions
from sliplens.recordings.sensor import SensorProfile, is_profile, load_profile
from sliplens.recordings.source import open_source
from sliplens.recordings.splits import Group, SplitResult, assign_splits, deal_splits, load_splits
from sliplens.recordings.trial_writer import PARTS, TrialJob, TrialWork, require_forces, write_trials
from sliplens.runner import require_executor


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
    """Row of `FORMATS`; recognised by names if None."""
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
    Labels that come with a recording stay. An import that was interrupted goes on where it stopped.

    Parameters
    ----------
    sources
        Bags, videos, folders of images, LeRobot data sets, lists of the thesis or data sets of sliplens. In a folder of
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
        Split of each trial, or a table of them (CSV), or `trial`, `object` or `day` to deal them; see `split_dataset`.
    reading
        Facts about the sources.
    labelling
        Facts about forces and friction.
    add
        If True, add to the data set in `out`. Its trials stay, and so do their splits unless `splits` deals all of
        them.
    on
        Where trials are made, a row of `runner.EXECUTORS`: `serial` (several side by side in threads), `processes`,
        `processes=4`, `ray`.
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
        old = () if before is None else before.trials
        with open_stage("Opening the recordings"):
            lost = work.open_all()
        names = {info.trial for info in old}
        jobs = {item: job for item, job in work.jobs.items() if job.capture.trial not in names}
        if existing := [job.capture.trial for item, job in work.jobs.items() if item not in jobs]:
            count = number_of(len(existing), "trial")
            add_note(f"already in {out}, and left as it is: {count}, such as {existing[0]}")
        if before is not None and not jobs:
            report_dataset(before, existed=True)
            return replace(before, left_out=tuple(lost))
        captures = [job.capture for job in jobs.values()]
        _require_names(captures, lost)
        plan = None if splits is None else load_splits(splits)
        dealt = _deal(old, captures, plan, last)  # a mistake in the splits is found before anything slow
        config = {**work.recipe(), "splits": plan, "last_trials": last}
        config |= {} if before is None else {"added_to": before.hash}
        with output_folder(Path(out), stage="import", config=config, overwrite=overwrite or add) as output:
            if not output.complete:
                folder = output.folder
                if before is not None:
                    _link_trials(before.folder, folder)
                trials = [(item, job.capture.trial, len(job.capture)) for item, job in jobs.items()]
                listed = [job.capture for item, job in jobs.items() if work.rows[item[0]].trial]
                new, failed = write_trials(
                    work,
                    trials,
                    folder,
                    title="Importing frames",
                    on=on,
                    optional={capture.trial: capture.source for capture in listed},
                )
                names = {info.trial for info in new}
                written = [job for job in jobs.values() if job.capture.trial in names]
                dealt = _deal(old, [job.capture for job in written], plan, last)
                for used in {job.profile.name: job.profile for job in written if job.profile}.values():
                    save_profile(folder, used)
                table = [replace(info, split=split) for info, split in zip([*old, *new], dealt.splits, strict=True)]
                # trials left out before stay listed
                missing = {trial.trial: trial for trial in (*(before.left_out if before else ()), *lost, *failed)}
                missing = [trial for name, trial in missing.items() if name not in {info.trial for info in table}]
                simulated = all(job.capture.simulated for job in written) and (before is None or before.simulated)
                write_dataset_table(folder, table, simulated=simulated, left_out=missing)
                remove(folder / PARTS)
        for message in dealt.notes:
            add_note(message)
        data = load_dataset(out)
        report_dataset(data, existed=output.complete)
        return data


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
    reference = options.get("reference")
    if reference is not None and labelling.reference_frame is not None:
        raise InputError("the untouched sensor is named twice; give --reference or --reference-frame, not both")
    profile = load_profile(sensor) if sensor is not None and is_profile(sensor) else None
    defaults = ManifestRow(
        trial="",
        video=Path(),
        forces=reading.forces,
        sensor=None if profile is not None or sensor is None else str(sensor),
        day=options.get("day"),
        object=options.get("object"),
        condition=options.get("condition"),
        mu=labelling.mu,
        reference=labelling.reference_frame if reference is None else Path(reference),
    )
    single = options.get("format") is not None or reading.forces is not None
    rows = [
        replace(defaults, **{name: value for name, value in vars(row).items() if value is not None})
        for path in paths
        # a path that is one recording becomes a row without a name
        for row in (None if single else find_rows(path)) or (replace(defaults, video=path),)
    ]
    return _ImportWork(
        rows=tuple(rows), reading=reading, labelling=labelling, profile=profile, format=options.get("format")
    )


_Item: TypeAlias = tuple[int, int]  #: Number of a row, and of a trial in it.


@dataclass(frozen=True, kw_only=True)
class _ImportWork(TrialWork):
    """Work on recordings, which every process opens again by their paths."""

    rows: tuple[ManifestRow, ...]  # recordings; those without a name of their own must not be left out
    reading: ReadOptions
    labelling: LabelSettings
    profile: SensorProfile | None
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
        row, profile = self.rows[number], self.profile
        if row.sensor is not None:
            profile = load_profile(row.sensor) if is_profile(row.sensor) else None
        index, image = (row.reference, None) if isinstance(row.reference, int) else (None, row.reference)
        settings = replace(self.labelling, reference_frame=index, mu=row.mu)
        facts = {"sensor": profile.name if profile else row.sensor, "day": row.day}
        facts |= {"object": row.object, "condition": row.condition}
        facts = {name: fact for name, fact in facts.items() if fact is not None}
        listed = {name: getattr(row.reading, name) for name in row.reading.given()}
        options = replace(self.reading, **listed, forces=row.forces)
        opened = open_source(
            row.video, reference=image, format=self.format, options=options, sensor=profile, whole=True
        )
        captures = [replace(capture, **facts) for capture in opened]
        if row.trial:
            captures = [replace(captures[0], trial=row.trial)] if len(captures) == 1 else captures
            _require_names(captures)
            for capture in captures:
                require_forces(capture)
        settings = settings if profile is None else profile.settings(settings)
        for index, capture in enumerate(captures):
            self.jobs[number, index] = TrialJob(capture=capture, settings=settings, profile=profile)

    def recipe(self) -> dict:
        """Return all that shapes the trials; a change of a file beside them changes nothing."""

        def describe(value: object) -> object:
            if not isinstance(value, Path):
                return value
            files = [value] if value.is_file() else [file for file in value.rglob("*") if file.is_file()]
            stats = [file.stat() for file in files]  # quicker than to read all of it
            changed = max((each.st_mtime_ns for each in stats), default=0)
            return str(value.resolve()), sum(each.st_size for each in stats), changed

        settings = {name: value for name, value in vars(self).items() if name not in {"rows", "reading", "jobs"}}
        rows, (reading,) = (
            [{name: describe(value) for name, value in vars(record).items()} for record in records]
            for records in (self.rows, [self.reading])
        )
        return settings | {"rows": rows, "reading": reading}


def _link_trials(source: Path, folder: Path) -> None:
    """Link the trials of a data set into another folder, or copy them where links are impossible."""

    def link(file: str, target: str) -> None:
        if not Path(target).exists():
            try:
                os.link(file, target)
            except OSError:  # another disk, or one that has no links
                with whole_file(Path(target)) as part:
                    shutil.copyfile(file, part)

    for name in ("trials", "forces", "audit"):
        if (source / name).is_dir():
            shutil.copytree(source / name, folder / name, copy_function=link, dirs_exist_ok=True)
    copy_profiles(source, folder)


def _require_names(captures: Sequence[Capture], left_out: Sequence[LeftOut] = ()) -> None:
    if not captures:
        first = f"no trial could be imported; the first: {left_out[0].why}" if left_out else ""
        raise RecordingError(first or "there is no trial to import; name a recording")
    if twice := [name for name, count in Counter(capture.trial for capture in captures).items() if count > 1]:
        raise InputError(f"several recordings are named {', '.join(twice)}; rename their files")
    for capture in captures:
        if not capture.sensor:
            raise InputError(f"{capture.source} does not name its sensor, and a network is of one; add --sensor")


def _deal(
    old: Sequence[TrialInfo],
    captures: Sequence[Capture],
    plan: Mapping[str, str] | Group | None,
    last: tuple[int | None, int | None],
) -> SplitResult:
    """Deal the splits of all trials, the old ones first: by a plan, or the last new trials validate and test."""
    if plan is not None:
        trials = [*old, *captures]
        return assign_splits(trials, plan) if isinstance(plan, Mapping) else deal_splits(trials, by=plan)
    splits, (validation, test) = [capture.split or "train" for capture in captures], (number or 0 for number in last)
    if validation < 0 or test < 0:
        raise InputError(f"numbers of trials are not negative, got {validation} and {test}; give 0 or more")
    if (training := len(captures) - validation - test) < 0:
        raise InputError(f"{validation} to validate and {test} to test are more than {len(captures)}; give fewer")
    if last != (None, None):
        splits = ["train"] * training + ["validation"] * validation + ["test"] * test
    return SplitResult(splits=(*(info.split for info in old), *splits), notes=())
