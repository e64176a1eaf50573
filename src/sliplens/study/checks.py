"""Properties of maps beside a score: looks, dependence on the weights, cost."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64
from torch import Tensor, nn

from sliplens.errors import ModelError
from sliplens.explainers.attribution import Attribution
from sliplens.explainers.contract import Explainer
from sliplens.explainers.gradients import IntegratedGradients
from sliplens.explainers.poly_cam import PolyCam
from sliplens.explainers.shapley import Shapley
from sliplens.faithfulness.controls import (
    cascade,
    even_channels,
    gini,
    histogram_entropy,
    randomisation_scores,
    resolution,
    smooth_maps,
    stability,
    total_variation,
)
from sliplens.intervals import paired_difference
from sliplens.models import Network
from sliplens.progress import OnProgress, report_each
from sliplens.recordings import Dataset
from sliplens.results.faithfulness import NEW_WEIGHTS
from sliplens.results.study import (
    ChosenFrame,
    MapMeasures,
    MapQuality,
    MethodTime,
    Randomisation,
    RandomisedMethod,
    Roughness,
    Timing,
    UntrainedMaps,
)
from sliplens.runner import Part
from sliplens.study.choice import Material, MaterialStage, MethodStage, as_the_thesis_ran, trial_seed
from sliplens.study.stages import Find, join_trials, mean_of_known, trial_shards

_NORMAL_QUARTILE = 0.6745
"""Median size of a standard normal number."""


_REPEATED, _REDRAWN = 3, 2
"""Frames that are explained again for the stability of maps, and for networks with new weights."""


@dataclass(frozen=True, kw_only=True)
class _Measured:
    """Measures of a method's maps."""

    measures: MapMeasures
    roughness: Float64[np.ndarray, " frames"]
    noise_sd: float
    """Grey levels of the camera noise that was added."""


@dataclass(frozen=True, kw_only=True)
class Measuring(MethodStage[MapQuality]):
    """Resolution, smoothness, sparsity and stability of the maps, a method a shard.

    Stability is the correlation with the map of the same frame under other camera noise, as large as what differs
    between frames that follow each other, and with the map of the next frame; so the first frames are explained
    twice more.
    """

    piece = _Measured
    title = "Measuring how maps look"

    data: Dataset
    seed: int = 0

    def prepare(self) -> Find:
        """Measure the maps of a method."""
        material, explained = self.material, self.material.explained
        rng, references = np.random.default_rng(self.seed), material.references[:_REPEATED]
        noisy, following, noise_sd = _once_more(material.trained, self.data, material.chosen[:_REPEATED], rng=rng)

        def find(name: str, _: OnProgress) -> _Measured:
            def again(images: Tensor) -> Float[np.ndarray, "repeated height width"]:
                explanation = material.explainers[name](material.trained.model, images, reference=references)
                return explanation.relevance.double().cpu().numpy()

            maps = explained.saliency[name].astype(np.float64)
            before = explained.relevance[name][:_REPEATED].astype(np.float64)
            resolutions = [
                resolution(saliency, material.places(frame.id)[0])
                for saliency, frame in zip(maps, explained.frames, strict=True)
                if frame.id in material.markers
            ]
            roughness = np.array([total_variation(saliency) for saliency in maps])
            measures = MapMeasures(
                resolution=mean_of_known(np.array(resolutions, dtype=np.float64)),
                total_variation=mean_of_known(roughness),
                gini=mean_of_known(np.array([gini(saliency) for saliency in maps])),
                noise_stability=mean_of_known(stability(before, again(noisy))),
                frame_stability=mean_of_known(stability(before, again(following))),
            )
            return _Measured(measures=measures, roughness=roughness, noise_sd=noise_sd)

        return find

    def join(self, pieces: Sequence[_Measured]) -> MapQuality:
        """Measures of all methods, compared with each other."""
        explained, rng = self.material.explained, np.random.default_rng(self.seed)
        valid, clusters = dict(zip(self.material.explainers, pieces, strict=True)), explained.clusters
        return MapQuality(
            input=explained.input,
            source=explained.source,
            frames=len(explained.frames),
            repeated_frames=len(self.material.references[:_REPEATED]),
            noise_sd=pieces[0].noise_sd,
            methods={name: record.measures for name, record in valid.items()},
            # stability was tried on few frames: no interval would mean anything
            comparisons=tuple(
                Roughness(
                    first=first,
                    second=second,
                    gap=paired_difference(record.roughness, other.roughness, clusters=clusters, rng=rng),
                )
                for (first, record), (second, other) in combinations(valid.items(), 2)
            ),
        )


def _once_more(
    trained: Network, data: Dataset, chosen: Sequence[ChosenFrame], *, rng: np.random.Generator
) -> tuple[Tensor, Tensor, float]:
    """The frames with more camera noise, and the frames that follow them, as the network gets them; grey levels."""
    infos = {info.trial: info for info in data.trials}
    noisy, following, levels = [], [], []
    for rows in chosen:
        recording = data.load(infos[rows.trial], truth=False)
        frame = recording.frames[rows.frame].astype(np.float64)
        # the last frame has none after it
        other = recording.frames[rows.frame + 1 if rows.frame + 1 < len(recording) else rows.frame - 1]
        # most pixels do not move from one frame to the next: what they differ by is noise, twice
        sd = float(np.median(np.abs(frame - other)) / _NORMAL_QUARTILE / np.sqrt(2))
        levels.append(sd)
        shaken = np.clip(np.round(frame + rng.normal(0, sd, frame.shape)), 0, 255).astype(np.uint8)
        noisy.append(trained.encode(shaken[None], recording.reference))
        following.append(trained.encode(other[None], recording.reference))
    return torch.cat(noisy), torch.cat(following), float(np.mean(levels))


_LONGEST_S = 120.0
"""Of the timing of one method."""
_FEWEST_TIMED = 3


def time_explainers(material: Material, *, longest_s: float = _LONGEST_S) -> Timing:
    """Time each method on every frame of the sample, one at a time: the median and the extremes.

    The thesis's Poly-CAM is timed with all its channels, as it was run, even where a budget makes its maps. A method
    that is not through within `longest_s` is timed on fewer frames, a random part of them, and at least three.
    """
    model, device = material.trained.model, material.inputs.device.type
    order = np.random.default_rng(0).permutation(len(material.inputs)).tolist()
    frames = [(material.inputs[row, None], material.references[row, None]) for row in order]
    forward = float(np.median(_seconds(frames, lambda images, _: material.trained.predict(images), longest_s)))
    methods = {}
    for name, explainer in report_each(as_the_thesis_ran(material.explainers).items()):

        def explain(images: Tensor, reference: Tensor, explainer: Explainer = explainer) -> Tensor:
            return explainer(model, images, reference=reference).relevance

        seconds = _seconds(frames, explain, longest_s)
        median = float(np.median(seconds))
        # without the forward pass: the thesis left it out of Grad-CAM's time
        methods[name] = MethodTime(
            seconds=median,
            seconds_without_forward=max(0.0, median - forward),
            low=min(seconds),
            high=max(seconds),
            frames=len(seconds),
        )
    return Timing(
        input=material.explained.input,
        source=material.explained.source,
        device=device,
        threads=torch.get_num_threads(),
        frames=len(frames),
        forward_seconds=forward,
        methods=methods,
    )


def _seconds(
    frames: Sequence[tuple[Tensor, Tensor]], work: Callable[[Tensor, Tensor], Tensor], longest_s: float
) -> list[float]:
    """Seconds of each frame, after one run that does not count."""
    seconds: list[float] = []
    work(*frames[0])
    for images, reference in frames:
        if len(seconds) >= _FEWEST_TIMED and sum(seconds) > longest_s:
            break
        started = time.perf_counter()
        result = work(images, reference)
        if result.is_cuda:
            torch.cuda.synchronize(result.device)
        seconds.append(time.perf_counter() - started)
    return seconds


CASCADE = 3
"""Parts of the network that get new weights one after another."""
_STILL_SIMILAR = 0.5

Maps = Float[np.ndarray, "frames height width"]


@dataclass(frozen=True, kw_only=True)
class Randomising(MethodStage[Randomisation]):
    """Maps of a few frames while weights are drawn anew from the output on: how far they change, a method a shard."""

    piece = RandomisedMethod
    title = "Drawing weights anew, layer by layer"

    seed: int = 0

    def prepare(self) -> Find:
        """Explain the networks with new weights with a method."""
        material, seed = self.material, self.seed
        inputs, references = material.inputs[:_REDRAWN], material.references[:_REDRAWN]

        def find(name: str, _: OnProgress) -> RandomisedMethod:
            explainer = _shortened(material.explainers[name])

            def explain(model: nn.Module, images: Tensor) -> Maps:
                return _influence(explainer(model, images, reference=references))

            before = material.explained.influence(name)[:_REDRAWN]
            model = material.trained.model
            scores = randomisation_scores(explain, model, inputs, seed=seed, stages=CASCADE, before=before)
            return RandomisedMethod(
                layers=tuple(scores.layers),
                similarity=tuple(mean_of_known(row) for row in scores.similarity),
                complexity_rise=mean_of_known(scores.complexity_rise),
                smooth_complexity_rise=None
                if _asks_often(explainer)
                else _smooth_rise(material, explain, inputs, seed=seed),
            )

        return find

    def join(self, pieces: Sequence[RandomisedMethod]) -> Randomisation:
        """Join the records of all methods."""
        methods = dict(zip(self.material.explainers, pieces, strict=True))
        return Randomisation(
            input=self.material.explained.input,
            source=self.material.explained.source,
            frames=len(self.material.inputs[:_REDRAWN]),
            methods=methods,
            alarms=tuple(
                f"{name} still correlates by {last:.2f} with its maps when all weights are new: it shows the image "
                "rather than what the network learned"
                for name, method in methods.items()
                if (last := method.similarity[-1]) is not None and last > _STILL_SIMILAR
            ),
        )


_FEW_CHANNELS, _FEW_PAIRS = 0.05, 100


def _shortened(explainer: Explainer, *, passes_matter: bool = False) -> Explainer:
    """Without the passes that a network with new weights takes until its map is complete: a correlation needs none.

    Where passes matter, with a few of the others alone: what such a network says of each channel or marker is chance.
    """
    if isinstance(explainer, PolyCam):
        budget = min(explainer.budget, _FEW_CHANNELS) if passes_matter else explainer.budget
        return replace(explainer, likeness=None, budget=budget)
    if isinstance(explainer, IntegratedGradients):
        return replace(explainer, max_steps=explainer.steps)
    if isinstance(explainer, Shapley) and passes_matter:
        return replace(explainer, pairs=_FEW_PAIRS)
    return explainer


def _asks_often(explainer: Explainer) -> bool:
    """Return True where a map takes so many passes that no frame is explained sixteen times over."""
    return isinstance(explainer, Shapley) or (isinstance(explainer, PolyCam) and explainer.score != "thesis")


def _smooth_rise(
    material: Material, explain: Callable[[nn.Module, Tensor], Maps], inputs: Tensor, *, seed: int
) -> float | None:
    model = material.trained.model
    before, after = (
        np.array([histogram_entropy(values) for values in smooth_maps(explain, network, inputs, seed=seed)])
        for network in (model, _untrained(model, inputs, seed=seed))
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        return mean_of_known((after - before) / before)


@dataclass(frozen=True, kw_only=True)
class _TrialMaps:
    """Maps of the frames of a trial by method."""

    maps: dict[str, Float32[np.ndarray, "frames size size"]]


@dataclass(frozen=True, kw_only=True)
class Untrained(MaterialStage[UntrainedMaps]):
    """Maps of networks with all weights drawn anew by each method: controls that every map has to beat.

    Each trial, a shard, has a network of its own, so that resampled trials tell what the draw of the weights matters
    too. The controls of two methods get fewer passes than the method itself: Poly-CAM's measures 5 % of the channels
    and has no likeness, that of Shapley values draws 100 pairs of coalitions. A control with all of them may rank
    better.
    """

    piece = _TrialMaps
    title = "Explaining networks with new weights"

    seed: int = 0

    def shards(self) -> Iterator[Part]:
        """Trials, whose maps are counted."""
        return trial_shards(self.material.explained, maps=len(self.material.explainers))

    def prepare(self) -> Find:
        """Explain the frames of a trial with its network."""
        material, inputs, references = self.material, self.material.inputs, self.material.references
        controls = {name: _shortened(explainer, passes_matter=True) for name, explainer in material.explainers.items()}
        trials = material.explained.trials

        def find(item: tuple[str], _: OnProgress) -> _TrialMaps:
            frames, number = trials[item[-1]], list(trials).index(item[-1])
            model = _untrained(material.trained.model, inputs, seed=trial_seed(self.seed, number))
            maps: dict[str, list[np.ndarray]] = {}
            with suppress(ModelError):  # without layers that have a map
                maps["weights-1"] = list(even_channels(model, inputs[frames], references[frames]).cpu().numpy())
            for name, frame in report_each(list(product(material.explainers, frames))):
                record, empty = inputs[frame, None], references[frame, None]
                records = _influence(controls[name](model, record, reference=empty))
                maps.setdefault(name, []).append(records[0].astype(np.float32))
            return _TrialMaps(maps={name + NEW_WEIGHTS: np.stack(rows) for name, rows in maps.items()})

        return find

    def join(self, pieces: Sequence[_TrialMaps]) -> UntrainedMaps:
        """Maps of all frames."""
        explained = self.material.explained
        maps = join_trials(explained, [piece.maps for piece in pieces])
        return UntrainedMaps(input=explained.input, source=explained.source, maps=maps)


def _influence(explanation: Attribution) -> Maps:
    """Return the map that pixels are ranked by, towards the target of the explained network."""
    return explanation.influence.double().cpu().numpy()


def _untrained(model: nn.Module, images: Tensor, *, seed: int) -> nn.Module:
    ((_, untrained),) = cascade(model, seed=seed, stages=1, images=images)
    return untrained
