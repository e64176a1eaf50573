"""Properties of maps beside a score: looks, dependence on the weights, cost."""

import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
import torch
from torch import Tensor

from sliplens.errors import ModelError
from sliplens.explainers.contract import Explainer
from sliplens.explainers.gradients import IntegratedGradients
from sliplens.explainers.poly_cam import PolyCam
from sliplens.explainers.shapley import Shapley
from sliplens.faithfulness.controls import (
    cascade,
    even_channels,
    infidelity,
    max_sensitivity,
    resolution,
    stability,
    total_variation,
)
from sliplens.intervals import paired_difference
from sliplens.models import Network
from sliplens.progress import report_each
from sliplens.results.faithfulness import NEW_WEIGHTS, MethodGap
from sliplens.results.study import (
    MapMeasures,
    MapQuality,
    UntrainedMaps,
)
from sliplens.runner import Part
from sliplens.study.choice import THESIS_POLY_CAM, Material, trial_seed
from sliplens.study.stages import MakeRecord, Stage, TrialArrays, join_trials, mean_of_known, trial_parts

CASCADE = 3
"""Parts of the network that get new weights one after another."""
_REDRAWN = 2
"""Frames that are explained with new weights."""
_STILL_SIMILAR = 0.5
_FEW_CHANNELS, _FEW_PAIRS = 0.05, 100


def measure_maps(material: Material, *, seed: int = 0) -> MapQuality:
    """Measure resolution, smoothness, infidelity and sensitivity of the maps, and compare the methods' smoothness."""
    explained, rng, model = material.explained, np.random.default_rng(seed), material.trained.model
    few, compared = material.inputs[:_REDRAWN], material.references[:_REDRAWN]
    measures, roughness = {}, {}
    for method in report_each(list(material.explainers)):
        maps = explained.saliency[method].astype(np.float64)
        resolutions = [
            resolution(saliency, material.places(frame.id)[0])
            for saliency, frame in zip(maps, explained.frames, strict=True)
            if frame.id in material.markers
        ]
        roughness[method] = np.array([total_variation(saliency) for saliency in maps])
        explainer = _shortened(material.explainers[method], passes_matter=True)

        def explain(images: Tensor, explainer: Explainer = explainer) -> Tensor:
            references = compared.repeat_interleave(len(images) // len(compared), dim=0)
            return explainer(model, images, reference=references).relevance

        relevance = torch.from_numpy(explained.relevance[method][:_REDRAWN])
        errors = infidelity(lambda images: model(images).flatten(), few, compared, relevance)
        measures[method] = MapMeasures(
            resolution=mean_of_known(np.array(resolutions, dtype=np.float64)),
            total_variation=mean_of_known(roughness[method]),
            infidelity=mean_of_known(errors),
            max_sensitivity=mean_of_known(max_sensitivity(explain, few)),
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


_TIMED = 10


def time_explainers(material: Material) -> MapQuality:
    """Time each method on a few frames, one at a time, after a warm-up: the median.

    The thesis's Poly-CAM is timed with all its channels, as it was run, even where a budget makes its maps.
    """
    frames = list(zip(material.inputs[:_TIMED].split(1), material.references[:_TIMED].split(1), strict=True))
    methods = {}
    for name, explainer in report_each(material.explainers.items()):
        if name == THESIS_POLY_CAM and isinstance(explainer, PolyCam):
            explainer = replace(explainer, budget=1.0)  # noqa: PLW2901
        seconds = []
        for image, reference in [frames[0], *frames]:
            started = time.perf_counter()
            explainer(material.trained.model, image, reference=reference).relevance.cpu()  # waits for the device
            seconds.append(time.perf_counter() - started)
        methods[name] = MapMeasures(seconds=float(np.median(seconds[1:])))
    return MapQuality(
        input=material.explained.input,
        source=material.explained.source,
        frames=len(frames),
        methods=methods,
    )


def randomise_weights(material: Material, *, seed: int = 0) -> MapQuality:
    """Measure how far maps of a few frames change while weights are drawn anew from the output on.

    Adebayo et al., *Sanity Checks for Saliency Maps* (2018).
    """
    inputs, references = material.inputs[:_REDRAWN], material.references[:_REDRAWN]
    methods = {}
    for name in report_each(list(material.explainers)):
        explainer, before = _shortened(material.explainers[name]), material.explained.influence(name)[:_REDRAWN]
        layers, similarity = [], []
        for count, network in cascade(material.trained.model, seed=seed, stages=CASCADE, images=inputs):
            after = explainer(network, inputs, reference=references).influence.cpu().double().numpy()
            layers.append(count)
            similarity.append(mean_of_known(stability(before, after)))
        methods[name] = MapMeasures(layers=tuple(layers), similarity=tuple(similarity))
    return MapQuality(
        input=material.explained.input,
        source=material.explained.source,
        frames=len(inputs),
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
class Untrained(Stage[UntrainedMaps]):
    """Maps of networks with all weights drawn anew by each method: controls that every map has to beat.

    Each trial, a part, has a network of its own, so that resampled trials tell what the draw of the weights matters
    too. Poly-CAM measures 5 % of the channels here and has no likeness, Shapley values draw 100 pairs of coalitions.
    """

    record = TrialArrays
    title = "Explaining networks with new weights"

    material: Material
    seed: int = 0

    @property
    def trained(self) -> Network:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Network that was explained."""
        return self.material.trained

    def parts(self) -> Iterator[Part]:
        """Yield the trials, whose maps are counted."""
        return trial_parts(self.material.explained, maps=len(self.material.explainers))

    def prepare(self) -> MakeRecord:
        """Return the function that explains the frames of a trial with its network."""
        material, inputs, references = self.material, self.material.inputs, self.material.references
        controls = {name: _shortened(explainer, passes_matter=True) for name, explainer in material.explainers.items()}
        trials = material.explained.trials

        def explain(item: tuple[str]) -> TrialArrays:
            frames, seed = trials[item[-1]], trial_seed(self.seed, list(trials).index(item[-1]))
            ((_, model),) = cascade(material.trained.model, seed=seed, stages=1, images=inputs)
            maps: dict[str, list[np.ndarray]] = {}
            with suppress(ModelError):  # without layers that have a map
                maps["weights-1"] = list(even_channels(model, inputs[frames], references[frames]).cpu().numpy())
            for name, frame in report_each(list(product(material.explainers, frames))):
                attribution = controls[name](model, inputs[frame, None], reference=references[frame, None])
                maps.setdefault(name, []).append(attribution.influence[0].float().cpu().numpy())
            return TrialArrays(arrays={name + NEW_WEIGHTS: np.stack(rows) for name, rows in maps.items()})

        return explain

    def join(self, records: Sequence[TrialArrays]) -> UntrainedMaps:
        """Join the maps of all frames."""
        explained = self.material.explained
        maps = join_trials(explained, [record.arrays for record in records])
        return UntrainedMaps(input=explained.input, source=explained.source, maps=maps)
