"""Poly-CAM from the effects of some channels, chosen where they matter to the map, with the error that this leaves."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sliplens.explain.explanation import Approximation
from sliplens.explain.levels import combine, layer_map
from sliplens.explain.maps import FLOOR, pearson_r, top_overlap
from sliplens.explain.sampling import Field
from sliplens.explain.scores import supporting_share

_FIRST = 0.3  # share of the budget spent before anything is known of the effects
_ROUNDS = 6
_DRAWS = 16


@dataclass(frozen=True, kw_only=True)
class Estimated:
    """The effects of all channels, most of them estimated."""

    effects: Float[Tensor, " channels"]
    """In margin units."""
    approximation: Approximation
    """What the map is expected to have in common with the exact one."""


def estimate_effects(
    activations: Sequence[Float[Tensor, "_channels _rows _columns"]],
    kernel: Float[Tensor, "some some"],
    *,
    active: Int[Tensor, " some"],
    budget: float,
    change: Float[Tensor, ""],
    measure: Callable[[Int[Tensor, " part"]], Float[Tensor, " part"]],
    size: tuple[int, int],
    seed: int,
) -> Estimated:
    """Measure the effects of some channels and estimate the others from them.

    The effects are taken for a Gaussian process over the masks (`mask_kernel`). An error of a channel's effect costs
    its layer's map the channel's activation, so channels are measured in order of the norm of the activation, over that
    of the layer's map, times the standard deviation of the effect that the channels before leave; from the second round
    on times the probability that the channel supports the change at all, for the others have no weight.

    The error is measured on maps: 16 times the effects that were not measured are drawn from the process, given those
    that were, and the map is made of them. What these maps have in common with the result is what the exact map, one
    more such draw as far as anyone knows, is expected to have in common with it. The process's variance is fitted to
    the measured effects, so a network whose effects the masks foretell badly gives a larger expected error.

    Parameters
    ----------
    activations
        Of each layer, fine to coarse.
    kernel
        How alike the effects of the active channels should be.
    active
        Channels whose effect is not known to be zero, all layers in a row.
    budget
        Share of them to measure, in (0, 1).
    change
        f(x) - f(b).
    measure
        Effects of channels, in rising order.
    size
        Height and width of the image in pixels.
    seed
        Of the draws.
    """
    sizes = [len(one) for one in activations]
    count = min(len(active), max(1, math.ceil(budget * len(active))))
    field = Field(kernel, capacity=count)
    norms = [one.flatten(1).norm(dim=1) for one in activations]
    importance = torch.cat([norm / norm.norm().clamp_min(FLOOR) for norm in norms])[active]
    first = math.ceil(_FIRST * count)
    rounds = min(_ROUNDS, max(1, count - first))
    stops = [first + (count - first) * step // rounds for step in range(1, rounds + 1)]

    def everywhere(effects: Tensor) -> list[Tensor]:
        spread = effects.new_zeros(sum(sizes))
        spread[active] = effects
        return list(supporting_share(spread, change=change.to(spread)).to(change.dtype).split(sizes))

    def explore(until: int, importance: Tensor) -> tuple[Tensor, Tensor]:
        if until > len(field.chosen):
            chosen = field.choose(until - len(field.chosen), importance=importance.to(kernel))
            order = chosen.argsort()
            effects = kernel.new_empty(len(chosen))
            effects[order] = measure(active[chosen[order]]).to(kernel)
            field.learn(effects)
        return field.estimate()

    estimate, deviation = explore(first, importance)
    for stop in stops:
        strength = torch.cat(
            [
                norm / layer_map(one, weights).norm().clamp_min(FLOOR)
                for norm, one, weights in zip(norms, activations, everywhere(estimate), strict=True)
            ]
        )[active]
        odds = estimate * change.sign() / deviation.clamp_min(FLOOR)
        importance = strength.clamp_max(1 / FLOOR) * torch.special.ndtr(odds)
        estimate, deviation = explore(stop, importance)
    result = combine(activations, everywhere(estimate), size=size)[0]
    drawn = [
        combine(activations, everywhere(effects), size=size)[0]
        for effects in field.draws(_DRAWS, generator=torch.Generator().manual_seed(seed))
    ]
    everything = estimate.new_zeros(sum(sizes))
    everything[active] = estimate
    return Estimated(
        effects=everything.to(change.dtype),
        approximation=Approximation(
            measured=count,
            channels=len(active),
            pearson_r=_mean(pearson_r(result, one) for one in drawn),
            top_overlap=_mean(top_overlap(result, one) for one in drawn),
        ),
    )


def _mean(values: Iterable[float]) -> float:
    found = list(values)
    return sum(found) / len(found)
