"""Labels of a data set made again from its frames and force samples."""

import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from sliplens.errors import InputError, RecordingError
from sliplens.files import output_folder
from sliplens.progress import OnProgress, add_note, number_of, reporting
from sliplens.recordings.corrections import read_corrections
from sliplens.recordings.dataset import (
    Dataset,
    copy_profiles,
    load_dataset,
    report_dataset,
    trial_path,
    write_dataset_table,
)
from sliplens.recordings.formats.stored import read_stored_trial
from sliplens.recordings.labelling import Corrections
from sliplens.recordings.labels import require_inside
from sliplens.recordings.options import LabelSettings
from sliplens.recordings.store import read_first_reference, read_header
from sliplens.recordings.trial_writer import TrialJob, TrialWork, write_trials


def label_dataset(
    data: Dataset | Path | str,
    *,
    out: Path | str | None = None,
    labelling: LabelSettings | None = None,
    corrections: Mapping[str, Corrections] | Path | str | None = None,
    on: str = "serial",
    retry_failed: bool = False,
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
    on, retry_failed
        See `import_recordings`.
    """
    with reporting(on_progress):
        data = data if isinstance(data, Dataset) else load_dataset(data)
        labelling, out = labelling or LabelSettings(), data.folder if out is None else Path(out)
        in_place = out.resolve() == data.folder.resolve()
        stored = {info.trial: read_header(trial_path(data.folder, info.trial)).labelling for info in data.trials}
        before = {trial: origin.corrections for trial, origin in stored.items() if origin and origin.corrections}
        if corrections is None:
            corrections = before
        elif not isinstance(corrections, Mapping):
            corrections = read_corrections(corrections)
        for trial in corrections:
            data.find(trial)
        work = _Relabelling(data=data, labelling=labelling, corrections=corrections)
        for number in range(len(data.trials)):  # mistakes are found before anything slow
            work.open(number)
        for trial, origin in stored.items():
            excluded = origin is not None and origin.corrections is not None and origin.corrections.exclude
            if in_place and (origin is None or (origin.basis is None and not excluded)):
                raise InputError(f"the labels of {trial} did not come from its forces and would be lost; give --output")
        config = {"labelling": labelling, "data_hash": data.hash, "corrections": dict(corrections)}
        with output_folder(out, stage="label", config=config, overwrite=overwrite or in_place) as output:
            if not output.complete:
                items = [(number, info.trial, info.frames) for number, info in enumerate(data.trials)]
                with write_trials(
                    work, items, output.folder, title="Labelling frames", on=on, retry_failed=retry_failed
                ) as (rows, _):
                    table = [replace(row, split=info.split) for row, info in zip(rows, data.trials, strict=True)]
                    write_dataset_table(output.folder, table, simulated=data.simulated, left_out=data.left_out)
                    copy_profiles(data.folder, output.folder)
        if corrections:
            add_note(f"corrections of {number_of(len(corrections), 'trial')} applied")
        if removed := sorted(before.keys() - corrections.keys()):
            add_note(f"corrections of {number_of(len(removed), 'trial')} removed, such as {removed[0]}")
        labelled = load_dataset(out)
        report_dataset(labelled, existed=output.complete)
    return labelled


@dataclass(frozen=True, kw_only=True)
class _Relabelling(TrialWork):
    """Work on the stored trials of a data set, by their numbers in its table."""

    data: Dataset
    labelling: LabelSettings
    corrections: Mapping[str, Corrections]

    def open(self, item: int) -> TrialJob:
        info, folder = self.data.trials[item], self.data.folder
        capture = read_stored_trial(self.data, info)
        if capture.forces is None:
            no_forces = f"{info.trial} of {folder} has no forces, and without them there is no label"
            raise InputError(f"{no_forces}; import it again with its table of forces")
        profile, corrections = self.data.profile(capture.sensor), self.corrections.get(info.trial)
        settings = self.labelling if profile is None else profile.settings(self.labelling)
        if corrections is not None:
            settings = corrections.apply(settings)
        command = shlex.join(["sliplens", "label", str(folder), "--draft", "corrections.csv"])
        cure = f"; correct it in its table of corrections, which `{command}` writes" if corrections else ""
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
