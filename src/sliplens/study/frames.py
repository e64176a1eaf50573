"""Pick the frames to explain: along a trial from full stick to full slip, or a folder of images."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor

from sliplens.errors import InputError, RecordingError
from sliplens.images import list_images, read_image
from sliplens.models import TrainedModel
from sliplens.recordings import Dataset

DEFAULT_LEVELS = (1.0, 0.8, 0.6, 0.4, 0.2, 0.0)
"""Safety margins at which the thesis explains frames (section 4)."""

_LABEL = re.compile(r"_(0|[1-9]\d?|100)$")


@dataclass(frozen=True, kw_only=True)
class ChosenFrames:
    """Frames to explain, compared and resized but still in 8 bits, so that they can be stored exactly.

    Attributes
    ----------
    images
        Resized network inputs before normalisation.
    references
        What each explanation is measured against: the untouched sensor, in [0, 1].
    safety_margin
        Labels; NaN where a frame has none.
    source
        "simulated", or "real": a recorded data set or a folder of images.
    """

    ids: tuple[str, ...]
    trial: tuple[str, ...]
    condition: tuple[str, ...]
    safety_margin: Float32[np.ndarray, " frames"]
    images: UInt8[Tensor, "frames 3 size size"]
    references: Float32[Tensor, "frames 3 size size"]
    source: str


def frames_from_dataset(
    trained: TrainedModel,
    data: Dataset,
    *,
    split: str = "test",
    condition: str = "dry",
    trials: int = 1,
    levels: Sequence[float] = DEFAULT_LEVELS,
) -> ChosenFrames:
    """Frames of the first trials of a split, at given safety margins.

    For each trial and level the frame whose label is nearest is taken; at a level of 0 the first frame of full slip, at
    1 the last frame that is still fully stuck, so that each is next to the change.

    Parameters
    ----------
    trained
        The network: decides encoding and size.
    split, condition, trials
        Which trials, and how many of them, in the order of the data set's table.
    levels
        Safety margins in [0, 1].

    Raises
    ------
    RecordingError
        If there is no such trial, or a trial has no labelled frame.
    InputError
        If a level is outside [0, 1].
    """
    if any(not 0 <= level <= 1 for level in levels):
        raise InputError(f"levels must lie in [0, 1], got {', '.join(f'{level:g}' for level in levels)}")
    rows: dict[str, list[int]] = {}
    for info in data.select(split=split, condition=condition)[:trials]:
        recording = data.load(info, truth=False)
        margin = np.where(recording.labelled, recording.safety_margin, np.nan)
        if not np.isfinite(margin).any():
            raise RecordingError(f"trial {recording.trial} has no labelled frame; label it first")
        rows[info.trial] = [nearest_frame(margin, level) for level in levels]
    return frames_at(trained, data, rows)


def frames_at(trained: TrainedModel, data: Dataset, rows: Mapping[str, Sequence[int]]) -> ChosenFrames:
    """Frames of a data set by trial and number.

    Parameters
    ----------
    trained
        The network: decides encoding and size.
    data
        The data set.
    rows
        Numbers of frames, by trial.

    Raises
    ------
    RecordingError
        If the data set has no such trial.
    ImageError
        If the frames are of another sensor.
    """
    infos = {info.trial: info for info in data.trials}
    images, references, labels, names = [], [], [], []
    for trial, frames in rows.items():
        if trial not in infos:
            raise RecordingError(f"{data.folder} has no trial {trial}; use the data set that the frames came from")
        recording = data.load(infos[trial], truth=False)
        trained.require_frame_size(recording.reference.shape[:2])
        chosen = list(frames)
        compared = trained.encoding.compare(recording.frames[chosen], recording.reference)
        images.append(trained.encoding.resize(compared, image_size=trained.manifest.image_size))
        empty = trained.encoding.empty(recording.reference, image_size=trained.manifest.image_size)
        references.append(empty.expand(len(chosen), -1, -1, -1))
        labels.append(np.where(recording.labelled, recording.safety_margin, np.nan)[chosen])
        names += [(f"{trial}-f{row:04d}", trial, recording.condition) for row in chosen]
    ids, trials, conditions = zip(*names, strict=True)
    return ChosenFrames(
        ids=ids,
        trial=trials,
        condition=conditions,
        safety_margin=np.concatenate(labels).astype(np.float32),
        images=torch.cat(images),
        references=torch.cat(references),
        source=data.source,
    )


def nearest_frame(margin: Float[np.ndarray, " frames"], level: float) -> int:
    """Frame whose margin is nearest to a level, next to the change where many are: the last one above, the first below.

    Parameters
    ----------
    margin
        Label of each frame, NaN where there is none; one at least has one.
    level
        Safety margin asked for.
    """
    distance = np.abs(margin - level)
    nearest = np.flatnonzero(distance == np.nanmin(distance))
    return int(nearest[-1] if level >= 0.5 else nearest[0])


def frames_from_folder(
    trained: TrainedModel, folder: Path, *, reference: Path | None = None, labels_in_names: bool = False
) -> ChosenFrames:
    """Images of a folder, in natural order.

    Parameters
    ----------
    trained
        The network.
    folder
        8-bit RGB images of the size the network's sensor has: camera frames if `reference` is given, otherwise
        absolute difference images |T_n - T_0|.
    reference
        Image of the untouched sensor.
    labels_in_names
        Read the safety margin in percent from names that end in `_GG`, as in `image_433_20.png`.

    Raises
    ------
    InputError
        If the folder is missing or empty, a name has no label though labels are asked for, or a network that reads raw
        frames got no reference image.
    ImageError
        If an image cannot be read, or has another size or kind of pixels.
    """
    size = (int(trained.manifest.frame_size[0]), int(trained.manifest.frame_size[1]))
    paths = list_images(folder)
    frames = np.stack([read_image(path, size=size) for path in paths])
    labels = [_label(path) if labels_in_names else np.nan for path in paths]
    image_size = trained.manifest.image_size
    if reference is not None:
        untouched = read_image(reference, size=size)
        images = trained.encoding.resize(trained.encoding.compare(frames, untouched), image_size=image_size)
        empty = trained.encoding.empty(untouched, image_size=image_size)
    elif trained.encoding.empty_is_black:
        images = trained.encoding.resize(frames, image_size=image_size)
        empty = torch.zeros(3, image_size, image_size)
    else:
        raise InputError(
            f"a network on {trained.encoding.name} images needs the untouched sensor; give it with --reference IMAGE"
        )
    return ChosenFrames(
        ids=tuple(path.stem for path in paths),
        trial=(folder.name,) * len(paths),
        condition=("unknown",) * len(paths),
        safety_margin=np.array(labels, dtype=np.float32),
        images=images,
        references=empty.expand(len(paths), -1, -1, -1).clone(),
        source="real",
    )


def _label(path: Path) -> float:
    found = _LABEL.search(path.stem)
    if found is None:
        raise InputError(f"{path} carries no label; its name must end in the safety margin in percent, as in _20.png")
    return int(found.group(1)) / 100
