"""Fills: what a removed pixel becomes."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor
from torchvision.transforms.v2 import functional as transforms

from sliplens.errors import InputError

Images = Float[Tensor, "batch 3 height width"]


def _constant(level: float) -> Callable[[Images], Images]:
    return lambda images: torch.full_like(images, level)


def _blurred(images: Images) -> Images:
    # a standard deviation of 5 % of the width wipes a marker out and keeps the illumination
    sigma = 0.05 * images.shape[-1]
    kernel = 2 * round(2 * sigma) + 1
    return transforms.gaussian_blur(images, [kernel, kernel], [sigma, sigma])


FILLS: dict[str, Callable[[Images], Images]] = {
    "grey": _constant(0.5),
    "black": _constant(0.0),
    "white": _constant(1.0),
    "blur": _blurred,
}


def get_fill(name: str) -> Callable[[Images], Images]:
    """Look up a fill by name: a function from inputs in [0, 1] to what their removed pixels become.

    Raises
    ------
    InputError
        If there is none of that name; the message lists those there are.
    """
    if name not in FILLS:
        raise InputError(f"there is no fill named {name!r}; choose one of {', '.join(FILLS)}")
    return FILLS[name]
