"""Control maps that use nothing the network learned, networks with new weights, and measures of how maps look."""

import copy
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from scipy.ndimage import map_coordinates
from scipy.spatial import KDTree
from torch import Tensor, nn
from torch.nn import functional

from sliplens.errors import ModelError
from sliplens.explainers.attribution import change_of, combine, frame_of, local_change, with_reference_of
from sliplens.explainers.cam import capture, find_layers
from sliplens.intervals import paired_difference
from sliplens.results.faithfulness import CHANCE, Lead


def total_variation(saliency: Float[np.ndarray, "height width"]) -> float:
    """Mean absolute step between neighbouring pixels, over the range of the map: 1/3 for independent even noise."""
    span = float(np.ptp(saliency))
    if span == 0:
        return 0.0
    steps = (np.abs(np.diff(saliency, axis=axis)).ravel() for axis in (0, 1))
    return float(np.concatenate(list(steps)).mean()) / span


def resolution(saliency: Float[np.ndarray, "height width"], markers_px: Float[np.ndarray, "markers 2"]) -> float:
    """Depth of the valley between neighbouring markers (x, y) over the lower of their peaks, from 0 to 1.

    Pairs of which one has no relevance are left out; NaN if there is no other.
    """
    _, nearest = KDTree(markers_px).query(markers_px, k=2)
    pairs = {(min(first, second), max(first, second)) for first, second in np.asarray(nearest).tolist()}
    depths = []
    for first, second in sorted(pairs):
        along = np.linspace(0, 1, 33)[:, None]
        x, y = ((1 - along) * markers_px[first] + along * markers_px[second]).T
        values = map_coordinates(saliency, [y, x], order=1, mode="nearest")
        third = len(along) // 3
        peaks = (values[: third + 1].max(), values[-third - 1 :].max())
        if min(peaks) > 0:
            depths.append(1 - float(values[third:-third].min()) / float(min(peaks)))
    return float(np.clip(np.mean(depths), 0, 1)) if depths else float("nan")


def infidelity(
    predict: Callable[[Tensor], Tensor],
    images: Float[Tensor, "images colours height width"],
    references: Float[Tensor, "images colours height width"],
    relevance: Float[Tensor, "images height width"],
    *,
    samples: int = 20,
) -> Float[np.ndarray, " images"]:
    """Root of Captum's infidelity: error of the change that a map predicts where half of the pixels are replaced.

    The pixels, drawn again for each sample, become those of the reference; their relevance should sum to the change.

    Yeh et al., *On the (in)fidelity and sensitivity of explanations*, NeurIPS 2019, definition 2.1.
    """
    from captum import metrics  # noqa: PLC0415 (takes a second)

    generator, shares = torch.Generator().manual_seed(0), torch.zeros_like(images)
    frame_of(shares).copy_((relevance.to(images) / 3)[:, None].expand_as(frame_of(images)))

    def replace_half(expanded: Tensor) -> tuple[Tensor, Tensor]:
        gone = (torch.rand(len(expanded), 1, *images.shape[-2:], generator=generator) < 0.5).to(images)
        return gone.expand_as(expanded), expanded - gone * (images - references).repeat_interleave(samples, dim=0)

    squares = metrics.infidelity(predict, replace_half, images, shares, n_perturb_samples=samples)
    return squares.cpu().double().sqrt().numpy()


def max_sensitivity(
    explain: Callable[[Tensor], Float[Tensor, "batch height width"]],
    images: Float[Tensor, "images colours height width"],
    *,
    radius: float = 0.02,
    samples: int = 2,
) -> Float[np.ndarray, " images"]:
    """Largest change of a map under noise of up to a radius on the image, relative to the map's norm; by Captum.

    Yeh et al., *On the (in)fidelity and sensitivity of explanations*, NeurIPS 2019, definition 3.1.
    """
    from captum import metrics  # noqa: PLC0415 (takes a second)

    generator = torch.Generator().manual_seed(0)

    def disturb(inputs: Tensor) -> Tensor:
        noise = radius * (2 * torch.rand(frame_of(inputs).shape, generator=generator) - 1)
        return with_reference_of((frame_of(inputs) + noise.to(inputs)).clamp(0, 1), inputs)

    def explain_alike(inputs: Tensor | tuple[Tensor]) -> Any:
        # Captum gives the images themselves as a tuple, and wants the same of their maps
        return explain(inputs) if isinstance(inputs, Tensor) else (explain(inputs[0]),)

    largest = metrics.sensitivity_max(explain_alike, images, perturb_func=disturb, n_perturb_samples=samples)
    return largest.cpu().double().numpy()


def relevance_mass(saliency: Float[np.ndarray, "_ _"], truth: Bool[np.ndarray, "height width"]) -> float:
    """Share of a map's sum that lies inside the truth; NaN for a map that is zero.

    Arras, Osman and Samek, *CLEVR-XAI* (2022): relevance mass accuracy.
    """
    total = float(saliency.sum())
    return float(saliency[truth].sum()) / total if total > 0 else float("nan")


Images = Float[Tensor, "images colours height width"]
ControlMaps = Float[Tensor, "images height width"]
Maps = Float[np.ndarray, "images height width"]


def edges(images: Images) -> ControlMaps:
    """Strength of the edges of the frame: length of Sobel's gradient, mean over the colours."""
    across = torch.tensor([[-1.0, 0.0, 1.0], [-2.0, 0.0, 2.0], [-1.0, 0.0, 1.0]]) / 8
    kernels = torch.stack([across, across.T]).to(images)[:, None].repeat(3, 1, 1, 1)
    padded = functional.pad(frame_of(images), (1, 1, 1, 1), mode="replicate")
    slopes = functional.conv2d(padded, kernels, groups=3).unflatten(1, (3, 2))
    return slopes.square().sum(dim=2).sqrt().mean(dim=1)


def relative_change(images: Images, references: Images) -> ControlMaps:
    """|x - b| over a marker's width, divided by that over four: where more changed than thereabouts.

    Carandini and Heeger, *Normalization as a canonical neural computation* (2012).
    """
    pairs = list(zip(images, references, strict=True))
    near, around = (torch.stack([local_change(*pair, widths=widths) for pair in pairs]) for widths in (1, 4))
    return near / (around + 0.001)  # a quarter of a grey level: where nothing changed there is nothing to compare


@torch.no_grad()
def even_channels(model: nn.Module, images: Images, references: Images) -> ControlMaps:
    """Compute Poly-CAM's map with every channel's weight 1, whatever its effect on the prediction."""
    names, size = list(find_layers(model, images)), (images.shape[-2], images.shape[-1])
    with capture(model, names) as outputs:
        model(images)
    maps = []
    for index, pair in enumerate(zip(images, references, strict=True)):
        activations = [outputs[name][index] for name in names]
        even = [torch.ones_like(maps[:, 0, 0]) for maps in activations]
        maps.append(combine(activations, even, size=size) * local_change(*pair))
    return torch.stack(maps)


def centre(images: Images) -> ControlMaps:
    """A Gaussian about the middle, of a quarter of the image's side: a camera looks at what matters."""
    height, width = images.shape[-2:]
    down, across = (torch.linspace(-0.5, 0.5, side, device=images.device) for side in (height, width))
    bump = torch.exp(-(down[:, None].square() + across.square()) / (2 * 0.25**2))
    return bump.to(images.dtype).expand(len(images), height, width)


def control_maps(model: nn.Module, images: Images, references: Images) -> dict[str, Maps]:
    """Compute maps that use nothing the network learned, by name, of images and their baselines.

    Beside these stand random orders, and each explainer on networks whose weights were drawn again. A network without
    layers that have a map has no `weights-1`.

    Clark et al., *XAI-TRIS* (2024), edge filters; Adebayo et al., *Sanity Checks for Saliency Maps* (2018).
    """
    maps = {
        "change": change_of(images, references),  # all there is to explain, before any network saw it
        "local-change": relative_change(images, references),
        "centre": centre(images),
        "edges": edges(images),
    }
    with suppress(ModelError):
        maps["weights-1"] = even_channels(model, images, references)
    return {name: values.cpu().double().numpy() for name, values in maps.items()}


def lead_over_controls(
    scores: Float[np.ndarray, " frames"],
    controls: Mapping[str, Float[np.ndarray, " frames"]],
    *,
    clusters: Iterable[Shaped[np.ndarray, " frames"]],
    rng: np.random.Generator,
) -> Lead:
    """Compute the mean of a score of frames less that of the strongest control, with a 95 % interval.

    Each end is the lowest of those over all controls, chance (0) among them: a lead is sure only where the method is
    ahead of each for sure, which needs no correction. The upper ends are those of as many comparisons as controls.

    Berger, *Multiparameter hypothesis testing and acceptance sampling* (1982): intersection-union tests, and the
    union-intersection tests that Bonferroni's inequality bounds.
    """
    others = {**controls, CHANCE: np.zeros(len(scores))}
    levels = list(clusters)
    gaps = {
        name: paired_difference(scores, other, clusters=levels, rng=rng, comparisons=(1, len(others)))
        for name, other in others.items()
    }
    control = min(gaps, key=lambda name: gaps[name].estimate)
    ends = ([getattr(gap, end) for gap in gaps.values()] for end in ("low", "high"))
    low, high = (None if None in over_all else min(over_all) for over_all in ends)
    return Lead(control=control, gap=replace(gaps[control], low=low, high=high))


def cascade(model: nn.Module, *, seed: int, stages: int, images: Images) -> Iterator[tuple[int, nn.Module]]:
    """Draw the weights of a copy of a network again, layer by layer from the output to the input.

    Yield, at so many stages, evenly spread, how many layers have new weights, and the network; the next stage changes
    it. Normalisation gets the statistics of the images, two at least, or every image would get one answer.

    Adebayo et al., *Sanity Checks for Saliency Maps* (2018): cascading randomisation.
    """
    changed = copy.deepcopy(model).eval()
    weighted = [
        module
        for module in changed.modules()
        if hasattr(module, "reset_parameters") and next(module.parameters(recurse=False), None) is not None
    ][::-1]
    if not weighted:
        raise ModelError("no layer has reset_parameters, by which its weights are drawn again; add it to your layers")
    ends = {round((stage + 1) * len(weighted) / stages) for stage in range(stages)}
    for count, module in enumerate(weighted, start=1):
        with torch.random.fork_rng(devices=[]):
            # by its place, so that a layer gets the same weights whatever came before it; no network has 1000 layers
            torch.manual_seed(1000 * seed + count - 1)
            module.reset_parameters()  # pyright: ignore[reportCallIssue]
        if count in ends:
            norms = [layer for layer in weighted[:count] if isinstance(layer, nn.modules.batchnorm._BatchNorm)]
            momenta = [norm.momentum for norm in norms]
            for norm in norms:
                norm.reset_running_stats()
                norm.momentum = None  # the statistics of this pass alone
                norm.train()
            with torch.no_grad():
                changed(images)
            for norm, momentum in zip(norms, momenta, strict=True):
                norm.momentum = momentum
                norm.eval()
            yield count, changed
