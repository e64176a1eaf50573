"""Data sets of sliplens as recordings, and the copy without images that exports carry along."""

import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np

from sliplens.errors import InputError, RecordingError
from sliplens.files import hash_file, require_file
from sliplens.images import encode_png
from sliplens.recordings.capture import Capture, Forces, Frame
from sliplens.recordings.dataset import Dataset, TrialInfo, load_dataset, trial_info, trial_path, write_dataset_table
from sliplens.recordings.store import forces_path, load_forces, load_recording, stream_frames, write_trial
from sliplens.recordings.trial import Labels, Recording, TrialFacts

_AGAIN = "export the data set again, or remove that folder to import without labels"
_BATCH = 16  # frames that are encoded side by side


def read_stored(folder: Path) -> list[Capture]:
    """Read a data set, one capture a trial, with its labels and its reference frame."""
    data = load_dataset(folder)
    return [read_stored_trial(data, info) for info in data.trials]


def read_stored_trial(data: Dataset, info: TrialInfo, *, samples: bool = True) -> Capture:
    """Read one trial of a data set as `read_stored` does, with or without the samples of its forces."""
    path = trial_path(data.folder, info.trial)
    stored = load_recording(path, pixels=False)
    return Capture(
        **{field.name: getattr(info, field.name) for field in fields(TrialFacts)},
        source=f"{info.trial} of {data.folder}",
        frame_time_s=stored.time_s,
        frame_size=(info.height, info.width),
        read_frames=partial(stream_frames, path),
        forces=_read_forces(data, info, stored) if samples else None,
        labels=stored,
        reference=stored.reference,
        split=info.split,
        simulated=data.simulated,
    )


def _read_forces(data: Dataset, info: TrialInfo, stored: Recording) -> Forces | None:
    if info.forces_sha256:
        return load_forces(forces_path(data.folder, info.trial))
    pull, press = stored.tangential_force_n, stored.normal_force_n
    measured = np.isfinite(pull) & np.isfinite(press)
    if not measured.any():
        return None
    samples = np.stack([pull, np.zeros_like(pull), press], axis=-1)[measured]
    return Forces(time_s=stored.time_s[measured], force_n=samples, source=f"the frames of {info.trial}")


def encode_batches(frames: Iterator[Frame]) -> Iterator[tuple[list[Frame], list[bytes]]]:
    """Iterate over batches of frames and their PNG images; the images of a batch are encoded in threads."""
    with ThreadPoolExecutor() as pool:
        while batch := list(islice(frames, _BATCH)):
            yield batch, list(pool.map(encode_png, batch))


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


def save_without_images(data: Dataset, trials: Sequence[TrialInfo], folder: Path) -> None:
    """Write a copy of a data set that has everything but the images and the ground truth of simulated trials."""
    rows = []
    for info in trials:
        stored = load_recording(trial_path(data.folder, info.trial), pixels=False)
        path, samples = trial_path(folder, info.trial), forces_path(folder, info.trial)
        path.parent.mkdir(parents=True, exist_ok=True)
        if info.forces_sha256:
            samples.parent.mkdir(exist_ok=True)
            shutil.copyfile(forces_path(data.folder, info.trial), samples)
        no_images = [[b""] * len(stored)]
        write_trial(path, no_images, facts=stored, time_s=stored.time_s, labels=stored, reference=stored.reference)
        rows.append(trial_info(path, split=info.split))
    write_dataset_table(folder, rows, simulated=data.simulated)


def restore_trials(
    folder: Path, images: Sequence[tuple[str, int, tuple[int, int], Callable[[], Iterator[Frame]]]]
) -> list[Capture]:
    """Join the trials of `save_without_images` with their images."""
    try:
        data = load_dataset(folder)
        for info in data.trials:
            hashes = {trial_path(folder, info.trial): info.sha256}
            if info.forces_sha256:
                hashes[forces_path(folder, info.trial)] = info.forces_sha256
            for path, sha256 in hashes.items():
                require_file(path, missing="export the data set again")
                if hash_file(path) != sha256:
                    raise RecordingError(f"{path} was changed since it was exported; export the data set again")
        stored = [read_stored_trial(data, info) for info in data.trials]
    except InputError as error:
        raise RecordingError(str(error)) from None
    if len(stored) != len(images):
        raise RecordingError(f"{folder} describes {len(stored)} trials beside the images of {len(images)}; {_AGAIN}")
    captures = []
    for capture, (source, frames, size, read_frames) in zip(stored, images, strict=True):
        if (len(capture), capture.frame_size) != (frames, size):
            raise RecordingError(f"{source} has not the frames of trial {capture.trial} in {folder}; {_AGAIN}")
        captures.append(replace(capture, source=f"{capture.trial}, {source}", read_frames=read_frames))
    return captures
