"""Data sets of sliplens as recordings: simulated ones, and those imported before."""

from functools import partial
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from sliplens.recordings.capture import Capture, Forces, Told
from sliplens.recordings.dataset import Dataset, TrialInfo, trial_path
from sliplens.recordings.given import GIVEN_SIGNALS, GivenLabels
from sliplens.recordings.headers import read_labelling, read_reference
from sliplens.recordings.parquet import reading
from sliplens.recordings.recording import ContactState
from sliplens.recordings.samples import forces_path, load_forces
from sliplens.recordings.store import stream_frames

_OPTIONAL = ("safety_margin_sigma", "valid", "invalid_reason")


def read_stored(folder: Path) -> list[Capture]:
    """Read a data set, one capture a trial, with its labels, its reference frame, and all it says of itself.

    Forces are the samples that were kept on import, else, as for a simulated trial, those of the frames: the pull along
    x, pressing along z.

    Parameters
    ----------
    folder
        Folder with `dataset.json`.

    Raises
    ------
    InputError, RecordingError
        If the folder is no data set, or a trial is missing or damaged.
    """
    data = Dataset.open(folder)
    return [read_stored_trial(data, info) for info in data.trials]


def read_stored_trial(data: Dataset, info: TrialInfo) -> Capture:
    """Read one trial of a data set as `read_stored` does."""
    folder = data.folder
    path = trial_path(folder, info.trial)
    with reading(path):
        present = set(pq.read_schema(path).names)
        names = ("time_s", *GIVEN_SIGNALS, "contact_state", *(name for name in _OPTIONAL if name in present))
        table = pq.read_table(path, columns=list(names))
    columns = {name: table.column(name).to_numpy() for name in names}
    states, reasons = columns["contact_state"], columns.get("invalid_reason")
    sigma, valid = columns.get("safety_margin_sigma"), columns.get("valid")
    labels = GivenLabels(
        **{name: columns[name].astype(np.float64) for name in GIVEN_SIGNALS},
        contact_state=tuple(ContactState(state) for state in states),
        safety_margin_sigma=None if sigma is None else sigma.astype(np.float64),
        valid=None if valid is None else valid.astype(bool),
        reason=None if reasons is None else tuple(str(reason) for reason in reasons),
        labelling=read_labelling(path),
    )
    time = columns["time_s"].astype(np.float64)
    return Capture(
        name=info.trial,
        source=f"{info.trial} of {folder}",
        frame_time_s=time,
        frame_size=(info.height, info.width),
        read_frames=partial(stream_frames, path),
        forces=load_forces(forces_path(folder, info.trial)) if info.forces_sha256 else _forces(time, labels, info),
        labels=labels,
        reference=read_reference(path),
        told=Told(
            sensor=info.sensor,
            day=info.day,
            condition=info.condition,
            object=info.object or None,
            split=info.split,
            simulated=data.simulated,
        ),
    )


def _forces(time_s: np.ndarray, labels: GivenLabels, info: TrialInfo) -> Forces | None:
    pull, press = labels.tangential_force_n, labels.normal_force_n
    known = np.isfinite(pull) & np.isfinite(press)
    if not known.any():
        return None
    samples = np.stack([pull, np.zeros_like(pull), press], axis=-1)[known]
    return Forces(time_s=time_s[known], force_n=samples, source=f"the frames of {info.trial}")
