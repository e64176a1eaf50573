"""Fills: the content of removed pixels."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from sliplens.errors import InputError
from sliplens.explainers.attribution import frame_of
from sliplens.extras import Table

NOISE_SD = 0.01
"""Standard deviation of ROAD's noise, in units of the image's range."""
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
    """Fill removed pixels so that each is the weighted mean of its eight neighbours, then add (standard normal) noise.

    All equations are solved together by conjugate gradients, until no filled pixel is farther than the tolerance from
    the mean of its neighbours. An image of which nothing is left becomes its own mean.

    Rong et al., *A Consistent and Efficient Evaluation Strategy for Attribution Methods* (2022): ROAD, section 4 and
    appendix; weights of 1/6 for the four nearest and 1/12 for the diagonal neighbours.
    """
    # channels last: the small convolution of every step is six times as fast on a CPU; a mask for each colour, since
    # there a product with one for all of them takes six times as long
    both = images, gone[:, None].expand(images.shape)
    each, mask = (values.contiguous(memory_format=torch.channels_last) for values in both)
    filled = _solve(each, mask, tolerance=tolerance)
    if noise is not None:
        filled.addcmul_(noise, mask, value=NOISE_SD)
    return filled.clamp_(0, 1)


def _solve(
    images: Float[Tensor, "batch 3 height width"], gone: Bool[Tensor, "batch 3 height width"], *, tolerance: float
) -> Float[Tensor, "batch 3 height width"]:
    """Images whose removed pixels are the weighted means of their neighbours, from the solution at half the size on.

    Alone, conjugate gradients carry what they know by one pixel a step: ten times as long where holes are large.
    """
    kernel = _KERNEL.to(images).expand(3, 1, 3, 3)
    hole = gone.to(images.dtype)
    rest = 1 - hole

    def gather(values: Tensor) -> Tensor:
        return functional.conv2d(values, kernel, padding=1, groups=3)

    # less than one at the border, where neighbours are missing
    weights = gather(torch.ones_like(images[:1]))
    count = rest.sum(dim=(2, 3), keepdim=True)
    filled = (images * rest).addcmul_(_begin(images, rest, tolerance=tolerance), hole)

    # in place wherever it can be: fresh memory of this size costs more than the arithmetic
    scratch = torch.empty_like(filled)

    def dot(first: Tensor, second: Tensor) -> Tensor:
        return torch.mul(first, second, out=scratch).sum(dim=(1, 2, 3), keepdim=True)

    # a whole image that is gone has its mean for a solution, and a matrix that is singular
    inside = hole * (count > 0)
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
    images: Float[Tensor, "batch 3 height width"], rest: Float[Tensor, "batch 3 height width"], *, tolerance: float
) -> Float[Tensor, "batch 3 height width"]:
    """Return a first guess: the solution at half the size, or the mean of the rest of a small or whole image."""
    count = rest.sum(dim=(2, 3), keepdim=True)
    whole = images.mean((2, 3), keepdim=True)
    mean = torch.where(count > 0, (images * rest).sum(dim=(2, 3), keepdim=True) / count.clamp_min(1), whole)
    if min(images.shape[-2:]) < _SMALL or bool((count == 0).any()) or bool((rest == 1).all()):
        return mean.expand_as(images)
    share = functional.avg_pool2d(rest, 2, ceil_mode=True, count_include_pad=False)
    half = functional.avg_pool2d(images * rest, 2, ceil_mode=True, count_include_pad=False) / share.clamp_min(0.1)
    half = _solve(torch.where(share > 0, half, mean), share == 0, tolerance=tolerance)
    return functional.interpolate(half, size=images.shape[-2:], mode="bilinear", align_corners=False)


Images = Float[Tensor, "images colours height width"]
Painter = Callable[
    [Int[Tensor, " batch"], Bool[Tensor, "batch height width"]], Float[Tensor, "batch colours height width"]
]
"""From numbers of images, and the pixels that are gone of each, to the images without them."""
Fill = Callable[[Images, Images | None, int], Painter]
"""From inputs in [0, 1], their references (the baseline) if they are known, and a seed, to a painter."""


def _static(fill: Callable[[Images], Images]) -> Fill:
    """Make a fill whose filled image does not depend on what is removed."""

    def prepare(images: Images, _references: Images | None, _seed: int) -> Painter:
        filled = fill(images)

        def paint(rows: Tensor, gone: Tensor) -> Tensor:
            # most batches are of one image: picked once, which is three times as fast
            picked = rows[:1] if bool((rows == rows[0]).all()) else rows
            return torch.where(gone[:, None], filled[picked], images[picked])

        return paint

    return prepare


def _blurred(images: Images) -> Images:
    from torchvision.transforms.v2 import functional as transforms  # noqa: PLC0415 (takes a second)

    # a standard deviation of 5 % of the width wipes a marker out and keeps the illumination
    sigma = 0.05 * images.shape[-1]
    kernel = 2 * round(2 * sigma) + 1
    return transforms.gaussian_blur(images, [kernel, kernel], [sigma, sigma])


def _reference(images: Images, references: Images | None, _seed: int) -> Painter:
    if references is None:
        raise InputError("the fill reference needs the input of the untouched sensor; give it, or choose another fill")
    return _static(lambda _: references)(images, None, 0)


def _noisy_linear(images: Images, _references: Images | None, seed: int) -> Painter:
    # one field of noise for each image, so that its curve does not jitter from step to step
    noise = torch.randn(images.shape, generator=torch.Generator().manual_seed(seed)).to(images)
    return lambda rows, gone: noisy_linear(images[rows], gone, noise=noise[rows])


_ROWS: dict[str, Fill] = {
    "grey": _static(lambda images: torch.full_like(images, 0.5)),
    "black": _static(torch.zeros_like),
    "white": _static(torch.ones_like),
    "background": _static(lambda images: images.flatten(2).median(dim=2).values[..., None, None].expand_as(images)),
    "blur": _static(_blurred),
    "reference": _reference,
    "noisy-linear": _noisy_linear,
}
FILLS = Table("fill", "sliplens.fills", _ROWS)
"""Fills by name; an installed package adds its own by the entry point `sliplens.fills`.

`background` is the median colour of the image, `reference` the baseline; `noisy-linear` (ROAD) blends the
pixels around, with a little noise.
"""


def get_fill(name: str) -> Fill:
    """Look up a fill for the frame; the reference beside it, if any, stays.

    Raises
    ------
    InputError
        If there is none; the message lists those there are.

    Examples
    --------
    >>> import torch
    >>> from sliplens.faithfulness.fills import get_fill
    >>> images = torch.ones(1, 3, 1, 2)
    >>> paint = get_fill("grey")(images, None, 0)
    >>> paint(torch.tensor([0]), torch.tensor([[[True, False]]]))[0, 0]
    tensor([[0.5000, 1.0000]])
    """
    fill = FILLS.pick(name)

    def prepare(images: Images, references: Images | None, seed: int) -> Painter:
        if images.shape[1] == 3:
            return fill(images, references, seed)
        paint = fill(frame_of(images), None if references is None else frame_of(references), seed)
        return lambda rows, gone: torch.cat([paint(rows, gone), images[rows, 3:]], dim=1)

    return prepare
