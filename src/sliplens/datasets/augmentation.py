"""Augmentation of batches, on whatever device they lie."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional
from torchvision.transforms.v2 import functional as transforms

from sliplens.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Augmentation:
    """Slight rotations and shifts, colour, Gaussian noise and Gaussian blur, drawn for each image.

    Parameters
    ----------
    rotation_deg
        Rotations are uniform within plus and minus this: the pull is never exactly along gravity.
    shift
        Shifts along x and y are uniform within plus and minus this share of the image: a camera never sits twice alike,
        and a network must not know a day by its place.
    colour
        Each channel is scaled by 1 plus or minus up to this: white balance.
    noise_sd
        Standard deviation of the noise is uniform in [0, noise_sd], in units of the image's maximum.
    neutral
        What stands for no change in the input; `colour` scales about it.
    blur_probability, blur_sd_px
        Share of batches that are blurred, and the largest standard deviation of the blur in pixels.

    References
    ----------
    Polak, section 4 ("random image augmentations": rotation, noise and blur; shift and colour are ours).
    """

    rotation_deg: float = 5.0
    shift: float = 0.015
    colour: float = 0.05
    noise_sd: float = 0.03
    blur_probability: float = 0.25
    blur_sd_px: float = 0.8
    neutral: float = 0.0

    def __call__(
        self, images: Float[Tensor, "batch 3 size size"], *, generator: torch.Generator
    ) -> Float[Tensor, "batch 3 size size"]:
        """Augment a batch; the same generator state gives the same images."""
        batch = len(images)
        device = images.device

        def uniform(*shape: int) -> Tensor:
            return torch.rand(*shape, generator=generator, device=device)

        angle = (2 * uniform(batch) - 1) * math.radians(self.rotation_deg)
        # the grid spans 2, from -1 to 1
        along, down = 2 * self.shift * (2 * uniform(2, batch) - 1)
        turn = torch.stack([angle.cos(), -angle.sin(), along, angle.sin(), angle.cos(), down], dim=1).view(-1, 2, 3)
        grid = functional.affine_grid(turn, list(images.shape), align_corners=False)
        images = functional.grid_sample(images, grid, padding_mode="border", align_corners=False)
        # a blur of images that lie channels last takes a quarter of the time, and the network wants them so
        images = images.contiguous(memory_format=torch.channels_last)
        if float(uniform(1)) < self.blur_probability:
            images = transforms.gaussian_blur(images, [3, 3], [0.1 + (self.blur_sd_px - 0.1) * float(uniform(1))])
        scale = 1 + self.colour * (2 * uniform(batch, 3, 1, 1) - 1)
        # in place: images of a batch are large, and the sampled ones are ours
        images.sub_(self.neutral).mul_(scale).add_(self.neutral)
        height, width = images.shape[-2:]
        noise = torch.randn((batch, height, width, 3), generator=generator, device=device).permute(0, 3, 1, 2)
        return images.add_(noise.mul_(uniform(batch, 1, 1, 1) * self.noise_sd)).clamp_(0, 1)


AUGMENTATIONS = {
    "none": None,
    "thesis": Augmentation(shift=0.0, colour=0.0),
    "default": Augmentation(),
}
"""What a recipe may ask for; `thesis` has rotation, noise and blur alone, in amounts of ours, for it gives none."""


def get_augmentation(name: str, *, neutral: float = 0.0) -> Augmentation | None:
    """Look up an augmentation by name, for inputs with a neutral level; None for none.

    Raises
    ------
    InputError
        If there is none of that name; the message lists those there are.
    """
    if name not in AUGMENTATIONS:
        raise InputError(f"there is no augmentation named {name!r}; choose one of {', '.join(AUGMENTATIONS)}")
    found = AUGMENTATIONS[name]
    return None if found is None else replace(found, neutral=neutral)
