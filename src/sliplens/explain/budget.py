"""Poly-CAM from some of the channels, chosen where they matter to the map, with the error that this leaves."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import fmean

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sliplens.errors import InputError
from sliplens.explain.explanation import Approximation
from sliplens.explain.health import ALIKE_R, ALIKE_TOP
from sliplens.explain.levels import layer_map
from sliplens.explain.maps import FLOOR, pearson_r, top_overlap
from sliplens.explain.sampling import Field

_FIRST = 0.3  # share of the budget spent before anything is known of the effects
_ROUNDS = 6
_DRAWS = 16
_GROWTH = 1.25  # channels measured after a further round, over those before it
_SURE = 2  # allowed over expected shortfall; the true one was found to be up to 1.7 times the expected
_NEARLY_ALL = 0.75  # where so many would be measured, the rest costs little and leaves nothing to estimate


@dataclass(frozen=True, kw_only=True)
class Likeness:
    """What a map from some of the channels should have in common with the exact one."""

    pearson_r: float = ALIKE_R
    """Correlation over the pixels."""
    top_overlap: float = ALIKE_TOP
    """Share of the strongest tenth of the pixels that is the exact map's too."""

    def __post_init__(self) -> None:
        for name in ("pearson_r", "top_overlap"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"the likeness asks for a {name} of {getattr(self, name)}; give a number from 0 to 1")


@dataclass(frozen=True, kw_only=True)
class Estimated:
    """The weights of all channels, most of them estimated."""

    weights: list[Tensor]
    """Of the channels of each layer, >= 0."""
    approximation: Approximation
    """What the map is expected to have in common with the exact one."""


def estimate_weights(
    activations: Sequence[Float[Tensor, "_channels _rows _columns"]],
    kernel: Float[Tensor, "some some"],
    *,
    active: Int[Tensor, " some"],
    budget: float,
    likeness: Likeness | None,
    at_empty: Float[Tensor, ""],
    measure: Callable[[Int[Tensor, " part"]], Float[Tensor, " part"]],
    to_map: Callable[[list[Tensor]], Float[Tensor, "height width"]],
    seed: int,
) -> Estimated:
    """Measure the support of some channels and estimate that of the others from it; a weight is the support, or 0.

    The supports are taken for a Gaussian process over the masks (`mask_kernel`). An error of a channel's support costs
    its layer's map the channel's activation, so channels are measured in order of the norm of the activation, over that
    of the layer's map, times the standard deviation of the support that the channels before leave; from the second
    round on times the probability that the support is above 0 at all, for the others have no weight.

    The error is measured on maps: 16 times the supports that were not measured are drawn from the process, given those
    that were, and the map is made of them. What these maps have in common with the result is what the exact map, one
    more such draw as far as anyone knows, is expected to have in common with it. The process's variance is fitted to
    what was measured, so a network whose answers the masks foretell badly gives a larger expected error; where a score
    is saturated and all are alike, nothing is left to estimate.

    Rounds go on after the budget is spent until what the map is expected to miss is half of what it may. The draws know
    what was left open under this kernel, not how wrong the kernel is: hence the half.

    Parameters
    ----------
    activations
        Of each layer, fine to coarse.
    kernel
        How alike the supports of the active channels should be.
    active
        Channels whose mask is not empty, all layers in a row.
    budget
        Share of them to measure at first, in (0, 1).
    likeness
        What the map should have in common with the exact one, for which more channels are measured, all if need be;
        None for those of the budget only.
    at_empty
        Support of a channel whose mask is empty.
    measure
        Supports of channels, in rising order; see `Score.support`.
    to_map
        The map that weights of each layer give.
    seed
        Of the draws.
    """
    search = _Search(activations, kernel, active=active, at_empty=at_empty, measure=measure, to_map=to_map, seed=seed)
    count = min(len(active), max(1, math.ceil(budget * len(active))))
    first = math.ceil(_FIRST * count)
    rounds = min(_ROUNDS, max(1, count - first))
    search.explore(first)
    for step in range(1, rounds + 1):
        search.explore(first + (count - first) * step // rounds)
    while True:
        found = search.judge()
        if likeness is None or count == len(active) or _reached(found, likeness):
            return Estimated(weights=search.weights(), approximation=found)
        wanted = math.ceil(_GROWTH * count)
        count = len(active) if wanted > _NEARLY_ALL * len(active) else wanted
        search.explore(count)


def _reached(found: Approximation, likeness: Likeness) -> bool:
    # not "short > allowed": of a map that holds NaN nothing is expected
    return all(
        _SURE * (1 - getattr(found, name)) <= 1 - getattr(likeness, name) for name in ("pearson_r", "top_overlap")
    )


class _Search:
    """The channels measured so far, and what they say of all."""

    def __init__(
        self,
        activations: Sequence[Tensor],
        kernel: Tensor,
        *,
        active: Tensor,
        at_empty: Tensor,
        measure: Callable[[Tensor], Tensor],
        to_map: Callable[[list[Tensor]], Tensor],
        seed: int,
    ) -> None:
        self._activations, self._active, self._at_empty = activations, active, at_empty
        self._measure, self._to_map, self._seed = measure, to_map, seed
        self._field = Field(kernel)
        self._norms = [one.flatten(1).norm(dim=1) for one in activations]
        self._dtype = kernel.dtype

    def explore(self, until: int) -> None:
        """Measure channels until there are so many."""
        count = until - len(self._field.chosen)
        if count < 1:
            return
        chosen = self._field.choose(count, importance=self._importance().to(self._dtype))
        order = chosen.argsort()
        supports = torch.empty(len(chosen), dtype=self._dtype, device=chosen.device)
        supports[order] = self._measure(self._active[chosen[order]]).to(supports)
        self._field.learn(supports)

    def weights(self) -> list[Tensor]:
        """Of the channels of each layer."""
        return self._weights(self._field.estimate()[0])

    def judge(self) -> Approximation:
        """What the map is expected to have in common with the exact one."""
        estimate, _ = self._field.estimate()
        result = self._to_map(self._weights(estimate))
        generator = torch.Generator().manual_seed(self._seed)
        drawn = [self._to_map(self._weights(supports)) for supports in self._field.draws(_DRAWS, generator=generator)]
        return Approximation(
            measured=len(self._field.chosen),
            channels=len(self._active),
            pearson_r=fmean(pearson_r(result, one) for one in drawn),
            top_overlap=fmean(top_overlap(result, one) for one in drawn),
        )

    def _importance(self) -> Tensor:
        """What an error of each support costs the map."""
        if not self._field.chosen:
            return torch.cat([norm / norm.norm().clamp_min(FLOOR) for norm in self._norms])[self._active]
        estimate, deviation = self._field.estimate()
        strength = torch.cat(
            [
                norm / layer_map(one, weights).norm().clamp_min(FLOOR)
                for norm, one, weights in zip(self._norms, self._activations, self._weights(estimate), strict=True)
            ]
        )[self._active]
        odds = estimate / deviation.clamp_min(FLOOR)
        return strength.clamp_max(1 / FLOOR) * torch.special.ndtr(odds)

    def _weights(self, supports: Tensor) -> list[Tensor]:
        every = self._at_empty.to(supports).repeat(sum(map(len, self._activations)))
        every[self._active] = supports
        return list(torch.relu(every).to(self._at_empty.dtype).split([len(one) for one in self._activations]))
