"""Labelled frames in memory, as a torch data set."""

import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor
from torch.utils.data import Dataset as TorchDataset

from sliplens.datasets.encodings import Encoding
from sliplens.errors import RecordingError
from sliplens.recordings import Dataset, TrialInfo
from sliplens.recordings.dataset import count_labelled, trial_path

UNTOUCHED = -1
"""Frame number of the reference frame, which is no frame of the trial."""


@dataclass(frozen=True, kw_only=True)
class FrameSet(TorchDataset):
    """Resized 8-bit inputs with their labels; a batch is indexed at once, not frame by frame.

    Attributes
    ----------
    images
        Compared and resized frames, uint8, as `Encoding.resize` returns them.
    safety_margin
        Labels in [0, 1].
    trial, frame, condition, day, time_s
        Where each row comes from, for tables by trial, condition and day.
    """

    encoding: Encoding
    images: UInt8[Tensor, "frames 3 size size"]
    safety_margin: Float32[Tensor, " frames"]
    trial: tuple[str, ...]
    frame: tuple[int, ...]
    condition: tuple[str, ...]
    day: tuple[int, ...]
    time_s: Float[np.ndarray, " frames"]

    def __len__(self) -> int:
        """Count the frames."""
        return len(self.images)

    def __getitem__(self, index: int) -> tuple[Tensor, Tensor]:
        """Return one input and its label."""
        images, labels = self.__getitems__([index])
        return images[0], labels[0]

    def __getitems__(self, indices: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Return a batch of inputs and their labels; torch's loader asks for it by this name."""
        rows = torch.as_tensor(indices)
        return self.encoding.normalise(self.images[rows]), self.safety_margin[rows]


def load_frames(
    data: Dataset,
    trials: Sequence[TrialInfo],
    *,
    encoding: Encoding,
    image_size: int,
    untouched_share: float = 0.0,
    scratch: Path | None = None,
    on_trial: Callable[[int, int], None] | None = None,
) -> FrameSet:
    """Read trials, encode them, and keep the frames that have a label.

    Frames without contact have no safety margin and are left out, as in the thesis.

    Parameters
    ----------
    data, trials
        The data set and the trials of it to read.
    encoding, image_size
        Input of the network, and its height and width in pixels.
    untouched_share
        For training: add the untouched sensor itself, with the label 1, this often for each labelled frame and at least
        once a trial. Without a pull the safety margin is 1 however light the touch, so 1 is its limit; and a network
        that was shown the untouched sensor gives explanations a reference that means something: "why 20 % rather than
        100 %?". Never for an evaluation.
    scratch
        Folder for what does not fit into memory: frames that would take more than half of what is free go into a file
        there, which is read as needed and gone when the frames are. Always in memory if None.
    on_trial
        Called with the number of trials read and the number of all.

    Raises
    ------
    RecordingError
        If no frame has a label, or the trials' frames differ in size.
    """
    sizes = {(info.height, info.width) for info in trials}
    if len(sizes) > 1:
        raise RecordingError(f"{data.folder} mixes frames of {sorted(sizes)} pixels; use one sensor at a time")
    copies_of = partial(_untouched_copies, share=untouched_share)
    counts = [count_labelled(trial_path(data.folder, info.trial)) for info in trials]
    if not sum(counts):
        raise RecordingError(f"{data.folder}: no frame of the {len(trials)} trials has a label; label them first")
    total = sum(count + copies_of(count) for count in counts)
    images = _allocate((total, 3, image_size, image_size), scratch)
    labels, times, rows = [], [], []
    for done, recording in enumerate(data.load_all(trials, truth=False), start=1):
        labelled = np.flatnonzero(recording.labelled)
        compared = encoding.compare(recording.frames[labelled], recording.reference)
        images[len(rows) : len(rows) + len(labelled)] = encoding.resize(compared, image_size=image_size)
        labels.append(recording.safety_margin[labelled])
        times.append(recording.time_s[labelled])
        rows += [(recording.trial, int(frame), recording.condition, recording.day) for frame in labelled]
        if copies := copies_of(len(labelled)):
            compared = encoding.compare(recording.reference[None], recording.reference)
            images[len(rows) : len(rows) + copies] = encoding.resize(compared, image_size=image_size)
            labels.append(np.ones(copies))
            times.append(np.full(copies, recording.time_s[0]))
            rows += [(recording.trial, UNTOUCHED, recording.condition, recording.day)] * copies
        if on_trial is not None:
            on_trial(done, len(trials))
    trial, frame, condition, day = zip(*rows, strict=True)
    return FrameSet(
        encoding=encoding,
        images=images,
        safety_margin=torch.from_numpy(np.concatenate(labels)).float(),
        trial=trial,
        frame=frame,
        condition=condition,
        day=day,
        time_s=np.concatenate(times),
    )


def _untouched_copies(labelled: int, *, share: float) -> int:
    return max(1, round(share * labelled)) if share > 0 else 0


def _allocate(shape: tuple[int, int, int, int], scratch: Path | None) -> UInt8[Tensor, "frames 3 size size"]:
    """Room for images: in memory, or in a file without a name, which is gone when nothing uses it any more."""
    size = int(np.prod(shape))
    if scratch is None or size <= _free_memory() / 2:
        return torch.empty(shape, dtype=torch.uint8)
    with tempfile.TemporaryFile(dir=scratch) as file:
        file.truncate(size)
        return torch.from_numpy(np.memmap(file, dtype=np.uint8, mode="r+", shape=shape))


def _free_memory() -> int:
    """Bytes that are free now; what is not known counts as plenty."""
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return 1 << 62
