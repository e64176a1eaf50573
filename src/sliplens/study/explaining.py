"""Frames to explain, and their explanations, made one map at a time."""

import hashlib
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, islice
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor

from sliplens.errors import InputError, RecordingError
from sliplens.explainers.attribution import frame_of
from sliplens.explainers.contract import Explainer
from sliplens.explainers.table import EXPLAINERS, network_images
from sliplens.models import Network
from sliplens.models.engines import expecting
from sliplens.plots.saliency import NOMINAL_MARGINS
from sliplens.progress import OnProgress, number_of
from sliplens.recordings import Dataset
from sliplens.recordings.capture import Capture
from sliplens.recordings.sensor import SensorProfile
from sliplens.recordings.source import open_source
from sliplens.results.evaluation import ANSWER, SHARE
from sliplens.results.explanation import ExplainedFrame, Explanation, MethodNotes, require_saliency
from sliplens.runner import Part, part
from sliplens.study.stages import Find, Stage

DEFAULT_LEVELS = NOMINAL_MARGINS
"""Safety margins at which the thesis explains frames (section 4)."""

_LABEL = re.compile(r"_(0|[1-9]\d?|100)$")


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
    references: Float32[Tensor, "frames colours size size"]
    """What each explanation is measured against: the untouched sensor, in [0, 1]."""
    source: str
    """Either "simulated" or "real": a recorded data set or a folder of images."""


def frames_from_dataset(
    trained: Network,
    data: Dataset,
    *,
    split: str = "test",
    condition: str = "dry",
    trials: int = 1,
    levels: Sequence[float] = DEFAULT_LEVELS,
) -> ChosenFrames:
    """Frames of the first trials of a split, in the order of the data set's table, at given safety margins.

    For each trial and level the frame whose label is nearest is taken; at a level of 0 the first frame of full slip, at
    1 the last frame that is still fully stuck, so that each is next to the change.

    Raises
    ------
    RecordingError
        If there is no such trial, or a trial has no labelled frame.
    InputError
        If a level is outside [0, 1].
    """
    rows: list[tuple[str, int]] = []
    for info in data.select(split=split, condition=condition)[:trials]:
        (opened,) = open_source(data, trial=info.trial)
        margin = known_margin(opened.name, opened.safety_margin)
        rows += [(info.trial, nearest_frame(margin, level)) for level in require_levels(levels)]
    return frames_at(trained, data, rows)


def require_levels(levels: Sequence[float]) -> Sequence[float]:
    """Safety margins that are looked for, each of which must lie in [0, 1]."""
    if any(not 0 <= level <= 1 for level in levels):
        raise InputError(f"levels must lie in [0, 1], got {', '.join(f'{level:g}' for level in levels)}")
    return levels


def known_margin(trial: str, margin: Float[np.ndarray, " frames"] | None) -> Float[np.ndarray, " frames"]:
    """Labels of a trial, of which one at least is known."""
    if margin is None or not np.isfinite(margin).any():
        raise RecordingError(f"trial {trial} has no labelled frame; label it first")
    return margin


def frames_at(trained: Network, data: Dataset, frames: Sequence[tuple[str, int]]) -> ChosenFrames:
    """Frames of a data set by trial and number, those of a trial one after another."""
    infos = {info.trial: info for info in data.trials}
    parts = []
    for trial, own in groupby(frames, key=lambda frame: frame[0]):
        if trial not in infos:
            raise RecordingError(f"{data.folder} has no trial {trial}; use the data set that the frames came from")
        (opened,) = open_source(data, trial=trial)
        numbers = [number for _, number in own]
        info = infos[trial]
        parts.append(
            _take(trained, opened, numbers, trial=trial, day=info.day, source=data.source, condition=info.condition)
        )
    return _join(parts)


def nearest_frame(margin: Float[np.ndarray, " frames"], level: float) -> int:
    """Frame whose margin is nearest to a level, next to the change where many are: the last above, the first below."""
    distance = np.abs(margin - level)
    nearest = np.flatnonzero(distance == np.nanmin(distance))
    return int(nearest[-1] if level >= 0.5 else nearest[0])


def frames_from_folder(
    trained: Network,
    folder: Path,
    *,
    reference: Path | None = None,
    labels_in_names: bool = False,
    sensor: SensorProfile | Path | str | None = None,
) -> ChosenFrames:
    """Images of a folder, in natural order, or the frames of whatever recording `open_source` opens.

    They have the size of the network's sensor: camera frames if `reference` is given or the source brings one, else
    absolute difference images |T_n - T_0|. `labels_in_names` reads the safety margin in percent from names that end in
    `_GG`, as in `image_433_20.png`; `sensor` as `open_source` takes it.

    Raises
    ------
    InputError
        If the folder is missing or empty, a name has no label though labels are asked for, or a network that reads raw
        frames got no reference image.
    ImageError
        If an image cannot be read, or has another size or kind of pixels.
    """
    parts = []
    for opened in open_source(folder, reference=reference, sensor=sensor):
        name = folder.name if opened.files else opened.name
        part = _take(trained, opened, range(opened.frames), trial=name, day=1, source="real", condition="unknown")
        if labels_in_names:
            margin = np.array([_label(folder / name) for name in opened.files or part.ids], dtype=np.float32)
            part = replace(part, safety_margin=margin)
        parts.append(part)
    return _join(parts)


def _take(
    trained: Network, opened: Capture, numbers: Sequence[int], *, trial: str, day: int, source: str, condition: str
) -> ChosenFrames:
    names = opened.files or [f"{opened.name}-f{number:04d}" for number in range(opened.frames)]
    trained.require_frame_size(opened.frame_size, what=f"frames such as {names[numbers[0]]}")
    untouched = None if opened.read_reference is None else opened.read_reference()
    first = islice(opened.read_frames(), max(numbers) + 1)
    frames = {number: frame for number, frame in enumerate(first) if number in numbers}
    if untouched is None and source == "real":
        trained.require_kind(frames[numbers[0]], what=names[numbers[0]])
    images, empty = network_images(trained, np.stack([frames[number] for number in numbers]), untouched)
    margin = np.full(opened.frames, np.nan) if opened.safety_margin is None else opened.safety_margin
    return ChosenFrames(
        ids=tuple(Path(names[number]).stem if opened.files else names[number] for number in numbers),
        day=(day,) * len(numbers),
        trial=(trial,) * len(numbers),
        condition=(condition,) * len(numbers),
        safety_margin=margin[list(numbers)].astype(np.float32),
        images=images,
        references=empty.expand(len(numbers), -1, -1, -1),
        source=source,
    )


def _join(parts: Sequence[ChosenFrames]) -> ChosenFrames:
    told: dict[str, Any] = {
        name: sum((getattr(part, name) for part in parts), ()) for name in ("ids", "day", "trial", "condition")
    }
    told |= {name: torch.cat([getattr(part, name) for part in parts]) for name in ("images", "references")}
    margin = np.concatenate([part.safety_margin for part in parts])
    return ChosenFrames(**told, safety_margin=margin, source=parts[0].source)


def _label(path: Path) -> float:
    found = _LABEL.search(path.stem)
    if found is None:
        raise InputError(f"{path} carries no label; its name must end in the safety margin in percent, as in _20.png")
    return int(found.group(1)) / 100


DEFAULT_METHODS = ("grad-cam", "integrated-gradients", "poly-cam")
"""The three methods the thesis compares."""


def require_methods(methods: Sequence[str], explainers: Collection[str] = EXPLAINERS) -> None:
    """Refuse a method that is not in the table."""
    for name in methods:
        if name not in explainers:
            raise InputError(f"there is no explainer named {name!r}; choose from {', '.join(explainers)}")


OnMap: TypeAlias = Callable[[str, int, UInt8[np.ndarray, "height width 3"], Float32[np.ndarray, "height width"]], None]
"""Takes the method, the number of the frame, its picture, and its map."""


@dataclass(frozen=True, kw_only=True)
class _Map:
    """Explanation of one frame by one method."""

    relevance: Annotated[Float32[np.ndarray, "height width"], ANSWER]
    saliency: Annotated[Float32[np.ndarray, "height width"], SHARE]
    seconds: float
    warnings: tuple[str, ...]


_PASSES_A_MAP = 300
"""Of a map by Poly-CAM on a budget, or by Shapley values."""
_FEW_MAPS = 20


@dataclass(frozen=True, kw_only=True)
class Explaining(Stage[Explanation]):
    """Maps of chosen frames, a shard of (method, frame) each."""

    piece = _Map
    title = "Explaining frames"

    trained: Network
    chosen: ChosenFrames
    explainers: Mapping[str, Explainer]

    def prepare(self) -> Find:
        """Explain one frame with one method."""
        run, references = self.trained, self.chosen.references

        def find(item: tuple[str, int], _: OnProgress) -> _Map:
            method, frame = item[0], slice(item[1], item[1] + 1)
            inputs = run.encoding.normalise(self.chosen.images[frame]).to(run.device)
            maps = len(self.chosen.ids) * len(self.explainers)
            # of few maps the first is waited for: each then takes the engine that its own passes pay for
            with expecting(_PASSES_A_MAP * maps if maps > _FEW_MAPS else 0):
                explanation = self.explainers[method](run.model, inputs, reference=references[frame].to(run.device))
            relevance = explanation.relevance[0].cpu().numpy()
            where = f"the map of {self.chosen.ids[item[1]]} by {method}"
            return _Map(
                relevance=require_saliency(relevance, inputs.shape[-2:], where=where),
                saliency=explanation.saliency[0].cpu().numpy(),
                seconds=explanation.seconds,
                warnings=explanation.warnings,
            )

        return find

    def shards(self) -> Iterator[Part]:
        """Every frame with the first method, then with the next."""
        weights = self.trained.manifest.weights_sha256
        for method in self.explainers:
            # the folder of the parts is one of these options alone (`files.output_folder`)
            recipe = {"weights_sha256": weights, "method": method}
            for index, trial in enumerate(self.chosen.trial):
                shown = self.chosen.images[index].numpy().tobytes() + self.chosen.references[index].numpy().tobytes()
                known = {"recipe": recipe, "content": hashlib.sha256(shown).hexdigest(), "first": index, "frames": 1}
                yield part((method, index), trial=trial, name=f"{method} of {self.chosen.ids[index]}", **known)

    @property
    def inputs(self) -> Float[Tensor, "frames colours size size"]:
        """What the network gets of the frames, in [0, 1], on its device."""
        return self.trained.encoding.normalise(self.chosen.images).to(self.trained.device)

    def pictures(self) -> UInt8[np.ndarray, "frames size size 3"]:
        """What of that a person sees."""
        shown = (255 * frame_of(self.inputs)).round().to(torch.uint8).permute(0, 2, 3, 1)
        return shown.contiguous().cpu().numpy()

    def join(self, pieces: Sequence[_Map]) -> Explanation:
        """Maps of all frames, with what the network reads from them."""
        trained, chosen, frames = self.trained, self.chosen, len(self.chosen.ids)
        maps = {method: pieces[at * frames : (at + 1) * frames] for at, method in enumerate(self.explainers)}
        # the same answers for every method: asked once, on all frames
        estimate, untouched = trained.estimate(self.inputs), trained.predict(chosen.references).tolist()
        withheld = estimate.withheld(np.ones(frames, dtype=bool))  # who explains a frame holds it to touch something
        return Explanation(
            input=trained.encoding.name,
            source=chosen.source,
            weights_sha256=trained.manifest.weights_sha256,
            frames=tuple(
                ExplainedFrame(
                    id=chosen.ids[index],
                    trial=chosen.trial[index],
                    day=chosen.day[index],
                    condition=chosen.condition[index],
                    safety_margin=float(margin) if np.isfinite(margin) else None,
                    prediction=float(estimate.margin[index]),
                    withheld=withheld[index],
                    reference_prediction=untouched[index],
                )
                for index, margin in enumerate(chosen.safety_margin)
            ),
            methods={method: _note(own, chosen.ids) for method, own in maps.items()},
            images=chosen.images.numpy(),
            pictures=self.pictures(),
            relevance={method: np.stack([one.relevance for one in own]) for method, own in maps.items()},
            saliency={method: np.stack([one.saliency for one in own]) for method, own in maps.items()},
        )


def explain_frames(
    trained: Network,
    chosen: ChosenFrames,
    *,
    methods: Sequence[str] = DEFAULT_METHODS,
    explainers: Mapping[str, Explainer] = EXPLAINERS,
    parts: Path | None = None,
    on: str = "serial",
    retry_failed: bool = False,
    on_map: OnMap | None = None,
    on_progress: OnProgress | None = None,
) -> Explanation:
    """Explain frames with several methods.

    `parts` is a folder that keeps each map as soon as it is there, so that an interrupted run loses at most one a
    process. `on` says where maps are made, a row of `runner.EXECUTORS`; `retry_failed` tries those again that failed
    before. `on_map` is called with each: method, number of the frame, its picture, and the map.

    Raises
    ------
    InputError
        If a method is unknown.
    PartError
        If some of many maps failed again and again, when all others are there.
    """
    require_methods(methods, explainers)
    work = Explaining(trained=trained, chosen=chosen, explainers={name: explainers[name] for name in methods})
    pictures = work.pictures() if on_map is not None else None

    def show(item: tuple[str, int], made: _Map) -> None:
        if on_map is not None and pictures is not None:
            method, index = item
            on_map(method, index, pictures[index], made.relevance)

    shown = None if on_map is None else show
    return work.make(parts, on=on, retry_failed=retry_failed, on_piece=shown, on_progress=on_progress)


def _note(maps: Sequence[_Map], ids: Sequence[str]) -> MethodNotes:
    warnings: dict[str, list[str]] = {}
    for name, own in zip(ids, maps, strict=True):
        for warning in own.warnings:
            # each frame was explained by itself: its place in that batch of one tells nothing
            warnings.setdefault(warning.removeprefix("image 0: "), []).append(name)
    return MethodNotes(
        seconds_per_frame=float(np.mean([own.seconds for own in maps])),
        warnings=tuple(f"{_of_all(names, len(ids))}: {warning}" for warning, names in warnings.items()),
    )


_NAMED = 3
"""Frames that a warning names."""


def _of_all(names: Sequence[str], count: int) -> str:
    """Frames that a warning is of, against how many were explained."""
    more = ", \N{HORIZONTAL ELLIPSIS}" if len(names) > _NAMED else ""
    return f"{len(names)} of {number_of(count, 'frame')} ({', '.join(names[:_NAMED])}{more})"


def network_inputs(trained: Network, explained: Explanation) -> Float[Tensor, "frames colours size size"]:
    """What the network got of explained frames, in [0, 1], on its device."""
    return trained.encoding.normalise(torch.from_numpy(explained.images)).to(trained.device)


def mean_of_known(values: Float[np.ndarray, " values"]) -> float | None:
    """Mean of what is defined; None where nothing is, since JSON knows no NaN."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else None
