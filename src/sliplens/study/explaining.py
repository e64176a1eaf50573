"""Explain frames, one piece at a time, so that an interrupted run loses at most one map."""

import re
import shutil
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor

from sliplens.arrays import require_saliency
from sliplens.errors import InputError, RecordingError
from sliplens.explainers import EXPLAINERS, Explainer, Explanation
from sliplens.files import RUN_FILE, read_json, require_folder, write_json
from sliplens.images.files import write_png
from sliplens.models import TrainedModel
from sliplens.recordings import Dataset
from sliplens.recordings.source import open_source

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
    """Images of a folder, in natural order, or the frames of whatever recording `open_source` opens.

    Parameters
    ----------
    trained
        The network.
    folder
        Frames of the size the network's sensor has: camera frames if `reference` is given or the source brings one,
        otherwise absolute difference images |T_n - T_0|.
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
    image_size, parts = trained.manifest.image_size, []
    for trial in open_source(folder, reference=reference):
        trained.require_frame_size(trial.frame_size)
        frames = np.stack(list(trial.read_frames()))
        if trial.read_reference is not None:
            untouched = trial.read_reference()
            frames = trained.encoding.compare(frames, untouched)
            empty = trained.encoding.empty(untouched, image_size=image_size)
        elif trained.encoding.empty_is_black:
            empty = torch.zeros(3, image_size, image_size)
        else:
            raise InputError(
                f"a network on {trained.encoding.name} images needs the untouched sensor; give it with "
                "--reference IMAGE"
            )
        names = trial.files or [f"{trial.name}-f{number:04d}" for number in range(trial.frames)]
        labels = np.full(trial.frames, np.nan) if trial.safety_margin is None else trial.safety_margin
        if labels_in_names:
            labels = np.array([_label(folder / name) for name in names])
        parts.append(
            ChosenFrames(
                ids=tuple(Path(name).stem for name in names),
                trial=(folder.name if trial.files else trial.name,) * trial.frames,
                condition=("unknown",) * trial.frames,
                safety_margin=labels.astype(np.float32),
                images=trained.encoding.resize(frames, image_size=image_size),
                references=empty.expand(trial.frames, -1, -1, -1).clone(),
                source="real",
            )
        )
    return _join(parts)


def _join(parts: Sequence[ChosenFrames]) -> ChosenFrames:
    return ChosenFrames(
        ids=sum((part.ids for part in parts), ()),
        trial=sum((part.trial for part in parts), ()),
        condition=sum((part.condition for part in parts), ()),
        safety_margin=np.concatenate([part.safety_margin for part in parts]),
        images=torch.cat([part.images for part in parts]),
        references=torch.cat([part.references for part in parts]),
        source=parts[0].source,
    )


def _label(path: Path) -> float:
    found = _LABEL.search(path.stem)
    if found is None:
        raise InputError(f"{path} carries no label; its name must end in the safety margin in percent, as in _20.png")
    return int(found.group(1)) / 100


RESULT_FILE = "result.json"
MAPS_FILE = "maps.npz"
INPUTS_FILE = "inputs.npz"
_SALIENCY = ".saliency"


@dataclass(frozen=True, kw_only=True)
class ExplainedFrame:
    """One explained frame, its numbers in margin units; `safety_margin` is None where there is no label."""

    id: str
    trial: str
    condition: str
    safety_margin: float | None
    prediction: float
    reference_prediction: float


@dataclass(frozen=True, kw_only=True)
class Explained:
    """A folder of explanations, loaded.

    Attributes
    ----------
    images
        The network's inputs before normalisation, 8 bits.
    relevance, saliency
        By method: signed maps in margin units, and the same in [0, 1] for viewing and for ranking pixels.
    weights_sha256
        Hash of the network that was explained.
    """

    input: str
    source: str
    frames: tuple[ExplainedFrame, ...]
    images: UInt8[Tensor, "frames 3 size size"]
    relevance: Mapping[str, Float32[np.ndarray, "frames size size"]]
    saliency: Mapping[str, Float32[np.ndarray, "frames size size"]]
    weights_sha256: str


def save_explained(
    explained: Explained, folder: Path, *, pictures: UInt8[Tensor, "frames 3 size size"], methods: Mapping[str, Any]
) -> None:
    """Write maps, inputs, a picture of each input, and the table.

    Parameters
    ----------
    explained
        What was found.
    folder
        Must exist.
    pictures
        The normalised inputs, 8 bits, for people to look at.
    methods
        What the report says of each method: seconds a frame and warnings.
    """
    maps = dict(explained.relevance) | {name + _SALIENCY: value for name, value in explained.saliency.items()}
    np.savez_compressed(folder / MAPS_FILE, allow_pickle=False, **maps)
    np.savez_compressed(folder / INPUTS_FILE, allow_pickle=False, images=explained.images.numpy())
    (folder / "frames").mkdir(exist_ok=True)
    for frame, picture in zip(explained.frames, pictures, strict=True):
        write_png(folder / "frames" / f"{frame.id}.png", picture.permute(1, 2, 0).contiguous().numpy())
    write_json(
        folder / RESULT_FILE,
        {
            "input": explained.input,
            "source": explained.source,
            "image_size": explained.images.shape[-1],
            "frames": list(explained.frames),
            "methods": methods,
        },
    )


def load_explained(folder: Path) -> Explained:
    """Read a folder that `sliplens explain` wrote.

    Raises
    ------
    InputError
        If the folder or one of its files is missing or damaged.
    SaliencyError
        If a map has another shape than its frame, or is not finite.
    """
    require_folder(folder, what="the explanations")
    result = read_json(folder / RESULT_FILE)
    run = read_json(folder / RUN_FILE)
    if not isinstance(result, dict) or run.get("stage") != "explain":
        raise InputError(f"{folder} holds no explanations; make them with sliplens explain")
    images = read_arrays(folder / INPUTS_FILE)["images"]
    maps = read_arrays(folder / MAPS_FILE)
    names = [frame["id"] for frame in result["frames"]]
    for method, stack in maps.items():
        if len(stack) != len(names):
            raise InputError(
                f"{folder / MAPS_FILE} has {len(stack)} {method} maps for {len(names)} frames; explain again"
            )
        for name, one in zip(names, stack, strict=True):
            require_saliency(one, images.shape[-2:], where=f"the {method} map of {name} in {folder / MAPS_FILE}")
    return Explained(
        input=result["input"],
        source=result["source"],
        frames=tuple(ExplainedFrame(**frame) for frame in result["frames"]),
        images=torch.from_numpy(images),
        relevance={name: value for name, value in maps.items() if not name.endswith(_SALIENCY)},
        saliency={name.removesuffix(_SALIENCY): value for name, value in maps.items() if name.endswith(_SALIENCY)},
        weights_sha256=run["config"]["weights_sha256"],
    )


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read arrays of one file by name.

    Raises
    ------
    InputError
        If the file is missing or damaged.
    """
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except FileNotFoundError:
        raise InputError(f"{path} is missing; explain the frames again") from None
    except (zipfile.BadZipFile, OSError, ValueError, EOFError) as error:
        raise InputError(f"{path} is damaged ({error}); explain the frames again") from None


def mean_of_known(values: Float[np.ndarray, " values"]) -> float | None:
    """Mean of what is defined; None where nothing is, since JSON knows no NaN."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else None


Progress = Callable[[int, int], None]
DEFAULT_METHODS = ("grad-cam", "integrated-gradients", "poly-cam")
"""The three methods the thesis compares."""


def require_methods(methods: Sequence[str], explainers: Mapping[str, object] = EXPLAINERS) -> None:
    """Refuse a method that is not in the table.

    Raises
    ------
    InputError
        Listing those there are.
    """
    for name in methods:
        if name not in explainers:
            raise InputError(f"there is no explainer named {name!r}; choose from {', '.join(explainers)}")


def explain_frames(
    trained: TrainedModel,
    chosen: ChosenFrames,
    folder: Path,
    *,
    methods: Sequence[str] = DEFAULT_METHODS,
    explainers: Mapping[str, Explainer | Sequence[Explainer]] = EXPLAINERS,
    on_map: Progress | None = None,
) -> Explained:
    """Explain frames with several methods and write the result.

    Each map is written under `parts` as soon as it is there; a second call with the same folder goes on after the last.

    Parameters
    ----------
    trained
        The network.
    chosen
        The frames.
    folder
        Where the result is written; must exist.
    methods
        Names in the table of explainers.
    explainers
        The table, where their options are not the default ones; a method whose options differ from frame to frame has
        one explainer for each.
    on_map
        Called with the number of maps done and the number of all.

    Raises
    ------
    InputError
        If a method is unknown.
    """
    require_methods(methods, explainers)
    parts = folder / "parts"
    parts.mkdir(exist_ok=True)
    inputs = trained.encoding.normalise(chosen.images).to(trained.device)
    untouched = chosen.references.to(trained.device)
    relevance: dict[str, Any] = {}
    saliency: dict[str, Any] = {}
    notes: dict[str, Any] = {}
    total = len(methods) * len(inputs)
    for number, method in enumerate(methods):
        pieces = []
        for index in range(len(inputs)):
            part = parts / f"{method}-{index:05d}.npz"
            if not part.is_file():
                one = slice(index, index + 1)
                explain = explainers[method]
                if isinstance(explain, Sequence):
                    explain = explain[index]
                explanation = explain(trained.model, inputs[one], reference=untouched[one])
                _save_part(part, explanation)
            with np.load(part, allow_pickle=False) as archive:
                pieces.append({name: archive[name] for name in archive.files})
            if on_map is not None:
                on_map(number * len(inputs) + index + 1, total)
        relevance[method] = np.stack([piece["relevance"] for piece in pieces])
        saliency[method] = np.stack([piece["saliency"] for piece in pieces])
        notes[method] = _notes(pieces, chosen.ids)
    # the same answers for every method: asked once, on all frames
    predictions = trained.predict(inputs)
    references = trained.predict(chosen.references)
    explained = Explained(
        input=trained.encoding.name,
        source=chosen.source,
        frames=tuple(
            ExplainedFrame(
                id=chosen.ids[index],
                trial=chosen.trial[index],
                condition=chosen.condition[index],
                safety_margin=_or_none(float(chosen.safety_margin[index])),
                prediction=float(predictions[index]),
                reference_prediction=float(references[index]),
            )
            for index in range(len(inputs))
        ),
        images=chosen.images,
        relevance=relevance,
        saliency=saliency,
        weights_sha256=trained.manifest.weights_sha256,
    )
    save_explained(explained, folder, pictures=(255 * inputs).round().to(torch.uint8).cpu(), methods=notes)
    shutil.rmtree(parts)
    return explained


def _save_part(path: Path, explanation: Explanation) -> None:
    hidden = path.with_suffix(".part.npz")
    np.savez(
        hidden,
        allow_pickle=False,
        relevance=explanation.relevance[0].cpu().numpy(),
        saliency=explanation.saliency[0].cpu().numpy(),
        seconds=np.float64(explanation.seconds),
        warnings=np.array(explanation.warnings, dtype=np.str_),
    )
    hidden.replace(path)


def _notes(pieces: list[dict[str, np.ndarray]], ids: Sequence[str]) -> dict[str, Any]:
    warnings: dict[str, list[str]] = {}
    for name, piece in zip(ids, pieces, strict=True):
        for warning in piece["warnings"]:
            # each frame was explained by itself: its place in that batch of one tells nothing
            warnings.setdefault(str(warning).removeprefix("image 0: "), []).append(name)
    return {
        "seconds_per_frame": float(np.mean([piece["seconds"] for piece in pieces])),
        "warnings": [f"{', '.join(names)}: {warning}" for warning, names in warnings.items()],
    }


def _or_none(value: float) -> float | None:
    return value if np.isfinite(value) else None
