"""Channels of Poly-CAM: the region of each, its effect on the prediction, and the map that weighted channels make."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from sliplens.explainers.activations import Layer, find_layers, find_published_layers
from sliplens.explainers.maps import FLOOR, resize, to_masks
from sliplens.models.engines import Engine


@dataclass(frozen=True, kw_only=True)
class Variant:
    """Which of the two points of a channel's effect are measured."""

    keep: bool
    """Predict the image with only the channel's region kept."""
    remove: bool
    """Predict the image with the channel's region removed."""

    @property
    def passes(self) -> int:
        """Masked images a channel."""
        return self.keep + self.remove


VARIANTS = {
    "+": Variant(keep=True, remove=False),
    "-": Variant(keep=False, remove=True),
    "+/-": Variant(keep=True, remove=True),
}


Points: TypeAlias = Float[Tensor, "points channels"]
"""Predictions of the masked images of each channel in margin units, the kept and the removed ones; see `measure`."""


def regression_support(image: Tensor, empty: Tensor, points: Points, *, variant: Variant) -> Tensor:
    """Share of f(x) - f(b) that each channel's region supports: 0 for the empty mask, 1 for the full one.

    The mean of what the region adds to the reference, f(b + (x - b) M) - f(b), and of what the image loses without it,
    f(x) - f(b + (x - b)(1 - M)), or the one of them that was measured, over f(x) - f(b); 0 where that is 0. Unlike a
    softmax or sigmoid of the output it is signed and does not saturate. The division changes no map, since each is
    normalised, and keeps the numbers clear of the floor of 1e-12 in `combine`.
    """
    effects = [points[0] - empty] * variant.keep + [image - points[-1]] * variant.remove
    effect, change = torch.stack(effects).mean(dim=0), image - empty
    return effect / change if change else torch.zeros_like(effect)


def thesis_support(image: Tensor, _empty: Tensor, points: Points, *, variant: Variant) -> Tensor:
    """What the public code makes the weights of, for a network with one output.

    The score is a sigmoid s of the percentage. PCAM+: s(kept); PCAM-: s(image) - s(removed); PCAM+/-:
    s(kept) + s(image) - s(removed). In float32 s is 1 from 17 % on, so that there the weights of PCAM+/- are all
    1 and those of PCAM- all 0.

    References
    ----------
    Englebert, Cornu and De Vleeschouwer, *Poly-CAM*, ICPR 2022, eqs. 8 to 10, and its public code for the sigmoid of
    a single output.
    """
    image, points = torch.sigmoid(100 * image), torch.sigmoid(100 * points)
    return torch.stack([points[0]] * variant.keep + [image - points[-1]] * variant.remove).sum(dim=0)


@dataclass(frozen=True, kw_only=True)
class Score:
    """A way to weigh channels, with what belongs to it."""

    support: Callable[..., Float[Tensor, " channels"]]
    """How far each channel speaks for the prediction; below 0 it speaks against it, and gets no weight."""
    layers: Callable[[nn.Module, Tensor], tuple[Layer, ...]]
    """Layers of a network, fine to coarse or as they run, found with one image."""
    as_published: bool
    """Masks as the public code makes them, blended with black; otherwise empty for what is nowhere active, blended
    with the reference."""


SCORES = {
    "regression": Score(support=regression_support, layers=find_layers, as_published=False),
    "thesis": Score(support=thesis_support, layers=find_published_layers, as_published=True),
}


def layer_map(
    activations: Float[Tensor, "channels rows columns"], weights: Float[Tensor, " channels"]
) -> Float[Tensor, "rows columns"]:
    """Sum of weight x activation over the channels, above zero."""
    return torch.relu(torch.einsum("c,chw->hw", weights, activations))


def combine(
    activations: Sequence[Float[Tensor, "_channels _rows _columns"]],
    weights: Sequence[Float[Tensor, " _channels"]],
    *,
    size: tuple[int, int],
) -> list[Float[Tensor, "height width"]]:
    """Turn the channel weights of every layer into one saliency a layer, in [0, 1], resized to the image.

    From the last layer to the first a layer's map is divided by itself resized to the coarser result and back (LNorm),
    then multiplied by that result; a level's saliency is this product normalised like a mask.

    References
    ----------
    Englebert, Cornu and De Vleeschouwer, *Poly-CAM*, ICPR 2022, section III, and its public code.
    """
    saliencies = []
    coarser: Tensor | None = None
    for activation, weight in zip(reversed(activations), reversed(weights), strict=True):
        product = layer_map(activation, weight)
        if coarser is not None:
            here = product.shape[-2], product.shape[-1]
            smooth = resize(resize(product, (coarser.shape[-2], coarser.shape[-1])), here)
            product = torch.relu(product / smooth.clamp_min(FLOOR) * resize(coarser, here))
        saliencies.append(resize(to_masks(product), size))
        coarser = product
    return saliencies[::-1]


def scale_to(
    saliencies: Float[Tensor, "batch height width"], *, total: Float[Tensor, " batch"]
) -> Float[Tensor, "batch height width"]:
    """Scale each map so that it adds up to its total; a map of zeros stays."""
    sums = saliencies.sum(dim=(1, 2))
    factor = torch.where(sums == 0, torch.zeros_like(sums), total / sums)
    return saliencies * factor[:, None, None]


@dataclass(frozen=True, kw_only=True)
class Regions:
    """One image and the regions of all its channels, those of every layer in a row."""

    image: Float[Tensor, "3 height width"]
    """Image x."""
    empty: Float[Tensor, "3 height width"]
    """What is shown outside a region, b."""
    masks: tuple[Float[Tensor, "_channels _rows _columns"], ...]
    """Masks M in [0, 1] at the resolution of each layer; see `to_masks`."""

    @property
    def layer_sizes(self) -> list[int]:
        """Channels of each layer."""
        return [len(masks) for masks in self.masks]

    def active(self) -> Int[Tensor, " some"]:
        """Channels whose mask is not empty; an empty one keeps nothing and removes nothing. A mask of NaN is active."""
        return torch.nonzero(torch.cat([(masks != 0).flatten(1).any(dim=1) for masks in self.masks])).flatten()

    def at_image_size(self, channels: Int[Tensor, " some"]) -> Float[Tensor, "some height width"]:
        """Masks of some channels, in rising order, resized to the image."""
        size = self.image.shape[-2], self.image.shape[-1]
        parts, first = [], 0
        for masks in self.masks:
            inside = channels[(channels >= first) & (channels < first + len(masks))] - first
            if len(inside):
                parts.append(resize(masks[inside], size))
            first += len(masks)
        return torch.cat(parts)

    def blends(self, channels: Int[Tensor, " some"], *, variant: Variant) -> Float[Tensor, "images 3 height width"]:
        """Masked images of some channels, in rising order: all that are kept, then all that are removed."""
        content = (self.image - self.empty) * self.at_image_size(channels)[:, None]
        return torch.cat([self.empty + content] * variant.keep + [self.image - content] * variant.remove)


def measure(
    regions: Regions,
    channels: Int[Tensor, " some"],
    *,
    engine: Engine,
    variant: Variant,
    on_channels: Callable[[int], None],
) -> Float[Tensor, "points some"]:
    """Predictions of the masked images of some channels, in rising order; memory is bounded by the engine's batch.

    One row for what is kept and one for what is removed, as far as the variant has them.
    """
    # of no channels at all, as where nothing differs from the reference, there is still one empty part
    parts = channels.split(max(1, engine.batch_size // variant.passes)) if len(channels) else ()

    def batches() -> Iterator[Tensor]:
        for part in parts:
            # in pieces, where even one channel's images are more than a batch
            yield from regions.blends(part, variant=variant).split(engine.batch_size)

    waiting, points = list(parts), []
    pieces: list[Tensor] = []
    for predictions in engine.run(batches()):
        pieces.append(predictions)
        if sum(map(len, pieces)) == variant.passes * len(waiting[0]):
            points.append(torch.cat(pieces).reshape(variant.passes, -1))
            on_channels(len(waiting.pop(0)))
            pieces = []
    return torch.cat(points, dim=1) if points else regions.image.new_zeros(variant.passes, 0)
