"""Arithmetic on maps: resizing, spreading a total over pixels, percentiles."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

FLOOR = 1e-12
CHANGE_WINDOW = 15 / 224
"""Side of the square over which a change is averaged, as a share of the image's height: about a marker."""
_LOW, _HIGH = 0.001, 0.999  # 0.1th and 99.9th percentile


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
    aligned). Where the sizes divide evenly, as 7 into 224, the column sums are all (height / rows)(width / columns)
    and this is the usual bilinear map over that number; elsewhere plain resizing would change the total.

    Examples
    --------
    >>> import torch
    >>> from sliplens.explainers.maps import spread
    >>> coarse = torch.tensor([[1.0, -0.5], [0.25, 0.25]])
    >>> fine = spread(coarse, (8, 8))
    >>> fine.shape, fine.sum()
    (torch.Size([8, 8]), tensor(1.))
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
    """0.1th and 99.9th percentile of each map, linear between ranks as `numpy.quantile`.

    The rank is a Python float: `torch.quantile` rounds it to the map's type, which in float32 moves the percentile.
    """
    ordered = maps.flatten(-2).sort(dim=-1).values
    low, high = (_at_rank(ordered, share * (ordered.shape[-1] - 1)) for share in (_LOW, _HIGH))
    return low, high


def _at_rank(ordered: Tensor, rank: float) -> Tensor:
    below = int(rank)
    above = min(below + 1, ordered.shape[-1] - 1)
    return torch.lerp(ordered[..., below], ordered[..., above], rank - below)


def to_masks(
    maps: Float[Tensor, "*maps rows columns"], *, as_published: bool = False
) -> Float[Tensor, "*maps rows columns"]:
    """Turn each map into a mask in [0, 1]: clip((a - lo) / max(hi, 1e-12), 0, 1), lo and hi its extreme percentiles.

    A map below zero all over (hi < 0) gives the empty mask: the formula as it stands would divide by 1e-12 and make
    a channel that is nowhere active a mask of ones, which `as_published` keeps.

    References
    ----------
    Englebert, Cornu and De Vleeschouwer, *Poly-CAM: High resolution class activation map for convolutional neural
    networks*, ICPR 2022, and its public code for the division by hi rather than by the range.
    """
    low, high = (bound[..., None, None] for bound in percentile_bounds(maps))
    masks = ((maps - low) / high.clamp_min(FLOOR)).clamp(0, 1)
    return masks if as_published else torch.where(high < 0, torch.zeros_like(masks), masks)


def local_change(
    image: Float[Tensor, "3 height width"], reference: Float[Tensor, "3 height width"]
) -> Float[Tensor, "height width"]:
    """How much the image differs from the reference around each pixel.

    The mean of |x - b| over the colours and over a square of `CHANGE_WINDOW`; beyond the border the outermost pixels
    are repeated.
    """
    change = (image - reference).abs().mean(dim=0)
    reach = round(CHANGE_WINDOW * change.shape[0]) // 2
    padded = functional.pad(change[None, None], [reach] * 4, mode="replicate")
    return functional.avg_pool2d(padded, 2 * reach + 1, stride=1)[0, 0]


def pearson_r(first: Float[Tensor, "height width"], second: Float[Tensor, "height width"]) -> float:
    """Correlation of two maps over their pixels; NaN where one of them is constant."""
    first, second = (values.flatten().double() - values.double().mean() for values in (first, second))
    return float(first @ second / (first.norm() * second.norm()))


def top_overlap(
    one: Float[Tensor, "height width"], other: Float[Tensor, "height width"], *, share: float = 0.1
) -> float:
    """Share of the strongest pixels of one map, such as a tenth of all, that are among the strongest of another.

    Examples
    --------
    >>> import torch
    >>> from sliplens.explainers.maps import top_overlap
    >>> one, other = torch.tensor([[3.0, 2.0], [1.0, 0.0]]), torch.tensor([[3.0, 0.0], [1.0, 2.0]])
    >>> top_overlap(one, other, share=0.5)
    0.5
    """
    count = max(1, round(share * one.numel()))
    strongest = torch.zeros(one.numel(), dtype=torch.bool, device=one.device)
    strongest[one.flatten().topk(count).indices] = True
    return float(strongest[other.flatten().topk(count).indices].double().mean())
