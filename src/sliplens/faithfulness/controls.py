"""Controls: maps that know nothing of the network, which an explanation has to beat."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

Maps = Float[Tensor, "images height width"]
_CENTRE_SD = 0.25
"""Standard deviation of the centred Gaussian, in widths of the image."""


def edges(images: Float[Tensor, "images 3 height width"]) -> Maps:
    """Strength of the edges: length of Sobel's gradient, mean over the channels."""
    across = torch.tensor([[-1.0, 0.0, 1.0], [-2.0, 0.0, 2.0], [-1.0, 0.0, 1.0]]) / 8
    kernels = torch.stack([across, across.T]).to(images)[:, None].repeat(3, 1, 1, 1)
    padded = functional.pad(images, (1, 1, 1, 1), mode="replicate")
    slopes = functional.conv2d(padded, kernels, groups=3).unflatten(1, (3, 2))
    return slopes.square().sum(dim=2).sqrt().mean(dim=1)


def brightness(images: Float[Tensor, "images 3 height width"]) -> Maps:
    """The input itself, mean over the channels: of a difference image, how much changed."""
    return images.abs().mean(dim=1)


def centre(images: Float[Tensor, "images 3 height width"]) -> Maps:
    """A Gaussian about the middle: a camera looks at what matters."""
    height, width = images.shape[-2:]
    down, across = (torch.linspace(-0.5, 0.5, side, device=images.device) for side in (height, width))
    bump = torch.exp(-(down[:, None].square() + across.square()) / (2 * _CENTRE_SD**2))
    return bump.to(images.dtype).expand(len(images), height, width)


CONTROLS: dict[str, Callable[[Float[Tensor, "images 3 height width"]], Maps]] = {
    "edges": edges,
    "input": brightness,
    "centre": centre,
}
"""Beside these the random orders, and the explainer itself on a network whose weights were drawn anew.

References
----------
Clark et al., *XAI-TRIS* (2024), edge filters; Adebayo et al., *Sanity Checks for Saliency Maps* (2018).
"""
