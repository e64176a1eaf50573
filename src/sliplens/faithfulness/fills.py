"""Fills: what a removed pixel becomes."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torchvision.transforms.v2 import functional as transforms

from sliplens.errors import InputError
from sliplens.faithfulness.noisy_linear import noisy_linear

Images = Float[Tensor, "images 3 height width"]
Painter = Callable[[Int[Tensor, " batch"], Bool[Tensor, "batch height width"]], Float[Tensor, "batch 3 height width"]]
"""From numbers of images, and the pixels that are gone of each, to the images without them."""
Fill = Callable[[Images, Images | None, int], Painter]
"""From inputs in [0, 1], their references (the untouched sensor) if they are known, and a seed, to a painter."""


def _static(fill: Callable[[Images], Images]) -> Fill:
    """The same filled image whatever is removed."""

    def prepare(images: Images, _references: Images | None, _seed: int) -> Painter:
        filled = fill(images)

        def paint(rows: Tensor, gone: Tensor) -> Tensor:
            # most batches are of one image: picked once, which is three times as fast
            picked = rows[:1] if bool((rows == rows[0]).all()) else rows
            return torch.where(gone[:, None], filled[picked], images[picked])

        return paint

    return prepare


def _constant(level: float) -> Fill:
    return _static(lambda images: torch.full_like(images, level))


def _background(images: Images) -> Images:
    return images.flatten(2).median(dim=2).values[..., None, None].expand_as(images)


def _blurred(images: Images) -> Images:
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


FILLS: dict[str, Fill] = {
    "grey": _constant(0.5),
    "black": _constant(0.0),
    "white": _constant(1.0),
    "background": _static(_background),
    "blur": _static(_blurred),
    "reference": _reference,
    "noisy-linear": _noisy_linear,
}
"""`background` is the median colour of the image, what most of it shows; `reference` puts the untouched sensor in
place; `noisy-linear` (ROAD) blends the pixels around, with a little noise, so that the shape of what was removed tells
less."""


def get_fill(name: str) -> Fill:
    """Look up a fill by name.

    Raises
    ------
    InputError
        If there is none of that name; the message lists those there are.
    """
    if name not in FILLS:
        raise InputError(f"there is no fill named {name!r}; choose one of {', '.join(FILLS)}")
    return FILLS[name]
