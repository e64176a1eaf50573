"""Noisy linear imputation: each removed pixel is the weighted mean of its neighbours, and a little noise."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

NOISE_SD = 0.01
"""Of ROAD, in units of the image's range."""
_KERNEL = torch.tensor([[1 / 12, 1 / 6, 1 / 12], [1 / 6, 0.0, 1 / 6], [1 / 12, 1 / 6, 1 / 12]])
_SMALL = 8
_TOLERANCE = 1e-3
"""A quarter of a grey level: what is left of the residual says how far pixels are from the mean of their neighbours."""


def noisy_linear(
    images: Float[Tensor, "batch 3 height width"],
    gone: Bool[Tensor, "batch height width"],
    *,
    noise: Float[Tensor, "batch 3 height width"] | None = None,
    tolerance: float = _TOLERANCE,
) -> Float[Tensor, "batch 3 height width"]:
    """Fill removed pixels so that each is the weighted mean of its eight neighbours, then add noise to them.

    The equations of all removed pixels are solved together, by conjugate gradients: they are those of a symmetric,
    positive definite matrix. An image of which nothing is left becomes its own mean.

    Parameters
    ----------
    images
        Images in [0, 1].
    gone
        Pixels to fill.
    noise
        Standard normal numbers; scaled to ROAD's 0.01 and added where pixels were filled. None without noise.
    tolerance
        Largest distance of a filled pixel from the mean of its neighbours.

    References
    ----------
    Rong et al., *A Consistent and Efficient Evaluation Strategy for Attribution Methods* (2022): ROAD, section 4 and
    appendix; weights of 1/6 for the four nearest and 1/12 for the diagonal neighbours.
    """
    # channels last: the small convolution of every step is six times as fast on a CPU; a mask for each colour, since
    # there a product with one for all of them takes six times as long
    each, mask = (
        one.contiguous(memory_format=torch.channels_last) for one in (images, gone[:, None].expand(images.shape))
    )
    filled = _solve(each, mask, tolerance=tolerance)
    if noise is not None:
        filled.addcmul_(noise, mask, value=NOISE_SD)
    return filled.clamp_(0, 1)


def _solve(
    images: Float[Tensor, "batch 3 height width"], gone: Bool[Tensor, "batch 3 height width"], *, tolerance: float
) -> Float[Tensor, "batch 3 height width"]:
    """Images whose removed pixels are the weighted means of their neighbours; see `noisy_linear`.

    The solution at half the size is where it begins: alone, conjugate gradients carry what they know by one pixel a
    step, which takes ten times as long where holes are large.
    """
    kernel = _KERNEL.to(images).expand(3, 1, 3, 3)
    hole = gone.to(images.dtype)
    left = 1 - hole

    def gather(values: Tensor) -> Tensor:
        return functional.conv2d(values, kernel, padding=1, groups=3)

    # less than one at the border, where neighbours are missing
    weights = gather(torch.ones_like(images[:1]))
    known = left.sum(dim=(2, 3), keepdim=True)
    filled = (images * left).addcmul_(_begin(images, left, tolerance=tolerance), hole)

    # in place wherever it can be: fresh memory of this size costs more than the arithmetic
    scratch = torch.empty_like(filled)

    def dot(one: Tensor, other: Tensor) -> Tensor:
        return torch.mul(one, other, out=scratch).sum(dim=(1, 2, 3), keepdim=True)

    # a whole image that is gone has its mean for a solution, and a matrix that is singular
    inside = hole * (known > 0)
    residual = gather(filled).addcmul_(weights, filled, value=-1).mul_(inside)
    direction, square = residual.clone(), dot(residual, residual)
    for _ in range(4 * max(images.shape[-2:])):
        low, high = residual.permute(0, 2, 3, 1).aminmax()  # as it lies in memory
        if max(-float(low), float(high)) <= tolerance:
            break
        # the matrix: of values that are zero outside the holes
        pushed = gather(direction).neg_().addcmul_(weights, direction).mul_(inside)
        step = square / dot(direction, pushed).clamp_min(1e-30)
        filled.addcmul_(step, direction)
        residual.addcmul_(step, pushed, value=-1)
        after = dot(residual, residual)
        direction.mul_(after / square.clamp_min(1e-30)).add_(residual)
        square = after
    return filled


def _begin(
    images: Float[Tensor, "batch 3 height width"], left: Float[Tensor, "batch 3 height width"], *, tolerance: float
) -> Float[Tensor, "batch 3 height width"]:
    """A first guess: the solution at half the size, or the mean of what is left of a small or whole image."""
    known = left.sum(dim=(2, 3), keepdim=True)
    whole = images.mean((2, 3), keepdim=True)
    mean = torch.where(known > 0, (images * left).sum(dim=(2, 3), keepdim=True) / known.clamp_min(1), whole)
    if min(images.shape[-2:]) < _SMALL or bool((known == 0).any()) or bool((left == 1).all()):
        return mean.expand_as(images)
    share = functional.avg_pool2d(left, 2, ceil_mode=True, count_include_pad=False)
    seen = functional.avg_pool2d(images * left, 2, ceil_mode=True, count_include_pad=False) / share.clamp_min(0.1)
    half = _solve(torch.where(share > 0, seen, mean), share == 0, tolerance=tolerance)
    return functional.interpolate(half, size=images.shape[-2:], mode="bilinear", align_corners=False)
