"""From recordings to a labelled data set on disk, one frame at a time."""

import os
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from sliplens.errors import InputError, RecordingError, SliplensError
from sliplens.files import output_folder, whole_file
from sliplens.progress import OnProgress, note, number_of, reporting, stage
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
from sliplens.recordings.trial_writer import (
    TrialJob,
    TrialWork,
    require_forces,
    write_trials,
)
from sliplens.runner import require_executor


def import_recordings(
    sources: Path | str | Sequence[Path | str],
    *,
    out: Path | str,
    forces: Path | str | None = None,
    reference: Path | str | None = None,
    sensor: SensorProfile | Path | str | None = None,
    day: int | None = None,
    condition: str | None = None,
    object: str | None = None,
    format: str | None = None,
    splits: Mapping[str, str] | Path | str | None = None,
    validation_trials: int | None = None,
    test_trials: int | None = None,
    reading: ReadOptions | None = None,
    labelling: LabelSettings | None = None,
    add: bool = False,
    on: str = "serial",
    retry_failed: bool = False,
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
) -> Dataset:
    """Import recordings and label every frame with its safety margin.

    Tare, axes, sign, lag and friction are found from each trial itself unless `labelling` gives them. What brings its
    own labels keeps them. An import that was interrupted goes on where it stopped.

    Parameters
    ----------
    sources
        Bags, videos, folders of images, LeRobot data sets, lists of the thesis or data sets of sliplens. Of a folder of
        recordings or a manifest (`sliplens.recordings.manifest`) a trial that cannot be imported, or that ended its
        process three times, does not stop the others: `Dataset.left_out` lists it, and `add` tries it again.
    out
        Folder to make.
    forces
        Table of forces beside a video or folder of images (CSV); short for `reading.forces`.
    reference
        Image of the untouched sensor, where a manifest names none; if None, as the source tells, else chosen among the
        frames before the contact.
    sensor
        Name of the sensor, or its profile (`SensorProfile`, its TOML file, the name of one that comes with sliplens),
        which frames go through and which is kept with them.
    day, condition, object
        What the trials are; as the source tells where None.
    format
        Row of `FORMATS`; recognised by names if None.
    splits
        Split of each trial, or a table of them (CSV), or `trial`, `object` or `day` to deal them; see `split_dataset`.
    validation_trials, test_trials
        So many of the last trials test, and so many before them validate, in place of rules.
    reading
        What is known of the sources.
    labelling
        What is known of forces and friction.
    add
        Add to the data set that `out` is; trials that are there already stay as they are, and so do their splits
        unless `splits` deals all of them anew.
    on, retry_failed
        Where trials are made, a row of `runner.EXECUTORS`: `serial` (several side by side in threads), `processes`,
        `processes=4`, `ray`; and whether those are tried again that failed before.

    Raises
    ------
    InputError
        If a source is missing, damaged or of no known format, or `out` holds something else.
    RecordingError
        If a trial has neither labels nor forces, nothing touches, or it never slips and no friction is given.
    PartError
        If some of several failed that may not be left out, or all of them, when all others are done.
    """
    require_executor(on)
    paths = [Path(source) for source in ([sources] if isinstance(sources, Path | str) else sources)]
    profile = load_profile(sensor) if sensor is not None and is_profile(sensor) else None
    asked = _Asked(
        reading=replace(reading or ReadOptions(), **({} if forces is None else {"forces": Path(forces)})),
        labelling=labelling or LabelSettings(),
        reference=None if reference is None else Path(reference),
        profile=profile,
        format=format,
        facts={"sensor": sensor if profile is None else None, "day": day, "condition": condition, "object": object},
    )
    if asked.reading.forces is not None and len(paths) > 1:
        raise InputError("one table of forces goes with one recording; name what belongs together in a manifest (CSV)")
    if splits is not None and (validation_trials is not None or test_trials is not None):
        raise InputError("splits come from a file or from numbers of trials, not from both; leave one out")
    before = load_dataset(out) if add else None
    with stage(on_progress, "Opening the recordings") as count:
        work = _Importing(asked=asked, sources=[(path, asked.find_rows(path)) for path in paths])
        left_out = work.open_all(count)
    old = () if before is None else before.trials
    known = {info.trial for info in old}
    if kept := [job.capture.trial for job in work.opened.values() if job.capture.trial in known]:
        note(on_progress, f"already in {out}, and left as it is: {number_of(len(kept), 'trial')}, such as {kept[0]}")
    jobs = {item: job for item, job in work.opened.items() if job.capture.trial not in known}
    captures = [job.capture for job in jobs.values()]
    if before is not None and not jobs:
        with reporting(on_progress):
            report_dataset(before, kept=True)
        return replace(before, left_out=tuple(left_out))
    _require_names(captures, left_out)
    plan = None if splits is None else load_splits(splits)
    config = {
        **asked.recipe(work.sources),
        "validation_trials": validation_trials,
        "test_trials": test_trials,
        "splits": plan,
        **({} if before is None else {"added_to": before.hash}),
    }

    deal = partial(_deal, old, plan=plan, validation_trials=validation_trials, test_trials=test_trials)
    _, dealt = deal(captures)  # a mistake in the splits is found before anything slow
    with output_folder(Path(out), stage="import", config=config, overwrite=overwrite or add) as output:
        if not output.complete:
            if before is not None:
                _link_trials(before.folder, output.folder)
            given = [(item, job.capture.trial, len(job.capture)) for item, job in jobs.items()]
            how = {"title": "Importing frames", "on": on, "retry_failed": retry_failed}
            with reporting(on_progress), write_trials(work, given, output.folder, **how) as (rows, failed):
                for one in {job.profile.name: job.profile for job in jobs.values() if job.profile}.values():
                    save_profile(output.folder, one)
                names = {info.trial for info in rows}
                written = [capture for capture in captures if capture.trial in names]
                dealt_to, dealt = deal(written)
                table = [replace(info, split=split) for info, split in zip([*old, *rows], dealt_to, strict=True)]
                left_out = [*left_out, *failed]
                told = {row.trial for row in table} | {one.trial for one in left_out}
                left_out = [*(one for one in (before.left_out if before else ()) if one.trial not in told), *left_out]
                simulated = all(one.simulated for one in written) and (before is None or before.simulated)
                write_dataset_table(output.folder, table, simulated=simulated, left_out=left_out)
    for message in dealt.notes if dealt else ():
        note(on_progress, message)
    with reporting(on_progress):
        report_dataset(data := load_dataset(out), kept=output.complete)
    return data


_Source: TypeAlias = tuple[Path, Sequence[ManifestRow] | None]
"""What was named, and its rows if it is a manifest or a folder of recordings."""


@dataclass(frozen=True, kw_only=True)
class _Asked:
    """What is said of all recordings together."""

    reading: ReadOptions
    labelling: LabelSettings
    reference: Path | None
    """Image of the untouched sensor."""
    profile: SensorProfile | None
    format: str | None
    facts: Mapping[str, Any]
    """Sensor, day, condition and object; None where nothing is said."""

    def __post_init__(self) -> None:
        if self.reference is not None and self.labelling.reference_frame is not None:
            raise InputError("the untouched sensor is named twice; give --reference or --reference-frame, not both")

    def find_rows(self, path: Path) -> tuple[ManifestRow, ...] | None:
        """Rows of a manifest or a folder of recordings; None where a path is one recording."""
        return None if self.format is not None or self.reading.forces is not None else find_rows(path)

    def open(self, path: Path) -> list[TrialJob]:
        """Open a recording."""
        profile = self.profile
        settings = self.labelling if profile is None else profile.settings(self.labelling)
        facts = {name: fact for name, fact in self.facts.items() if fact is not None}
        if profile is not None:
            facts["sensor"] = profile.name
        opened = open_source(
            path, reference=self.reference, format=self.format, options=self.reading, sensor=profile, whole=True
        )
        return [TrialJob(capture=replace(one, **facts), settings=settings, profile=profile) for one in opened]

    def open_row(self, row: ManifestRow) -> list[TrialJob]:
        """Open the recordings of a row, which says more than the command; its profile takes the place of ours."""
        own = {name: fact for name in self.facts if (fact := getattr(row, name)) is not None}
        profile = self.profile
        if row.sensor is not None:
            profile = load_profile(row.sensor) if is_profile(row.sensor) else None
        image, index = self.reference, self.labelling.reference_frame
        if row.reference is not None:
            image, index = (None, row.reference) if isinstance(row.reference, int) else (row.reference, None)
        mu = self.labelling.mu if row.mu is None else row.mu
        said = replace(
            self,
            reading=replace(self.reading, forces=row.forces),
            labelling=replace(self.labelling, reference_frame=index, mu=mu),
            reference=image,
            profile=profile,
            facts={**self.facts, **own},
        )
        jobs = said.open(row.video)
        if len(jobs) == 1:
            jobs = [replace(jobs[0], capture=replace(jobs[0].capture, trial=row.trial))]
        _require_names([job.capture for job in jobs])
        for job in jobs:
            require_forces(job.capture)
        return [replace(job, one_of_many=True) for job in jobs]

    def recipe(self, sources: Sequence[_Source]) -> dict[str, object]:
        """All that shapes the trials."""

        def told(value: object) -> object:
            return _fingerprint(value) if isinstance(value, Path) else value

        return {
            **self.facts,
            "profile": self.profile,
            "format": self.format,
            "sources": [_fingerprint(part) for path, rows in sources for part in _parts(path, rows)],
            "reference": told(self.reference),
            "reading": {name: told(getattr(self.reading, name)) for name in self.reading.given()},
            "labelling": self.labelling,
        }


_Item: TypeAlias = tuple[int, int | None, int]
"""Places of a source, of its row if it has rows, and of a trial in that."""


@dataclass(frozen=True, kw_only=True)
class _Importing(TrialWork):
    """Work on recordings; paths travel."""

    asked: _Asked
    sources: Sequence[_Source]
    opened: dict[_Item, TrialJob] = field(default_factory=dict)

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "opened": {}}  # whoever gets it opens its own

    def open_all(self, on_progress: OnProgress) -> list[LeftOut]:
        """Open what was named; of a manifest or a folder of recordings what cannot be opened is left out."""
        left_out = []
        for place, (_, rows) in enumerate(self.sources):
            if rows is None:
                self._open(place, None)
            for number, row in enumerate(rows or ()):
                try:
                    self._open(place, number)
                except SliplensError as error:
                    left_out.append(LeftOut(trial=row.trial, source=str(row.video), why=str(error)))
                on_progress(number + 1, len(rows or ()))
        return left_out

    def _open(self, place: int, number: int | None) -> None:
        path, rows = self.sources[place]
        jobs = self.asked.open(path) if rows is None or number is None else self.asked.open_row(rows[number])
        self.opened.update({(place, number, index): job for index, job in enumerate(jobs)})

    def open(self, item: _Item) -> TrialJob:
        if item not in self.opened:
            self.opened.clear()  # of another source
            self._open(*item[:2])
        return self.opened[item]


def _parts(path: Path, rows: Sequence[ManifestRow] | None) -> list[Path]:
    """Files that a source is made of: what changes in them changes the data set, unlike what else lies beside them."""
    if rows is None:
        return [path]
    named = [part for row in rows for part in (row.video, row.forces, row.reference) if isinstance(part, Path)]
    return [*([path] if path.is_file() else []), *(part for part in named if part.exists())]


def _link_trials(source: Path, folder: Path) -> None:
    """Put the trials of a data set into another folder without copying what is in them, where that can be."""

    def link(one: str, other: str) -> None:
        if not Path(other).exists():
            try:
                os.link(one, other)
            except OSError:  # another disk, or one that has no links
                with whole_file(Path(other)) as part:
                    shutil.copyfile(one, part)

    for name in ("trials", "forces", "audit"):
        if (source / name).is_dir():
            shutil.copytree(source / name, folder / name, copy_function=link, dirs_exist_ok=True)
    copy_profiles(source, folder)


def _require_names(captures: Sequence[Capture], left_out: Sequence[LeftOut] = ()) -> None:
    if not captures and left_out:
        raise RecordingError(f"no trial could be imported; the first: {left_out[0].why}")
    if not captures:
        raise RecordingError("there is no trial to import; name a recording")
    twice = [name for name, count in Counter(one.trial for one in captures).items() if count > 1]
    if twice:
        raise InputError(f"several recordings are named {', '.join(twice)}; rename their files")
    for capture in captures:
        if not capture.sensor:
            raise InputError(f"{capture.source} does not tell its sensor, and a network is of one; add --sensor")


def _deal(
    old: Sequence[TrialInfo],
    captures: Sequence[Capture],
    *,
    plan: Mapping[str, str] | Group | None,
    validation_trials: int | None,
    test_trials: int | None,
) -> tuple[list[str], SplitResult | None]:
    """Splits of all trials, the old ones first, and how a plan dealt them."""
    if plan is not None:
        trials = [*old, *captures]
        dealt = assign_splits(trials, plan) if isinstance(plan, Mapping) else deal_splits(trials, by=plan)
        return list(dealt.splits), dealt
    kept = [info.split for info in old]
    if validation_trials is None and test_trials is None:
        return [*kept, *(capture.split or "train" for capture in captures)], None
    count = len(captures)
    validation, test = validation_trials or 0, test_trials or 0
    if validation < 0 or test < 0:
        raise InputError("numbers of trials are not negative; give 0 or more")
    training = count - validation - test
    if training < 0:
        raise InputError(
            f"{number_of(validation, 'trial')} to validate and {test} to test are more than the {count} there "
            "are; give fewer"
        )
    return [*kept, *["train"] * training, *["validation"] * validation, *["test"] * test], None


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
