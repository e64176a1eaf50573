"""Poly-CAM on a budget: some channels are measured, the others estimated, with the error that this leaves."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import fmean

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from sliplens.errors import InputError
from sliplens.explainers.attribution import ALIKE_R, ALIKE_TOP, FLOOR, Approximation, layer_map, pearson_r, top_overlap

_GRID = 14  # cells a side on which masks are compared; more cells change nothing
_LENGTH = 3.0  # of the kernel, in median distances between masks
_NUGGET = 1e-3  # share of the variance that masks alike may still differ by
_JITTER = 1e-6


def mask_kernel(
    contrast: Float[Tensor, "height width"],
    masks: Sequence[Float[Tensor, "_channels _rows _columns"]],
    channels: Int[Tensor, " some"],
) -> Float[Tensor, "some some"]:
    """How alike the effects of two channels should be: exp(-distance of what their masks uncover / length).

    What a mask uncovers is its mean over each of 14 x 14 cells, times the contrast |x - b| there: where the image
    equals the reference a mask shows nothing. The kernel asks no smoothness of the network.

    Rasmussen and Williams, *Gaussian processes for machine learning* (2006), eq. 4.18.
    """
    weights = functional.adaptive_avg_pool2d(contrast[None], _GRID).flatten().double()
    # cells smaller than the grid's are averaged, larger ones repeated
    pooled = [functional.adaptive_avg_pool2d(maps[:, None], _GRID).flatten(1) for maps in masks]
    features = torch.cat(pooled)[channels].double() * weights
    distance = torch.cdist(features, features)
    return torch.exp(-distance / (_LENGTH * distance.median().clamp_min(1e-12)))


class GaussianProcess:
    """Gaussian process of the effects of all channels, some of which are measured one after another.

    The factor L of the covariance is built column by column (a pivoted Cholesky decomposition), so that the variance
    that is left after each choice is known before anything is measured.

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
        """Choose channels, each the one with the most importance x standard deviation left after those before it."""
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
        """Add the measured effects of the channels chosen last, in their order."""
        self._effects = torch.cat([self._effects, effects.to(self._effects)])

    def estimate(self) -> tuple[Float[Tensor, " channels"], Float[Tensor, " channels"]]:
        """Effect of every channel, and its standard deviation: 0 for those measured."""
        chosen, factor, mean = torch.tensor(self.chosen), self._factor[:, : len(self.chosen)], self._effects.mean()
        residual = torch.linalg.solve_triangular(factor[chosen], (self._effects - mean)[:, None], upper=False)
        estimate = mean + (factor @ residual)[:, 0]
        estimate[chosen] = self._effects
        # the prior variance that makes what was measured most likely (eq. 5.8 solved for a factor of the kernel)
        deviation = (self._variance * (residual**2).mean()).sqrt()
        deviation[chosen] = 0
        return estimate, deviation

    def draws(self, count: int, *, generator: torch.Generator) -> Float[Tensor, "count channels"]:
        """Draw effects of every channel from the distribution conditional on those measured."""
        estimate, deviation = self.estimate()
        open_ = torch.nonzero(deviation > 0).flatten()
        if not len(open_):
            return estimate.repeat(count, 1)
        factor = self._factor[open_, : len(self.chosen)]
        covariance = self._kernel[open_][:, open_] - factor @ factor.T
        covariance.diagonal().add_(_JITTER)
        root, _ = torch.linalg.cholesky_ex(covariance)
        noise = torch.randn(count, len(open_), generator=generator, dtype=root.dtype).to(root.device)
        draws = estimate.repeat(count, 1)
        draws[:, open_] += deviation[open_[0]] / self._variance[open_[0]].sqrt() * (noise @ root.T)
        return draws


_FIRST = 0.3  # share of the budget spent before any effect is estimated
_ROUNDS = 6
_DRAWS = 16
_GROWTH = 1.25  # channels measured after a further round, over those before it
_SURE = 2  # allowed over expected shortfall; the true one was found to be up to 1.7 times the expected
_NEARLY_ALL = 0.75  # where so many would be measured, the rest costs little and leaves nothing to estimate


@dataclass(frozen=True, kw_only=True)
class Likeness:
    """Required likeness of a map from some of the channels to the exact one."""

    pearson_r: float = ALIKE_R
    """Correlation over the pixels."""
    top_overlap: float = ALIKE_TOP
    """Share of the strongest tenth of the pixels that is the exact map's too."""

    def __post_init__(self) -> None:
        for name in ("pearson_r", "top_overlap"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"the likeness requires a {name} of {getattr(self, name)}; give a number from 0 to 1")


@dataclass(frozen=True, kw_only=True)
class ChannelSearch:
    """Channels measured where they matter to the map, the supports of the others estimated from them.

    The supports are taken for a Gaussian process over the masks. Channels are measured in order of what an error of the
    support costs the map, times its standard deviation, from the second round on times the probability that it is above
    0 at all. The error is measured on maps that are made of supports drawn from the process: the exact map is one more
    such draw as far as anyone knows. The draws know what was left open under this kernel, not how wrong the kernel is,
    so rounds go on until what the map is expected to miss is half of what it may.

    Active are the channels whose mask is not empty, all layers in a row; the support of the others is `at_empty`.
    `measure` gives supports of channels in rising order (`Score.support`), `to_map` the map that weights make.
    """

    activations: Sequence[Float[Tensor, "_channels _rows _columns"]]
    process: GaussianProcess
    active: Int[Tensor, " some"]
    at_empty: Float[Tensor, ""]
    measure: Callable[[Int[Tensor, " part"]], Float[Tensor, " part"]]
    to_map: Callable[[list[Tensor]], Float[Tensor, "height width"]]
    seed: int

    def run(self, *, budget: float, likeness: Likeness | None) -> tuple[list[Tensor], Approximation]:
        """Weights >= 0 of each layer's channels, and what their map should have in common with the exact one.

        A share of the channels (`budget`, in (0, 1)) is measured at first, more until the likeness is reached.
        """
        count = min(len(self.active), max(1, math.ceil(budget * len(self.active))))
        first = math.ceil(_FIRST * count)
        rounds = min(_ROUNDS, max(1, count - first))
        self._explore(first)
        for step in range(1, rounds + 1):
            self._explore(first + (count - first) * step // rounds)
        while True:
            approximation = self._judge()
            if likeness is None or count == len(self.active) or _reached(approximation, likeness):
                return self._weights(self.process.estimate()[0]), approximation
            wanted = math.ceil(_GROWTH * count)
            count = len(self.active) if wanted > _NEARLY_ALL * len(self.active) else wanted
            self._explore(count)

    def _explore(self, until: int) -> None:
        """Measure channels until there are so many."""
        count = until - len(self.process.chosen)
        if count < 1:
            return
        chosen = self.process.choose(count, importance=self._importance().double())
        order = chosen.argsort()
        self.process.learn(self.measure(self.active[chosen[order]])[order.argsort()])

    def _judge(self) -> Approximation:
        """Estimate the likeness of the map to the exact one."""
        estimate, _ = self.process.estimate()
        result = self.to_map(self._weights(estimate))
        generator = torch.Generator().manual_seed(self.seed)
        drawn = [self.to_map(self._weights(supports)) for supports in self.process.draws(_DRAWS, generator=generator)]
        return Approximation(
            measured=len(self.process.chosen),
            channels=len(self.active),
            pearson_r=fmean(pearson_r(result, other) for other in drawn),
            top_overlap=fmean(top_overlap(result, other) for other in drawn),
        )

    def _importance(self) -> Tensor:
        """Return how much an error of each support changes the map."""
        norms = [maps.flatten(1).norm(dim=1) for maps in self.activations]
        if not self.process.chosen:
            return torch.cat([norm / norm.norm().clamp_min(FLOOR) for norm in norms])[self.active]
        estimate, deviation = self.process.estimate()
        layers = zip(norms, self.activations, self._weights(estimate), strict=True)
        shares = [norm / layer_map(maps, weights).norm().clamp_min(FLOOR) for norm, maps, weights in layers]
        odds = torch.special.ndtr(estimate / deviation.clamp_min(FLOOR))
        return torch.cat(shares)[self.active].clamp_max(1 / FLOOR) * odds

    def _weights(self, supports: Tensor) -> list[Tensor]:
        every = self.at_empty.to(supports).repeat(sum(map(len, self.activations)))
        every[self.active] = supports
        return list(torch.relu(every).to(self.at_empty.dtype).split([len(maps) for maps in self.activations]))


def _reached(approximation: Approximation, likeness: Likeness) -> bool:
    # not "short > allowed": of a map that holds NaN nothing is expected
    return all(
        _SURE * (1 - getattr(approximation, name)) <= 1 - getattr(likeness, name)
        for name in ("pearson_r", "top_overlap")
    )
