"""From the weights of all channels to one map: Poly-CAM's way from the coarsest layer to the finest."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from sliplens.explain.maps import FLOOR, resize, to_masks


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

    Parameters
    ----------
    activations, weights
        Those of each layer, fine to coarse.
    size
        Height and width of the image in pixels.

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
