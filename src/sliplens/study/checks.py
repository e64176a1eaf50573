"""Properties of maps beside a score: looks, dependence on the weights, cost."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from sliplens.errors import ModelError
from sliplens.explainers.contract import Explainer
from sliplens.explainers.gradients import IntegratedGradients
from sliplens.explainers.poly_cam import PolyCam
from sliplens.explainers.shapley import Shapley
from sliplens.faithfulness.controls import cascade, even_channels, resolution, stability, total_variation
from sliplens.intervals import paired_difference
from sliplens.models import Network
from sliplens.progress import report_each
from sliplens.results.faithfulness import NEW_WEIGHTS, MethodGap
from sliplens.results.study import (
    MapMeasures,
    MapQuality,
    MethodTime,
    Randomisation,
    RandomisedMethod,
    Timing,
    UntrainedMaps,
)
from sliplens.runner import Part, part
from sliplens.study.choice import THESIS_POLY_CAM, Material, trial_seed
from sliplens.study.stages import MakeRecord, Result, Stage, join_trials, mean_of_known, trial_parts

CASCADE = 3
"""Parts of the network that get new weights one after another."""
_REDRAWN = 2
"""Frames that are explained with new weights."""
_STILL_SIMILAR = 0.5
_FEW_CHANNELS, _FEW_PAIRS = 0.05, 100


def measure_maps(material: Material, *, seed: int = 0) -> MapQuality:
    """Measure resolution, smoothness of the maps, and compare the methods' smoothness."""
    explained, rng = material.explained, np.random.default_rng(seed)
    measures, roughness = {}, {}
    for method in report_each(list(material.explainers)):
        maps = explained.saliency[method].astype(np.float64)
        resolutions = [
            resolution(saliency, material.places(frame.id)[0])
            for saliency, frame in zip(maps, explained.frames, strict=True)
            if frame.id in material.markers
        ]
        roughness[method] = np.array([total_variation(saliency) for saliency in maps])
        measures[method] = MapMeasures(
            resolution=mean_of_known(np.array(resolutions, dtype=np.float64)),
            total_variation=mean_of_known(roughness[method]),
        )
    return MapQuality(
        input=explained.input,
        source=explained.source,
        frames=len(explained.frames),
        methods=measures,
        comparisons=tuple(
            MethodGap(
                first=first,
                second=second,
                gap=paired_difference(roughness[first], roughness[second], clusters=explained.clusters, rng=rng),
            )
            for first, second in combinations(roughness, 2)
        ),
    )


_LONGEST_S = 120.0
"""Time limit of the timing of one method."""
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
    for name, explainer in report_each(material.explainers.items()):
        if name == THESIS_POLY_CAM and isinstance(explainer, PolyCam):
            explainer = replace(explainer, budget=1.0)  # noqa: PLW2901

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


@dataclass(frozen=True, kw_only=True)
class _MaterialStage(Stage[Result]):
    material: Material
    seed: int = 0

    @property
    def trained(self) -> Network:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Network that was explained."""
        return self.material.trained


@dataclass(frozen=True, kw_only=True)
class Randomising(_MaterialStage[Randomisation]):
    """Maps of a few frames while weights are drawn anew from the output on: how far they change; a part is a method.

    Adebayo et al., *Sanity Checks for Saliency Maps* (2018).
    """

    record = RandomisedMethod
    title = "Drawing weights anew, layer by layer"

    def parts(self) -> Iterator[Part]:
        """Yield all methods."""
        for method in self.material.explainers:
            yield part(method, trial=method, frames=1, recipe="method", content="")

    def prepare(self) -> MakeRecord:
        """Return the function that explains the networks with new weights with a method."""
        material, model = self.material, self.material.trained.model
        inputs, references = material.inputs[:_REDRAWN], material.references[:_REDRAWN]

        def randomise(method: str) -> RandomisedMethod:
            explainer, before = _shortened(material.explainers[method]), material.explained.influence(method)[:_REDRAWN]
            layers, similarity = [], []
            for count, network in cascade(model, seed=self.seed, stages=CASCADE, images=inputs):
                after = explainer(network, inputs, reference=references).influence.cpu().double().numpy()
                layers.append(count)
                similarity.append(mean_of_known(stability(before, after)))
            return RandomisedMethod(layers=tuple(layers), similarity=tuple(similarity))

        return randomise

    def join(self, records: Sequence[RandomisedMethod]) -> Randomisation:
        """Join the records of all methods."""
        methods = dict(zip(self.material.explainers, records, strict=True))
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


def _shortened(explainer: Explainer, *, passes_matter: bool = False) -> Explainer:
    """Spare passes that a map of new weights does not need; where passes matter, with few channels or pairs alone."""
    if isinstance(explainer, PolyCam):
        budget = min(explainer.budget, _FEW_CHANNELS) if passes_matter else explainer.budget
        return replace(explainer, likeness=None, budget=budget)
    if isinstance(explainer, IntegratedGradients):
        return replace(explainer, max_steps=explainer.steps)
    if isinstance(explainer, Shapley) and passes_matter:
        return replace(explainer, pairs=_FEW_PAIRS)
    return explainer


@dataclass(frozen=True, kw_only=True)
class _TrialMaps:
    """Maps of the frames of a trial by method."""

    maps: dict[str, Float32[np.ndarray, "frames size size"]]


@dataclass(frozen=True, kw_only=True)
class Untrained(_MaterialStage[UntrainedMaps]):
    """Maps of networks with all weights drawn anew by each method: controls that every map has to beat.

    Each trial, a part, has a network of its own, so that resampled trials tell what the draw of the weights matters
    too. Poly-CAM measures 5 % of the channels here and has no likeness, Shapley values draw 100 pairs of coalitions.
    """

    record = _TrialMaps
    title = "Explaining networks with new weights"

    def parts(self) -> Iterator[Part]:
        """Yield the trials, whose maps are counted."""
        return trial_parts(self.material.explained, maps=len(self.material.explainers))

    def prepare(self) -> MakeRecord:
        """Return the function that explains the frames of a trial with its network."""
        material, inputs, references = self.material, self.material.inputs, self.material.references
        controls = {name: _shortened(explainer, passes_matter=True) for name, explainer in material.explainers.items()}
        trials = material.explained.trials

        def explain(item: tuple[str]) -> _TrialMaps:
            frames, seed = trials[item[-1]], trial_seed(self.seed, list(trials).index(item[-1]))
            ((_, model),) = cascade(material.trained.model, seed=seed, stages=1, images=inputs)
            maps: dict[str, list[np.ndarray]] = {}
            with suppress(ModelError):  # without layers that have a map
                maps["weights-1"] = list(even_channels(model, inputs[frames], references[frames]).cpu().numpy())
            for name, frame in report_each(list(product(material.explainers, frames))):
                attribution = controls[name](model, inputs[frame, None], reference=references[frame, None])
                maps.setdefault(name, []).append(attribution.influence[0].float().cpu().numpy())
            return _TrialMaps(maps={name + NEW_WEIGHTS: np.stack(rows) for name, rows in maps.items()})

        return explain

    def join(self, records: Sequence[_TrialMaps]) -> UntrainedMaps:
        """Join the maps of all frames."""
        explained = self.material.explained
        maps = join_trials(explained, [record.maps for record in records])
        return UntrainedMaps(input=explained.input, source=explained.source, maps=maps)
