"""Data sets of sliplens as recordings: simulated ones, and those imported before."""

from collections.abc import Iterable
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from jaxtyping import Float32, UInt8

from sliplens.recordings.capture import GIVEN_SIGNALS, Capture, Forces, GivenLabels, Told, forces_path, load_forces
from sliplens.recordings.dataset import Dataset, TrialInfo, trial_path
from sliplens.recordings.store import read_labelling, read_reference, reading, stream_frames
from sliplens.recordings.trial import ContactState

HEAD = 13
"""Frames at the start that may be stale."""
HORIZON = 500
"""Frames that the head is compared with; a longer video is read no further."""
_BLOCKS = 24, 32
_LEAST_LEAP = 1.5  # grey levels, mean over the image: several times what noise and coding change
_FROZEN = 0.75  # grey levels: no more than noise and coding change
_WAKES = 1.015  # a camera that adapts its exposure when it is started grows brighter by more


def stale_frames(frames: Iterable[UInt8[np.ndarray, "height width 3"]]) -> int:
    """Count the frames at the start that belong to another scene.

    A camera that was just started hands out dark frames, and then what lay in its buffers: frozen frames of an earlier
    moment. The last of them is unlike every frame that follows it. An object that slides from frame to frame is not
    stale: there, all frames leap, or none does. (Where the camera ran already, an object that is pressed all at once
    within the first 13 frames and never let go cannot be told from a frozen start; do not ask there.)

    Parameters
    ----------
    frames
        From the first; the first 500 are looked at.

    Returns
    -------
    int
        How many to leave out: 0 where none is stale.
    """
    return count_stale(small_copies(frames))


def small_copies(frames: Iterable[UInt8[np.ndarray, "height width 3"]]) -> Float32[np.ndarray, "frames rows columns 3"]:
    """Reduce frames to the means of blocks, enough to tell scenes apart and small enough to keep."""
    copies = [_block_means(frame) for frame in islice(frames, HORIZON)]
    return np.stack(copies) if copies else np.empty((0, *_BLOCKS, 3), dtype=np.float32)


def count_stale(copies: Float32[np.ndarray, "frames rows columns 3"]) -> int:
    """Count the stale frames of `small_copies`."""
    head = min(HEAD, len(copies) // 3)  # what follows must be seen long enough to compare with
    if not head:
        return 0
    flat = copies.reshape(len(copies), -1)
    leap = np.array([np.abs(flat[at + 1 :] - flat[at]).mean(axis=1).min() for at in range(head)])
    brightness = flat[: head + 1].mean(axis=1)
    wakes = bool(np.any(brightness[1:] > _WAKES * brightness[:-1]))
    frozen = np.append(False, leap[:-1] < np.minimum(leap[1:] / 4, _FROZEN))
    # where all frames move, none of them leaps
    stale = (leap > max(_LEAST_LEAP, 4 * float(np.median(leap)))) & (frozen | wakes)
    return int(np.flatnonzero(stale)[-1]) + 1 if stale.any() else 0


def least_contact(copies: Float32[np.ndarray, "frames rows columns 3"]) -> int:
    """Frame that shows the least relief: the candidate for a reference where none was recorded.

    What presses into a gel lit by coloured lamps shows as colours that change within a few pixels, where the untouched
    gel changes slowly.
    """
    colour = copies[..., [0, 2]] - copies[..., [1]]
    padded = np.pad(colour, ((0, 0), (2, 2), (2, 2), (0, 0)), mode="edge")
    smooth = np.lib.stride_tricks.sliding_window_view(padded, (5, 5), axis=(1, 2)).mean(axis=(-2, -1))
    return int(np.argmin(np.abs(colour - smooth).mean(axis=(1, 2, 3))))


def _block_means(frame: UInt8[np.ndarray, "height width 3"]) -> Float32[np.ndarray, "rows columns 3"]:
    rows, columns = (min(most, size) for most, size in zip(_BLOCKS, frame.shape[:2], strict=True))
    height, width = frame.shape[0] // rows, frame.shape[1] // columns
    whole = frame[: rows * height, : columns * width]
    # rows first, which lie in one piece: several times faster than both at once
    sums = whole.reshape(rows, height, -1).sum(axis=1, dtype=np.uint32).reshape(rows, columns, width, 3).sum(axis=2)
    return (sums / (height * width)).astype(np.float32)


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
