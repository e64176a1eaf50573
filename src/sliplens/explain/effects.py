"""The effect of each channel's region on the prediction: masked images, made as they are needed."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sliplens.explain.maps import resize, to_masks
from sliplens.explain.passes import Passes
from sliplens.explain.scores import Predictions, Variant


@dataclass(frozen=True, kw_only=True)
class Regions:
    """One image and the regions of all its channels, those of every layer in a row."""

    image: Float[Tensor, "3 height width"]
    """x."""
    empty: Float[Tensor, "3 height width"]
    """b, what is shown outside a region."""
    masks: tuple[Float[Tensor, "_channels _rows _columns"], ...]
    """M, in [0, 1], at the resolution of each layer."""

    @classmethod
    def of(
        cls,
        activations: list[Float[Tensor, "_channels _rows _columns"]],
        *,
        image: Float[Tensor, "3 height width"],
        empty: Float[Tensor, "3 height width"],
        as_published: bool = False,
    ) -> "Regions":
        """Regions from the activations of each layer; see `to_masks`."""
        return cls(image=image, empty=empty, masks=tuple(to_masks(a, as_published=as_published) for a in activations))

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
    passes: Passes,
    variant: Variant,
    on_channels: Callable[[int], None],
) -> Float[Tensor, "points some"]:
    """Predictions of the masked images of some channels; memory is bounded by the batch of the passes.

    Parameters
    ----------
    regions
        The image and its masks.
    channels
        Which, in rising order.
    passes
        The network.
    variant
        Which points are predicted.
    on_channels
        Called with the number of channels done since the last call.

    Returns
    -------
    Tensor
        One row for what is kept and one for what is removed, as far as the variant has them.
    """
    parts = channels.split(max(1, passes.batch_size // variant.passes))

    def batches() -> Iterator[Tensor]:
        for part in parts:
            # in pieces, where even one channel's images are more than a batch
            yield from regions.blends(part, variant=variant).split(passes.batch_size)

    waiting, found = list(parts), []
    pieces: list[Tensor] = []
    for answers in passes.run(batches()):
        pieces.append(answers)
        if sum(map(len, pieces)) == variant.passes * len(waiting[0]):
            found.append(torch.cat(pieces).reshape(variant.passes, -1))
            on_channels(len(waiting.pop(0)))
            pieces = []
    return torch.cat(found, dim=1) if found else regions.image.new_zeros(variant.passes, 0)


def as_predictions(
    points: Float[Tensor, "points channels"], *, variant: Variant, image: Float[Tensor, ""], empty: Float[Tensor, ""]
) -> Predictions:
    """Name the rows that `measure` returns."""
    rows = iter(points)
    return Predictions(
        image=image,
        empty=empty,
        kept=next(rows) if variant.keep else None,
        removed=next(rows) if variant.remove else None,
    )
