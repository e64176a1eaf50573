"""Arithmetic on maps: resizing, spreading a total over pixels, percentiles, the map that weighted channels make."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

FLOOR = 1e-12
CHANGE_WINDOW = 15 / 224
"""Side of the square over which a change is averaged, as a share of the image's height: about a marker."""


def resize(maps: Float[Tensor, "*maps rows columns"], size: tuple[int, int]) -> Float[Tensor, "*maps height width"]:
    """Resize maps bilinearly to (height, width) in pixels, corners not aligned; unchanged at the same size."""
    if tuple(maps.shape[-2:]) == tuple(size):
        return maps
    flat = maps.reshape(-1, 1, *maps.shape[-2:])
    return functional.interpolate(flat, size=size, mode="bilinear", align_corners=False).reshape(
        *maps.shape[:-2], *size
    )


def spread(maps: Float[Tensor, "*maps rows columns"], size: tuple[int, int]) -> Float[Tensor, "*maps height width"]:
    """Spread each cell's value over the pixels of a larger image, keeping the total of every map.

    Pixel p receives sum over cells i of B[p, i] m[i] / sum over p' of B[p', i], B the bilinear weights (corners not
    aligned); plain resizing would change the total where the sizes do not divide.
    """
    rows, columns = (_received(maps, axis=axis, pixels=pixels) for axis, pixels in zip((-2, -1), size, strict=True))
    return resize(maps / (rows[:, None] * columns), size)


def _received(maps: Tensor, *, axis: int, pixels: int) -> Tensor:
    identity = torch.eye(maps.shape[axis], dtype=maps.dtype, device=maps.device)
    weights = functional.interpolate(identity[None], size=pixels, mode="linear", align_corners=False)
    return weights.sum(dim=-1)[0].clamp_min(FLOOR)


def percentile_bounds(
    maps: Float[Tensor, "*maps rows columns"],
) -> tuple[Float[Tensor, "*maps"], Float[Tensor, "*maps"]]:
    """0.1th and 99.9th percentile of each map, linear between ranks as `numpy.quantile`."""
    ordered = maps.flatten(-2).sort(dim=-1).values

    def at(share: float) -> Tensor:
        # a Python float: `torch.quantile` rounds the rank to the map's type, which in float32 moves the percentile
        rank = share * (ordered.shape[-1] - 1)
        below = int(rank)
        return torch.lerp(ordered[..., below], ordered[..., min(below + 1, ordered.shape[-1] - 1)], rank - below)

    return at(0.001), at(0.999)


def to_masks(
    maps: Float[Tensor, "*maps rows columns"], *, as_published: bool = False
) -> Float[Tensor, "*maps rows columns"]:
    """Turn each map into a mask in [0, 1]: clip((a - lo) / max(hi, 1e-12), 0, 1), lo and hi its extreme percentiles.

    A map below zero all over gives the empty mask; `as_published` it gives one of ones, divided by 1e-12.

    References
    ----------
    Englebert, Cornu and De Vleeschouwer, *Poly-CAM: High resolution class activation map for convolutional neural
    networks*, ICPR 2022, and its public code for the division by hi rather than by the range.
    """
    low, high = (bound[..., None, None] for bound in percentile_bounds(maps))
    masks = ((maps - low) / high.clamp_min(FLOOR)).clamp(0, 1)
    return masks if as_published else torch.where(high < 0, torch.zeros_like(masks), masks)


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

    From the last layer on a layer's map is divided by itself resized to the coarser result and back (LNorm), then
    multiplied by that result; a level's saliency is this product normalised like a mask.

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


def local_change(
    image: Float[Tensor, "colours height width"], reference: Float[Tensor, "colours height width"], *, widths: int = 1
) -> Float[Tensor, "height width"]:
    """Mean of |x - b| over the colours and a square of some `CHANGE_WINDOW` around each pixel, the border repeated."""
    change = (image - reference).abs().mean(dim=0)
    reach = round(widths * CHANGE_WINDOW * change.shape[0]) // 2
    padded = functional.pad(change[None, None], [reach] * 4, mode="replicate")
    return functional.avg_pool2d(padded, 2 * reach + 1, stride=1)[0, 0]


def pearson_r(first: Float[Tensor, "height width"], second: Float[Tensor, "height width"]) -> float:
    """Correlation of two maps over their pixels; NaN where one of them is constant."""
    first, second = (values.flatten().double() - values.double().mean() for values in (first, second))
    return float(first @ second / (first.norm() * second.norm()))


def top_overlap(
    one: Float[Tensor, "height width"], other: Float[Tensor, "height width"], *, share: float = 0.1
) -> float:
    """Share of the strongest pixels of one map, such as a tenth of all, that are among the strongest of another."""
    count = max(1, round(share * one.numel()))
    strongest = torch.zeros(one.numel(), dtype=torch.bool, device=one.device)
    strongest[one.flatten().topk(count).indices] = True
    return float(strongest[other.flatten().topk(count).indices].double().mean())
