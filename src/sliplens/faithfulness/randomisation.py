"""Randomisation: an explanation of a network must change when the network's weights are drawn anew."""

import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from sliplens.faithfulness.map_quality import stability

Maps = Float[np.ndarray, "images height width"]
_BINS = 100
_BATCH_NORMS = (nn.BatchNorm1d, nn.BatchNorm2d, nn.BatchNorm3d, nn.SyncBatchNorm)


@dataclass(frozen=True, kw_only=True)
class CascadeStep:
    """A network whose last layers, down to one, have new weights."""

    layer: str
    """Name of the layer that was drawn last."""
    randomised: int
    """How many layers have new weights."""
    model: nn.Module
    """In evaluation mode; the next step changes it, so use it before you ask for that."""


def weighted_layers(model: nn.Module) -> list[str]:
    """Names of the layers that have weights of their own, from input to output as they were registered."""
    return [
        name
        for name, module in model.named_modules()
        if any(True for _ in module.parameters(recurse=False)) and hasattr(module, "reset_parameters")
    ]


def cascade(
    model: nn.Module,
    *,
    seed: int,
    stages: int | None = None,
    images: Float[Tensor, "batch 3 height width"] | None = None,
) -> Iterator[CascadeStep]:
    """Draw the weights of a copy of a network anew, layer by layer from the output to the input.

    Normalisation layers go back to their start too: to no scale, and to the statistics of some images. With statistics
    of 0 and 1, which is where they start before any training, new weights shrink what passes through them layer by
    layer, until a deep network gives one answer to every image and there is nothing to explain. Give two images at
    least; without any the statistics are 0 and 1.

    Steps are as many as `stages`, evenly spread, the last with all weights new; one a layer if None.

    References
    ----------
    Adebayo et al., *Sanity Checks for Saliency Maps* (2018): cascading randomisation.
    """
    changed = copy.deepcopy(model).eval()
    modules = dict(changed.named_modules())
    names = weighted_layers(changed)[::-1]
    count = len(names)
    stages = count if stages is None else stages
    shown = {round((stage + 1) * count / stages) - 1 for stage in range(stages)}
    for number, name in enumerate(names):
        with torch.random.fork_rng(devices=[]):
            # by name, so that a layer gets the same weights whatever came before it
            torch.manual_seed(seed + number)
            modules[name].reset_parameters()  # pyright: ignore[reportCallIssue]
        if number in shown:
            if images is not None:
                _settle(changed, [modules[new] for new in names[: number + 1]], images)
            yield CascadeStep(layer=name, randomised=number + 1, model=changed)


@torch.no_grad()
def _settle(model: nn.Module, changed: list[nn.Module], images: Tensor) -> None:
    """Give batch normalisation with new weights the statistics of some images."""
    norms = [layer for layer in changed if isinstance(layer, _BATCH_NORMS)]
    momenta = [norm.momentum for norm in norms]
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None  # the statistics of this pass alone
        norm.train()
    model(images)
    for norm, momentum in zip(norms, momenta, strict=True):
        norm.momentum = momentum
        norm.eval()


@dataclass(frozen=True, kw_only=True)
class RandomisationScores:
    """What becomes of the maps of one method as a network loses what it has learned."""

    layers: tuple[int, ...]
    """Layers with new weights, by stage."""
    similarity: Float[np.ndarray, "stages images"]
    """Pearson's correlation with the maps of the trained network; an explanation that does not fall towards 0 does not
    look at the network."""
    complexity_rise: Float[np.ndarray, " images"]
    """How much the entropy of the map's histogram rises from the trained to the wholly random network, over that of the
    trained one. A faithful map gets more complex."""


def randomisation_scores(
    explain: Callable[[nn.Module, Tensor], Maps],
    model: nn.Module,
    images: Float[Tensor, "images 3 height width"],
    *,
    seed: int,
    stages: int = 5,
    before: Maps | None = None,
) -> RandomisationScores:
    """Explain a network whose weights are drawn anew from the output on, and compare with the trained one.

    Give the maps of the trained network (`before`) where they are there already.

    References
    ----------
    Adebayo et al. (2018); Hedstroem et al., *Sanity Checks Revisited* (2024): eMPRT, the rise of complexity, and its
    histogram entropy.
    """
    if before is None:
        before = explain(model, images)
    similarity, layers, after = [], [], before
    for step in cascade(model, seed=seed, stages=stages, images=images):
        after = explain(step.model, images)
        similarity.append(stability(before, after))
        layers.append(step.randomised)
    first, last = (np.array([histogram_entropy(values) for values in maps]) for maps in (before, after))
    with np.errstate(invalid="ignore", divide="ignore"):
        rise = (last - first) / first
    return RandomisationScores(layers=tuple(layers), similarity=np.stack(similarity), complexity_rise=rise)


def histogram_entropy(values: Float[np.ndarray, "height width"]) -> float:
    """Entropy, in nats, of a map's values in 100 bins of its range: 0 for a constant map, at most log 100."""
    counts = np.histogram(values, bins=_BINS)[0]
    share = counts[counts > 0] / values.size
    return float(-(share * np.log(share)).sum()) if np.ptp(values) > 0 else 0.0


def smooth_maps(
    explain: Callable[[nn.Module, Tensor], Maps],
    model: nn.Module,
    images: Float[Tensor, "images 3 height width"],
    *,
    noise_sd: float = 0.02,
    samples: int = 16,
    seed: int = 0,
) -> Maps:
    """Mean of the maps of several noisy copies of each image: so that randomisation compares signal with signal.

    References
    ----------
    Hedstroem et al. (2024): sMPRT.
    """
    generator = torch.Generator().manual_seed(seed)
    total = np.zeros((len(images), *images.shape[-2:]))
    for _ in range(samples):
        noise = noise_sd * torch.randn(images.shape, generator=generator).to(images)
        total += explain(model, (images + noise).clamp(0, 1))
    return total / samples
