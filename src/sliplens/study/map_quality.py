"""What the eye judges of the maps of a study, as numbers."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from itertools import combinations
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sliplens.explainers import Explainer
from sliplens.faithfulness.map_quality import gini, resolution, stability, total_variation
from sliplens.files import write_json
from sliplens.intervals import paired_difference
from sliplens.models import TrainedModel
from sliplens.recordings import Dataset
from sliplens.study.choice import Pick
from sliplens.study.explaining import RESULT_FILE, mean_of_known
from sliplens.study.material import Material

_NORMAL_QUARTILE = 0.6745
"""Median size of a standard normal number."""


def check_looks(
    material: Material,
    data: Dataset,
    folder: Path,
    *,
    repeated: int = 3,
    seed: int = 0,
    on_method: Callable[[int, int], None] | None = None,
) -> None:
    """Measure resolution, smoothness, sparsity and stability of the maps.

    Stability is the correlation with the map of the same frame under other camera noise, as large as what differs
    between frames that follow each other, and with the map of the next frame.

    Parameters
    ----------
    material
        The network, its maps and methods.
    data
        Data set that the frames came from.
    folder
        Gets `result.json`; must exist.
    repeated
        How many frames, from the first on, are explained twice more.
    seed
        Of the noise.
    on_method
        Called with the methods done and their number.
    """
    explained, rng = material.explained, np.random.default_rng(seed)
    noisy, following, noise_sd = _once_more(material.trained, data, material.picks[:repeated], rng=rng)
    references = material.references[:repeated]
    told, roughness = {}, {}
    for number, (name, explainer) in enumerate(material.explainers.items(), start=1):

        def again(images: Tensor, explainer: Explainer = explainer) -> Float[np.ndarray, "repeated height width"]:
            return explainer(material.trained.model, images, reference=references).relevance.double().cpu().numpy()

        saliency = explained.saliency[name].astype(np.float64)
        before = explained.relevance[name][:repeated].astype(np.float64)
        apart = [
            resolution(one, material.places(frame.id)[0])
            for one, frame in zip(saliency, explained.frames, strict=True)
            if frame.id in material.markers
        ]
        roughness[name] = np.array([total_variation(one) for one in saliency])
        told[name] = {
            "resolution": mean_of_known(np.array(apart, dtype=np.float64)),
            "total_variation": mean_of_known(roughness[name]),
            "gini": mean_of_known(np.array([gini(one) for one in saliency])),
            "noise_stability": mean_of_known(stability(before, again(noisy))),
            "frame_stability": mean_of_known(stability(before, again(following))),
        }
        if on_method is not None:
            on_method(number, len(material.explainers))
    write_json(
        folder / RESULT_FILE,
        {
            "input": explained.input,
            "source": explained.source,
            "frames": len(explained.frames),
            "repeated_frames": len(references),
            "noise_sd": noise_sd,
            "methods": told,
            # stability was tried on few frames: no interval would mean anything
            "comparisons": [
                {"measure": "total_variation", "first": first, "second": second, **asdict(gap), "sure": gap.sure}
                for first, second in combinations(roughness, 2)
                for gap in [paired_difference(roughness[first], roughness[second], trials=material.trials, rng=rng)]
            ],
        },
    )


def _once_more(
    trained: TrainedModel, data: Dataset, picks: Sequence[Pick], *, rng: np.random.Generator
) -> tuple[Tensor, Tensor, float]:
    """The frames with more camera noise, and the frames that follow them, as the network gets them; grey levels."""
    infos = {info.trial: info for info in data.trials}
    noisy, following, levels = [], [], []
    for pick in picks:
        recording = data.load(infos[pick.trial], truth=False)
        frame = recording.frames[pick.frame].astype(np.float64)
        # the last frame has none after it
        other = recording.frames[pick.frame + 1 if pick.frame + 1 < len(recording) else pick.frame - 1]
        # most pixels do not move from one frame to the next: what they differ by is noise, twice
        sd = float(np.median(np.abs(frame - other)) / _NORMAL_QUARTILE / np.sqrt(2))
        levels.append(sd)
        shaken = np.clip(np.round(frame + rng.normal(0, sd, frame.shape)), 0, 255).astype(np.uint8)
        noisy.append(trained.encode(shaken[None], recording.reference))
        following.append(trained.encode(other[None], recording.reference))
    return torch.cat(noisy), torch.cat(following), float(np.mean(levels))
