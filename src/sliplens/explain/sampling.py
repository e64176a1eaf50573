"""Which channels to measure when not all can be, what the others do, and how far the map may be off."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from sliplens.explain.effects import Regions

_GRID = 14  # cells a side on which masks are compared; more cells told nothing more
_LENGTH = 3.0  # of the kernel, in median distances between masks
_NUGGET = 1e-3  # share of the variance that masks alike may still differ by
_JITTER = 1e-6


def mask_kernel(regions: Regions, channels: Int[Tensor, " some"]) -> Float[Tensor, "some some"]:
    """How alike the effects of two channels should be: exp(-distance of what their masks uncover / length).

    What a mask uncovers is its mean over each of 14 x 14 cells, times the mean |x - b| there: where the image equals
    the reference a mask shows nothing. The kernel is the roughest of the Matern family, which asks no smoothness of
    the network; its length is three times the median distance.

    Parameters
    ----------
    regions
        Of one image.
    channels
        Of all layers in a row.

    References
    ----------
    Rasmussen and Williams, *Gaussian processes for machine learning* (2006), eq. 4.18.
    """
    content = (regions.image - regions.empty).abs().mean(dim=0)
    weights = functional.adaptive_avg_pool2d(content[None], _GRID).flatten().double()
    features = torch.cat([_pooled(masks).flatten(1) for masks in regions.masks])[channels].double() * weights
    distance = torch.cdist(features, features)
    return torch.exp(-distance / (_LENGTH * distance.median().clamp_min(1e-12)))


def _pooled(masks: Tensor) -> Tensor:
    # cells smaller than the grid's are averaged, larger ones repeated
    return functional.adaptive_avg_pool2d(masks[:, None], _GRID)[:, 0]


class Field:
    """The effects of all channels as a Gaussian process, of which some are measured one after another.

    The factor L of the covariance is built column by column (a pivoted Cholesky decomposition), so that the variance
    that is left after each choice is known before anything is measured.

    Parameters
    ----------
    kernel
        Covariance of the effects up to a factor, ones on the diagonal.

    References
    ----------
    Rasmussen and Williams, *Gaussian processes for machine learning* (2006), eqs. 2.23 and 2.24.
    """

    def __init__(self, kernel: Float[Tensor, "channels channels"]) -> None:
        self._kernel = kernel
        self._factor = kernel.new_zeros(len(kernel), 0)
        self._variance = kernel.diagonal().clone()
        self.chosen: list[int] = []
        """Channels chosen so far, in their order."""
        self._effects = kernel.new_zeros(0)

    def choose(self, count: int, *, importance: Float[Tensor, " channels"]) -> Int[Tensor, " count"]:
        """Choose channels, each the one with the most importance x standard deviation left after those before it.

        Parameters
        ----------
        count
            How many.
        importance
            What an error of the channel's effect costs, >= 0.
        """
        chosen = []
        self._factor = torch.cat([self._factor, self._factor.new_zeros(len(self._factor), count)], dim=1)
        free = torch.ones_like(self._variance)
        free[self.chosen] = -1  # never again, even where nothing is uncertain
        for place in range(len(self.chosen), len(self.chosen) + count):
            pivot = int(torch.where(free > 0, self._variance * importance**2, -1.0).argmax())
            root = math.sqrt(float(self._variance[pivot]) + _NUGGET)
            column = (self._kernel[:, pivot] - self._factor[:, :place] @ self._factor[pivot, :place]) / root
            column[pivot] = root
            self._factor[:, place] = column
            self._variance = (self._variance - column**2).clamp_min(0)
            free[pivot] = -1
            chosen.append(pivot)
        self.chosen += chosen
        return torch.tensor(chosen, device=self._kernel.device)

    def learn(self, effects: Float[Tensor, " count"]) -> None:
        """Take in the effects of the channels chosen last, in their order."""
        self._effects = torch.cat([self._effects, effects.to(self._effects)])

    def estimate(self) -> tuple[Float[Tensor, " channels"], Float[Tensor, " channels"]]:
        """Effect of every channel, and its standard deviation: 0 for those measured."""
        chosen, count = torch.tensor(self.chosen), len(self.chosen)
        mean = self._effects.mean()
        residual = torch.linalg.solve_triangular(
            self._factor[chosen, :count], (self._effects - mean)[:, None], upper=False
        )
        estimate = mean + (self._factor[:, :count] @ residual)[:, 0]
        estimate[chosen] = self._effects
        # the prior variance that makes what was measured most likely (eq. 5.8 solved for a factor of the kernel)
        deviation = (self._variance * (residual**2).mean()).sqrt()
        deviation[chosen] = 0
        return estimate, deviation

    def draws(self, count: int, *, generator: torch.Generator) -> Float[Tensor, "count channels"]:
        """Effects of every channel as they may be, given those measured."""
        estimate, deviation = self.estimate()
        left = torch.nonzero(deviation > 0).flatten()
        if not len(left):
            return estimate.repeat(count, 1)
        factor = self._factor[left, : len(self.chosen)]
        covariance = self._kernel[left][:, left] - factor @ factor.T
        covariance.diagonal().add_(_JITTER)
        root, _ = torch.linalg.cholesky_ex(covariance)
        noise = torch.randn(count, len(left), generator=generator, dtype=root.dtype).to(root.device)
        draws = estimate.repeat(count, 1)
        draws[:, left] += deviation[left[0]] / self._variance[left[0]].sqrt() * (noise @ root.T)
        return draws
