"""Data sets of sliplens as recordings."""

from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import numpy as np

from sliplens.recordings.capture import Capture, Forces
from sliplens.recordings.dataset import Dataset, TrialInfo, load_dataset, trial_path
from sliplens.recordings.store import forces_path, load_forces, load_recording, stream_frames
from sliplens.recordings.trial import Labels, TrialFacts


def read_stored(folder: Path) -> list[Capture]:
    """Read a data set, one capture a trial, with its labels and its reference frame."""
    data = load_dataset(folder)
    return [read_stored_trial(data, info) for info in data.trials]


def read_stored_trial(data: Dataset, info: TrialInfo, *, samples: bool = True) -> Capture:
    """Read one trial of a data set as `read_stored` does, with or without the samples of its forces."""
    path, forces = trial_path(data.folder, info.trial), None
    stored = load_recording(path, pixels=False)
    pull, press = stored.tangential_force_n, stored.normal_force_n
    measured = np.isfinite(pull) & np.isfinite(press)
    if samples and info.forces_sha256:
        forces = load_forces(forces_path(data.folder, info.trial))
    elif samples and measured.any():
        force_n = np.stack([pull, np.zeros_like(pull), press], axis=-1)[measured]
        forces = Forces(time_s=stored.time_s[measured], force_n=force_n, source=f"the frames of {info.trial}")
    return Capture(
        **{field.name: getattr(info, field.name) for field in fields(TrialFacts)},
        source=f"{info.trial} of {data.folder}",
        frame_time_s=stored.time_s,
        frame_size=(info.height, info.width),
        read_frames=partial(stream_frames, path),
        forces=forces,
        labels=stored,
        reference=stored.reference,
        split=info.split,
        simulated=data.simulated,
    )


def fill_labels(labels: Labels) -> Labels:
    """Return labels with uncertainty, validity and reason, which a trial may lack: NaN, valid where a margin is, ""."""
    count, has_margin = len(labels.safety_margin), np.isfinite(labels.safety_margin)
    sigma, valid, reason = labels.safety_margin_sigma, labels.valid, labels.reason
    return replace(
        labels,
        safety_margin_sigma=np.full(count, np.nan) if sigma is None else sigma,
        valid=has_margin if valid is None else valid,
        reason=("",) * count if reason is None else reason,
    )
