"""What the eye judges of the maps of a study, as numbers."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sliplens.explainers import Explainer
from sliplens.faithfulness.map_quality import gini, resolution, stability, total_variation
from sliplens.intervals import paired_difference
from sliplens.models import Run
from sliplens.progress import OnProgress, counted
from sliplens.recordings import Dataset
from sliplens.results.study import ChosenFrame, MapMeasures, MapQuality, Roughness
from sliplens.study.explaining import mean_of_known
from sliplens.study.material import Material

_NORMAL_QUARTILE = 0.6745
"""Median size of a standard normal number."""


def measure_maps(
    material: Material, data: Dataset, *, repeated: int = 3, seed: int = 0, on_progress: OnProgress | None = None
) -> MapQuality:
    """Measure resolution, smoothness, sparsity and stability of the maps.

    Stability is the correlation with the map of the same frame under other camera noise, as large as what differs
    between frames that follow each other, and with the map of the next frame; so the first `repeated` frames are
    explained twice more.
    """
    explained, rng = material.explained, np.random.default_rng(seed)
    noisy, following, noise_sd = _once_more(material.trained, data, material.chosen[:repeated], rng=rng)
    references = material.references[:repeated]
    methods, roughness = {}, {}
    for name, explainer in counted(material.explainers.items(), on_progress):

        def again(images: Tensor, explainer: Explainer = explainer) -> Float[np.ndarray, "repeated height width"]:
            return explainer(material.trained.model, images, reference=references).relevance.double().cpu().numpy()

        maps = explained.saliency[name].astype(np.float64)
        before = explained.relevance[name][:repeated].astype(np.float64)
        resolutions = [
            resolution(saliency, material.places(frame.id)[0])
            for saliency, frame in zip(maps, explained.frames, strict=True)
            if frame.id in material.markers
        ]
        roughness[name] = np.array([total_variation(saliency) for saliency in maps])
        methods[name] = MapMeasures(
            resolution=mean_of_known(np.array(resolutions, dtype=np.float64)),
            total_variation=mean_of_known(roughness[name]),
            gini=mean_of_known(np.array([gini(saliency) for saliency in maps])),
            noise_stability=mean_of_known(stability(before, again(noisy))),
            frame_stability=mean_of_known(stability(before, again(following))),
        )
    return MapQuality(
        input=explained.input,
        source=explained.source,
        frames=len(explained.frames),
        repeated_frames=len(references),
        noise_sd=noise_sd,
        methods=methods,
        # stability was tried on few frames: no interval would mean anything
        comparisons=tuple(
            Roughness(
                first=first,
                second=second,
                gap=paired_difference(roughness[first], roughness[second], trials=material.trials, rng=rng),
            )
            for first, second in combinations(roughness, 2)
        ),
    )


def _once_more(
    trained: Run, data: Dataset, chosen: Sequence[ChosenFrame], *, rng: np.random.Generator
) -> tuple[Tensor, Tensor, float]:
    """The frames with more camera noise, and the frames that follow them, as the network gets them; grey levels."""
    infos = {info.trial: info for info in data.trials}
    noisy, following, levels = [], [], []
    for own in chosen:
        recording = data.load(infos[own.trial], truth=False)
        frame = recording.frames[own.frame].astype(np.float64)
        # the last frame has none after it
        other = recording.frames[own.frame + 1 if own.frame + 1 < len(recording) else own.frame - 1]
        # most pixels do not move from one frame to the next: what they differ by is noise, twice
        sd = float(np.median(np.abs(frame - other)) / _NORMAL_QUARTILE / np.sqrt(2))
        levels.append(sd)
        shaken = np.clip(np.round(frame + rng.normal(0, sd, frame.shape)), 0, 255).astype(np.uint8)
        noisy.append(trained.encode(shaken[None], recording.reference))
        following.append(trained.encode(other[None], recording.reference))
    return torch.cat(noisy), torch.cat(following), float(np.mean(levels))
