"""The record that every explainer returns, and the shape of a call."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Shaped
from torch import Tensor, nn

Progress = Callable[[int, int], None]
"""Called with the pieces of work done and their total, after each piece."""


@dataclass(frozen=True, kw_only=True)
class Level:
    """What one layer contributed to a map that is built layer by layer."""

    layer: str
    """Name of the layer in the network."""
    saliency: Float[Tensor, "batch height width"]
    """Map in [0, 1] as it stood at this layer, resized to the image."""
    weights: Float[Tensor, "batch channels"]
    """Weight of each channel, >= 0: for the regression score a share of f(x) - f(reference)."""


@dataclass(frozen=True, kw_only=True)
class Approximation:
    """What an approximate map has in common with the exact one, as far as its own measurements tell."""

    measured: int
    """Channels whose effect was measured."""
    channels: int
    """Channels that an exact map would measure."""
    pearson_r: float
    """Expected correlation with the exact map over the pixels; NaN where the map is constant."""
    top_overlap: float
    """Expected share of the strongest tenth of the pixels that is the exact map's too."""


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """Why a network predicts f(x) rather than f(reference), for a batch of images."""

    relevance: Float[Tensor, "batch height width"]
    """Signed contribution of each pixel in margin units (float32): above zero where it raises the prediction."""
    method: str
    """Key of the explainer in `EXPLAINERS`."""
    target: str
    """What the relevance adds up to, in words."""
    prediction: Float[Tensor, " batch"]
    """f(x), the safety margin of each image."""
    reference_prediction: Float[Tensor, " batch"]
    """f(reference), the safety margin of what each image is compared with."""
    completeness_gap: Float[Tensor, " batch"] | None = None
    """|sum of the relevance - (f(x) - f(reference))| in margin units; None where the sum is not promised."""
    seconds: float
    """Wall-clock time of the whole call, every image together, the device waited for."""
    warnings: tuple[str, ...] = ()
    """What a reader should know before trusting the maps, one sentence each."""
    levels: tuple[Level, ...] = ()
    """The map layer by layer, fine to coarse, where the method has levels and was asked to keep them."""
    approximations: tuple[Approximation, ...] = ()
    """For each image what its map has in common with the exact one; empty where the map is exact."""
    engine: str = "plain"
    """What ran the network: as it is (`plain`), or an engine of `passes` that was found to answer as it does."""

    @property
    def change(self) -> Float[Tensor, " batch"]:
        """f(x) - f(reference), the difference that is explained, in margin units."""
        return self.prediction - self.reference_prediction

    @property
    def saliency(self) -> Float[Tensor, "batch height width"]:
        """The supporting evidence in [0, 1], for viewing: 1 at the strongest pixel of each image.

        A regressor has no winning class, so "supporting" is read off the difference that is explained: with
        s = sign(f(x) - f(reference)) the map is relu(s * relevance) over its largest value. Where the margin falls
        below the reference's (s = -1) the pixels that lower it are shown, which a plain ReLU would hide. A map
        without supporting evidence stays zero, and so does every map where f(x) = f(reference).
        """
        supporting = torch.relu(self.change.sign().to(self.relevance.dtype)[:, None, None] * self.relevance)
        peak = supporting.amax(dim=(1, 2), keepdim=True)
        return supporting / torch.where(peak > 0, peak, torch.ones_like(peak))


@runtime_checkable
class Explainer(Protocol):
    """A frozen dataclass whose fields are the options of a method and whose call explains a batch."""

    def __call__(
        self,
        model: nn.Module,
        images: Shaped[Tensor, "*batch channels height width"],
        *,
        reference: Shaped[Tensor, "..."] | None = None,
        on_progress: Progress | None = None,
    ) -> Explanation:
        """Explain f(x) - f(reference) of a regressor with one output.

        Parameters
        ----------
        model
            Network from images (batch, 3, height, width) to one safety margin each, (batch,) or (batch, 1).
            It is put into evaluation mode for the call and given back as it was.
        images
            Images x, float in [0, 1], shape (batch, 3, height, width).
        reference
            What the images are compared with, float in [0, 1], one for all (3, height, width) or one each
            (batch, 3, height, width); by default zeros, the untouched sensor of difference images.
        on_progress
            Called with the pieces of work done and their total.

        Raises
        ------
        ImageError
            If the images or the reference have a wrong shape, type or range, or hold NaN.
        ModelError
            If the network has several outputs, predicts NaN, or lacks a layer that the method needs.
        """
        ...
