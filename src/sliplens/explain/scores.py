"""How Poly-CAM turns the predictions of masked images into the weight of a channel."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sliplens.explain.layers import Layer, find_layers
from sliplens.explain.thesis import find_published_layers, thesis_support


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


@dataclass(frozen=True, kw_only=True)
class Predictions:
    """Predictions of one image and of its masked versions, in margin units."""

    image: Float[Tensor, ""]
    """f(x)."""
    empty: Float[Tensor, ""]
    """f(b), the image with everything removed."""
    kept: Float[Tensor, " channels"] | None
    """f(b + (x - b) M) for each channel's mask M, or None where the variant has no such pass."""
    removed: Float[Tensor, " channels"] | None
    """f(b + (x - b)(1 - M)), or None."""


def channel_effects(predictions: Predictions) -> Float[Tensor, " channels"]:
    """Effect of each channel's region in margin units: 0 for the empty mask, f(x) - f(b) for the full one.

    The mean of what the region adds to the reference, f(b + (x - b) M) - f(b), and of what the image loses without it,
    f(x) - f(b + (x - b)(1 - M)), or the one of them that was measured. Unlike a softmax or sigmoid of the output it
    is signed and does not saturate.
    """
    effects = []
    if predictions.kept is not None:
        effects.append(predictions.kept - predictions.empty)
    if predictions.removed is not None:
        effects.append(predictions.image - predictions.removed)
    return torch.stack(effects).mean(dim=0)


def _supporting_share(predictions: Predictions) -> Float[Tensor, " channels"]:
    """Each effect as a share of f(x) - f(b), positive where it supports the change; 0 where nothing changed.

    The division changes no map, since each is normalised, and keeps the numbers clear of the floor of 1e-12 in
    `combine`.
    """
    effects, change = channel_effects(predictions), predictions.image - predictions.empty
    return effects / change if change else torch.zeros_like(effects)


def _thesis_support(predictions: Predictions) -> Float[Tensor, " channels"]:
    return thesis_support(predictions.image, kept=predictions.kept, removed=predictions.removed)


@dataclass(frozen=True, kw_only=True)
class Score:
    """A way to weigh channels, with what belongs to it."""

    support: Callable[[Predictions], Tensor]
    """How far each channel speaks for the prediction; below 0 it speaks against it, and gets no weight."""
    layers: Callable[[nn.Module, Tensor], tuple[Layer, ...]]
    """Layers of a network, fine to coarse or as they run, found with one image."""
    as_published: bool
    """Masks as the public code makes them, blended with black; otherwise empty for what is nowhere active, blended
    with the reference."""


SCORES = {
    "regression": Score(support=_supporting_share, layers=find_layers, as_published=False),
    "thesis": Score(support=_thesis_support, layers=find_published_layers, as_published=True),
}
