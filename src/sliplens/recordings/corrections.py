"""Labels of a data set made again, and the table of corrections (CSV) by hand: a row a trial, a column a setting."""

import csv
import re
import shlex
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path

from sliplens.errors import InputError, RecordingError
from sliplens.files import MOST_TEXT, output_folder, remove, require_file, whole_file
from sliplens.progress import OnProgress, add_note, number_of, reporting
from sliplens.recordings import dataset
from sliplens.recordings.dataset import Dataset, load_dataset, trial_path
from sliplens.recordings.importing import PARTS, TrialJob, TrialWork, write_trials
from sliplens.recordings.labelling import Corrections
from sliplens.recordings.labels.margin import require_inside
from sliplens.recordings.manifest import Column, parse_cells, read_csv
from sliplens.recordings.options import LabelSettings, TrialSettings
from sliplens.recordings.sensor import SENSORS_FOLDER
from sliplens.recordings.store import read_first_reference, read_header

_SETTINGS = ("exclude", *(field.name for field in fields(TrialSettings)))
_WORDS = {**dict.fromkeys(("yes", "true", "1", "x"), True), **dict.fromkeys(("no", "false", "0"), False)}


def _parse_tare(text: str) -> tuple[float, float, float]:
    x, y, z = map(float, re.split(r"[\s;]+", text))
    return x, y, z


def _parse_span(text: str) -> tuple[int, int]:
    first, _, last = text.partition("..")  # two dots: a spreadsheet would take 10-12 for a date
    return int(first), int(last or first)


_COLUMNS: dict[str, Column] = {
    "trial": (str, ""),
    "exclude": (lambda text: _WORDS[text.lower()], "write yes or no"),
    "reference_frame": (int, "write a whole number"),
    "normal_sign": (lambda text: {1: 1, -1: -1}[int(text)], "write 1 or -1"),
    **dict.fromkeys(("contact_s", "slip_s", "mu"), (float, "write a number with a decimal point")),
    "tare": (_parse_tare, "write three numbers, such as 0.01 0 -0.2"),
    "bad_frames": (
        lambda text: tuple(map(_parse_span, re.split(r"[\s;]+", text))),
        "write spans of frames, such as 10..19 34",
    ),
    "flags": (str, ""),
}


def read_corrections(path: Path | str) -> dict[str, Corrections]:
    """Read a table of corrections; gives those of each trial that has any.

    The column `trial` names the trial, the others are fields of `Corrections`. An empty cell leaves the automatic
    value; the column `flags` is ignored.
    """
    path = Path(path)
    require_file(path, most=MOST_TEXT, missing="write one with `sliplens label DATA --draft corrections.csv`")
    corrections: dict[str, Corrections] = {}
    for where, cells in read_csv(path, _COLUMNS, what="a table of corrections", needed="trial"):
        settings = dict(parse_cells({name: text for name, text in cells.items() if name in _SETTINGS}, _COLUMNS, where))
        try:
            corrections[cells["trial"]] = Corrections(**settings)
        except RecordingError as error:
            raise RecordingError(f"{where}: {error}") from None
    return {trial: row for trial, row in corrections.items() if row != Corrections()}


def draft_corrections(data: Dataset | Path | str, path: Path | str) -> None:
    """Write a table of corrections to be edited: a row a trial, with its corrections and flags so far.

    The audit page of a trial shows its present values. `sliplens label DATA --corrections` applies the table.

    See Also
    --------
    label_dataset : Apply the table.

    Examples
    --------
    >>> import sliplens as sl
    >>> data = sl.simulate(dry_trials=3, wet_trials=0, days=2, frames_per_trial=20)
    >>> table = data.folder / "corrections.csv"
    >>> sl.draft_corrections(data, table)
    >>> table.read_text().splitlines()[0].split(",")[:4]
    ['trial', 'exclude', 'reference_frame', 'normal_sign']
    """
    data, path = load_dataset(data), Path(path)
    if path.exists():
        raise InputError(f"{path} exists and may hold corrections; name a file that does not")
    with whole_file(path) as part, part.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, _COLUMNS)
        writer.writeheader()
        for info in data.trials:
            labelling = read_header(trial_path(data.folder, info.trial)).labelling
            row = {name: _cell(getattr(labelling and labelling.corrections, name, None)) for name in _SETTINGS}
            flags = labelling.basis.flags if labelling and labelling.basis else ()
            writer.writerow({"trial": info.trial, **row, "flags": "; ".join(flags)})


def _cell(value: object) -> str:
    match value:
        case None | False:
            return ""
        case True:
            return "yes"
        case float():
            return f"{value:.6g}"
        case tuple():
            return " ".join("..".join(map(str, item)) if isinstance(item, tuple) else _cell(item) for item in value)
    return str(value)


def label_dataset(
    data: Dataset | Path | str,
    *,
    out: Path | str | None = None,
    labelling: LabelSettings | None = None,
    corrections: Mapping[str, Corrections] | Path | str | None = None,
    on: str = "serial",
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
) -> Dataset:
    """Label the trials of a data set again, from the frames and force samples that it stores; splits stay.

    Parameters
    ----------
    data
        Data set that stores its force samples, or its folder.
    out
        Folder to make. If None, the data set itself gets the new labels once all of them are made.
    labelling
        Forces and friction as far as they are known, for all trials.
    corrections
        Table of corrections (`sliplens.recordings.corrections`), or the corrections of each trial by its name. They
        replace those of the last call, and take precedence over `labelling`. If None, those of the last call hold.
    on
        See `import_recordings`.

    See Also
    --------
    draft_corrections : Write a table of corrections to edit.
    check_dataset : List the defects of a data set.

    Examples
    --------
    >>> import sliplens as sl
    >>> from sliplens.recordings import LabelSettings
    >>> data = sl.label_dataset("data", out="other", labelling=LabelSettings(mu=0.8))  # doctest: +SKIP
    >>> data.read_labels(data.trials[0]).labelling.basis.friction.mu  # doctest: +SKIP
    0.8
    """
    with reporting(on_progress):
        data = load_dataset(data)
        labelling, out = labelling or LabelSettings(), Path(out or data.folder)
        in_place = out.resolve() == data.folder.resolve()
        stored = {info.trial: read_header(trial_path(data.folder, info.trial)).labelling for info in data.trials}
        before = {trial: origin.corrections for trial, origin in stored.items() if origin and origin.corrections}
        if corrections is None:
            corrections = before
        elif not isinstance(corrections, Mapping):
            corrections = read_corrections(corrections)
        for trial, row in corrections.items():
            data.find(trial)
            if not isinstance(row, Corrections):
                raise InputError(f"the corrections of {trial} are {row!r}; give such as Corrections(slip_s=3.2)")
        work = _Relabelling(data=data, labelling=labelling, corrections=corrections)
        for number in range(len(data.trials)):  # mistakes are found before anything slow
            work.open(number)
        for trial, origin in stored.items() if in_place else ():
            excluded = trial in before and before[trial].exclude
            if origin is None or (origin.basis is None and not excluded):
                raise InputError(f"the labels of {trial} did not come from its forces and would be lost; give --output")
        config = {"labelling": labelling, "data_hash": data.hash, "corrections": dict(corrections)}
        with output_folder(out, stage="label", config=config, overwrite=overwrite or in_place) as output:
            if not output.complete:
                folder = output.folder
                items = [(number, info.trial, info.frames) for number, info in enumerate(data.trials)]
                rows, _ = write_trials(work, items, folder, title="Labelling frames", on=on)
                table = [replace(row, split=info.split) for row, info in zip(rows, data.trials, strict=True)]
                dataset.write_dataset_table(folder, table, simulated=data.simulated, left_out=data.left_out)
                if (data.folder / SENSORS_FOLDER).is_dir():
                    shutil.copytree(data.folder / SENSORS_FOLDER, folder / SENSORS_FOLDER, dirs_exist_ok=True)
                remove(folder / PARTS)
        if corrections:
            add_note(f"corrections of {number_of(len(corrections), 'trial')} applied")
        if removed := sorted(before.keys() - corrections.keys()):
            add_note(f"corrections of {number_of(len(removed), 'trial')} removed, such as {removed[0]}")
        return dataset.report_dataset(out, existed=output.complete)


@dataclass(frozen=True, kw_only=True)
class _Relabelling(TrialWork):
    """Work on the stored trials of a data set, by their numbers in its table."""

    data: Dataset
    labelling: LabelSettings
    corrections: Mapping[str, Corrections]

    def open(self, item: int) -> TrialJob:
        info, folder = self.data.trials[item], self.data.folder
        capture = self.data.open(info)
        if capture.forces is None:
            raise InputError(f"{info.trial} of {folder} has no forces to label it by; import it again with their table")
        profile, corrections = self.data.profile(capture.sensor), self.corrections.get(info.trial)
        settings, cure = self.labelling if profile is None else profile.settings(self.labelling), ""
        if corrections is not None:
            settings = corrections.apply(settings)
            command = shlex.join(["sliplens", "label", str(folder), "--draft", "corrections.csv"])
            cure = f"; correct it in its table of corrections, which `{command}` writes"
        try:
            require_inside(settings, frames=len(capture), time_s=capture.forces.time_s)
        except RecordingError as error:
            raise RecordingError(f"{info.trial}: {error}{cure}") from None
        # as it was imported, with the reference from before any correction
        origin = capture.labels.labelling if capture.labels else None
        capture = replace(capture, labels=None)
        if origin is not None:
            choice = origin.first_reference or origin.reference
            capture = replace(capture, source=origin.source, notes=origin.notes, reference_choice=choice)
        if (first := read_first_reference(trial_path(folder, info.trial))) is not None:
            capture = replace(capture, reference=first)
        return TrialJob(capture=capture, settings=settings, corrections=corrections, cure=cure)
