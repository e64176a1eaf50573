"""Frames to explain: of arrays, of a data set along the safety margin, or of a folder or recording."""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby, islice
from pathlib import Path
from typing import Literal, TypeAlias, Unpack

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor

from sliplens.errors import ImageError, InputError, RecordingError, SliplensError
from sliplens.explainers.occlusion import markers_in_frame, markers_in_recording
from sliplens.markers import track_markers
from sliplens.markers.estimators import affine_parts, find_hold
from sliplens.models import Network
from sliplens.models.predictions import assume_reference
from sliplens.recordings import Dataset, Recording
from sliplens.recordings.capture import Capture
from sliplens.recordings.source import SourceOptions, open_source
from sliplens.results.explanation import MARGIN_LEVELS, BaselineName

_STICK_SHARE = 0.97  # of the trial's largest margin
_LEAST_STICK = 0.9
_LEAST_SPREAD = 1e-3  # divergence of a press, in pixels per pixel
_LABEL = re.compile(r"_(0|[1-9]\d?|100)$")
FindMarkers: TypeAlias = Callable[[], Sequence[Float[Tensor, "_markers 2"]]]
"""Function that finds the markers of all frames, x and y in the network's input."""
Baseline: TypeAlias = Literal["untouched", "stick", "black", "mean", "blurred"] | UInt8[np.ndarray, "_ _ 3"]
"""Baseline of predictions: the untouched sensor, the last frame before the pull, an image that shows nothing, or a
frame."""
_BLUR_SHARE = 0.05
"""Standard deviation of the blur of a baseline, as a share of the image's height."""


@dataclass(frozen=True, kw_only=True)
class FrameSelection:
    """Frames of a data set: those nearest to some safety margins in the first trials of a split and condition."""

    split: str = "test"
    condition: str = "dry"
    trials: int = 1
    """Number of trials."""
    levels: tuple[float, ...] = MARGIN_LEVELS
    """Safety margins in [0, 1]."""

    def __post_init__(self) -> None:
        if self.trials < 1:
            raise InputError(f"--trials must be at least 1, got {self.trials}")
        if any(not 0 <= level <= 1 for level in self.levels):
            raise InputError(f"levels must lie in [0, 1], got {', '.join(f'{level:g}' for level in self.levels)}")


@dataclass(frozen=True, kw_only=True)
class ChosenFrames:
    """Frames to explain, compared and resized but still in 8 bits, so that they can be stored exactly."""

    ids: tuple[str, ...]
    day: tuple[int, ...]
    trial: tuple[str, ...]
    condition: tuple[str, ...]
    safety_margin: Float32[np.ndarray, " frames"]
    """Labels; NaN where a frame has none."""
    images: UInt8[Tensor, "frames colours size size"]
    """Resized network inputs before normalisation."""
    references: UInt8[Tensor, "frames colours size size"]
    """Network inputs of the baseline that each frame is compared with, before normalisation."""
    source: str
    """Either "simulated" or "real": a recorded data set or a folder of images."""
    together: bool = False
    """True if all frames are explained in one batch, not one by one."""
    find_markers: FindMarkers | None = field(default=None, repr=False, compare=False)
    """Function that finds the markers; None where they do not show."""
    baseline: BaselineName = "untouched"
    """Kind of the baseline; `stick` if that of any trial is a stick frame."""
    baseline_frame: tuple[int | None, ...]
    """Number of the stick frame in the trial of each frame; None where the baseline is no frame of the trial."""
    warnings: tuple[str, ...] = ()
    """Trials in which no stick frame was found."""

    @property
    def batches(self) -> list[Sequence[int]]:
        """Row numbers of the frames that are explained in one call."""
        rows = range(len(self.ids))
        return [rows] if self.together else [[row] for row in rows]


def find_stick_frame(
    trial: str,
    frames: Iterable[UInt8[np.ndarray, "height width 3"]],
    reference: UInt8[np.ndarray, "height width 3"] | None,
    margin: Float[np.ndarray, " frames"] | None = None,
) -> tuple[int | None, tuple[str, ...]]:
    """Find the last frame before the pull of a trial, from its labels or else by tracking its markers.

    By labels it is the last frame before the first full slip whose margin is at least 97 % of the trial's largest.
    None and a warning if the labels begin below a margin of 0.9, or the markers show no press.
    """
    if margin is not None and np.isfinite(margin).any():
        slips = np.flatnonzero(margin <= 0)
        before = margin[: slips[0]] if len(slips) else margin
        largest = np.fmax.reduce(before, initial=0.0)
        if largest >= _LEAST_STICK:
            return int(np.flatnonzero(before >= _STICK_SHARE * largest)[-1]), ()
        reason = f"no margin before the first full slip reaches {_LEAST_STICK:g}"
    elif reference is None:
        reason = "it has no labels, and no image of the untouched sensor to track markers from"
    else:
        try:
            tracks = track_markers(frames, reference)
            hold = find_hold(tracks.rest_px, tracks.displacement_px)
            if affine_parts(tracks.rest_px, tracks.displacement_px[hold : hold + 1])[0, 2] >= _LEAST_SPREAD:
                return hold, ()
            reason = "its markers show no press"
        except SliplensError as error:  # no markers, or no OpenCV
            reason = error
    compared = "so frames are compared with the untouched sensor"
    return None, (f"{trial}: the last frame before the pull was not found, {compared}: {reason}",)


def frames_from_arrays(
    network: Network,
    frames: UInt8[np.ndarray, "batch height width 3"],
    reference: UInt8[np.ndarray, "height width 3"] | None,
    *,
    baseline: Baseline = "untouched",
) -> ChosenFrames:
    """Choose all of an array of camera frames, or without a reference of difference images.

    For the baseline `stick` they are the frames of one trial in their order.
    """
    if not len(frames):
        raise ImageError("there is no frame to explain; give one at least")
    network.require_frame_size(frames.shape[1:3])
    # images of other sources than a sensor are independent, frames of a sensor are of one trial
    of_images = network.wrapped
    encoding, image_size = network.encoding, network.manifest.image_size
    if reference is None and not encoding.empty_is_black and (encoding.compares or not of_images):
        raise InputError(
            f"a network on {encoding.name} images needs the untouched sensor; give it as reference, on the command "
            "line with --reference IMAGE"
        )

    def small(images: UInt8[np.ndarray, "batch height width 3"]) -> UInt8[Tensor, "batch colours size size"]:
        if reference is None:
            return encoding.resize(images, image_size=image_size)
        return encoding.compare_small(images, reference, image_size=image_size)

    stick, warnings, images = None, (), small(frames)
    if not isinstance(baseline, str):
        network.require_frame_size(baseline.shape[:2], what="the baseline's frame")
        references, name = small(baseline[None]), "given"
    elif baseline == "blurred":
        from scipy.ndimage import gaussian_filter  # noqa: PLC0415 (takes a fifth of a second)

        sigma = _BLUR_SHARE * frames.shape[1]
        blurred = gaussian_filter(frames.astype(np.float32), (0, sigma, sigma, 0))
        references, name = small(np.round(blurred).astype(np.uint8)), baseline
    elif baseline in {"black", "mean"}:
        colour = frames.mean(axis=(0, 1, 2)).round() if baseline == "mean" else 0
        references, name = small(np.broadcast_to(np.asarray(colour, np.uint8), frames.shape)), baseline
    else:
        if baseline == "stick":
            stick, warnings = find_stick_frame("frames", frames, reference)
        compared, name = (reference, "untouched") if stick is None else (frames[stick], "stick")
        if compared is None and not encoding.compares:
            name = "black"
        references = torch.zeros_like(images[:1]) if compared is None else small(compared[None])

    def find_markers() -> list[Float[Tensor, "_markers 2"]]:
        return [markers_in_frame(frame, image_size=image_size) for frame in frames]

    ids = tuple(f"frame-{number:04d}" for number in range(len(frames)))
    return ChosenFrames(
        ids=ids,
        day=(1,) * len(frames),
        trial=ids if of_images and reference is None else ("frames",) * len(frames),
        condition=("unknown",) * len(frames),
        safety_margin=np.full(len(frames), np.nan, dtype=np.float32),
        images=images,
        references=references.expand_as(images),
        source="real",
        together=True,
        find_markers=None if reference is None else find_markers,
        baseline=name,
        baseline_frame=(stick,) * len(frames),
        warnings=warnings,
    )


def frames_from_dataset(
    network: Network, data: Dataset, selection: FrameSelection, *, baseline: Baseline = "untouched"
) -> ChosenFrames:
    """Choose frames of the first trials of a split, in the order of the data set's table, at given safety margins.

    For each trial and level the frame whose label is nearest is taken; at a level of 0 the first frame of full slip, at
    1 the last frame that is still fully stuck, so that each is next to the change.
    """
    rows: list[tuple[str, int]] = []
    for info in data.select(split=selection.split, condition=selection.condition)[: selection.trials]:
        (opened,) = open_source(data, trial=info.trial)
        margin = require_labels(opened.trial, opened.safety_margin)
        rows += [(info.trial, nearest_frame(margin, level)) for level in selection.levels]
    return frames_at(network, data, rows, baseline=baseline)


def require_labels(trial: str, margin: Float[np.ndarray, " frames"] | None) -> Float[np.ndarray, " frames"]:
    """Return the labels of a trial if it has any."""
    if margin is None or not np.isfinite(margin).any():
        raise RecordingError(f"trial {trial} has no labelled frame; label it first")
    return margin


def frames_at(
    network: Network, data: Dataset, frames: Sequence[tuple[str, int]], *, baseline: Baseline = "untouched"
) -> ChosenFrames:
    """Choose frames of a data set by trial and number, those of a trial one after another."""
    infos, parts = {info.trial: info for info in data.trials}, []
    for trial, group in groupby(frames, key=lambda frame: frame[0]):
        (opened,), info = open_source(data, trial=trial), infos[trial]
        part = _take(network, opened, [number for _, number in group], source=data.source, baseline=baseline)
        ids = len(part.ids)
        parts.append(replace(part, trial=(trial,) * ids, day=(info.day,) * ids, condition=(info.condition,) * ids))

    def find_markers() -> list[Float[Tensor, "_markers 2"]]:
        opened = {trial: data.load(infos[trial]) for trial in dict.fromkeys(trial for trial, _ in frames)}
        size = network.manifest.image_size
        return [markers_in_recording(opened[trial], number, image_size=size) for trial, number in frames]

    return replace(_join(parts), find_markers=find_markers)


def nearest_frame(margin: Float[np.ndarray, " frames"], level: float) -> int:
    """Return the frame whose margin is nearest to a level, next to the change where many are equally near."""
    distance = np.abs(margin - level)
    nearest = np.flatnonzero(distance == np.nanmin(distance))
    return int(nearest[-1] if level >= 0.5 else nearest[0])


def frames_from_folder(
    network: Network,
    source: Path | str | Recording,
    *,
    labels_in_names: bool = False,
    baseline: Baseline | None = "untouched",
    **facts: Unpack[SourceOptions],
) -> ChosenFrames:
    """Choose all images of a folder, in natural order, or all frames of a recording that `open_source` opens.

    They are camera frames if the `facts`, those of `open_source`, or the source name a reference, or the network
    compares frames of a recording, else absolute difference images |T_n - T_0|. If `labels_in_names`, names that end in
    `_GG`, such as `image_433_20.png`, hold the safety margin in percent. If `baseline` is None, `stick` for a recording
    of several frames and `untouched` for a folder of images.
    """
    parts = []
    for capture in open_source(source, **facts):
        opened = assume_reference(network, capture)
        default = "stick" if opened.files is None and len(opened) > 1 else "untouched"
        chosen = default if baseline is None else baseline
        origin = "simulated" if opened.simulated else "real"
        part = _take(network, opened, range(len(opened)), source=origin, baseline=chosen)
        part = replace(
            part,
            trial=(Path(opened.opened).name if opened.files else opened.trial,) * len(part.ids),
            warnings=(*part.warnings, *opened.notes[len(capture.notes) :]),
        )
        if labels_in_names:
            margin = []
            for name in part.ids:
                if (label := _LABEL.search(name)) is None:
                    raise InputError(
                        f"{name} of {opened.opened} carries no label; its name must end in the safety margin in "
                        "percent, as in _20.png"
                    )
                margin.append(int(label[1]) / 100)
            part = replace(part, safety_margin=np.array(margin, dtype=np.float32))
        parts.append(part)

    return _join(parts)


def _take(
    network: Network, opened: Capture, numbers: Sequence[int], *, source: str, baseline: Baseline
) -> ChosenFrames:
    names = opened.files or [f"{opened.trial}-f{number:04d}" for number in range(len(opened))]
    network.require_frame_size(opened.frame_size, what=f"frames such as {names[numbers[0]]}")
    untouched = None if opened.read_reference is None else opened.read_reference()
    stick, warnings = None, ()
    if isinstance(baseline, str) and baseline == "stick":
        baseline = "untouched"
        stick, warnings = find_stick_frame(opened.trial, opened.read_frames(), untouched, opened.safety_margin)
    wanted = {*numbers} if stick is None else {*numbers, stick}
    frames = {
        number: frame for number, frame in enumerate(islice(opened.read_frames(), max(wanted) + 1)) if number in wanted
    }
    if untouched is None and source == "real":
        network.require_kind(frames[numbers[0]], what=names[numbers[0]])
    taken = np.stack([frames[number] for number in numbers])
    chosen = frames_from_arrays(network, taken, untouched, baseline=baseline if stick is None else frames[stick])
    margin = np.full(len(opened), np.nan) if opened.safety_margin is None else opened.safety_margin
    return replace(
        chosen,
        ids=tuple(Path(names[number]).stem if opened.files else names[number] for number in numbers),
        safety_margin=margin[list(numbers)].astype(np.float32),
        source=source,
        together=False,
        baseline=chosen.baseline if stick is None else "stick",
        baseline_frame=(stick,) * len(numbers),
        warnings=warnings,
    )


def _join(parts: Sequence[ChosenFrames]) -> ChosenFrames:
    names = ("ids", "day", "trial", "condition", "baseline_frame", "warnings")
    finders = [part.find_markers for part in parts if part.find_markers is not None]
    return replace(
        parts[0],
        **{name: sum((getattr(part, name) for part in parts), ()) for name in names},
        safety_margin=np.concatenate([part.safety_margin for part in parts]),
        images=torch.cat([part.images for part in parts]),
        references=torch.cat([part.references for part in parts]),
        find_markers=(lambda: [places for find in finders for places in find()])
        if len(finders) == len(parts)
        else None,
        baseline=max(
            (part.baseline for part in parts), key=("black", "mean", "blurred", "untouched", "given", "stick").index
        ),
    )
