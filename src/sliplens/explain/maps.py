"""Arithmetic on maps: resizing, spreading a total over pixels, percentiles."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

FLOOR = 1e-12
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


def to_masks(maps: Float[Tensor, "*maps rows columns"]) -> Float[Tensor, "*maps rows columns"]:
    """Turn each map into a mask in [0, 1]: clip((a - lo) / max(hi, 1e-12), 0, 1), lo and hi its extreme percentiles.

    A map below zero all over (hi < 0) gives the empty mask: the formula as it stands would divide by 1e-12 and make
    a channel that is nowhere active a mask of ones.

    References
    ----------
    Englebert, Cornu and De Vleeschouwer, *Poly-CAM: High resolution class activation map for convolutional neural
    networks*, ICPR 2022, and its public code for the division by hi rather than by the range.
    """
    low, high = (bound[..., None, None] for bound in percentile_bounds(maps))
    masks = ((maps - low) / high.clamp_min(FLOOR)).clamp(0, 1)
    return torch.where(high < 0, torch.zeros_like(masks), masks)
