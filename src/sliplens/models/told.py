"""The margin once friction is told: a frame tells F_t / F_n, and what of it friction holds follows."""

from functools import lru_cache

import numpy as np
from jaxtyping import Float

from sliplens.friction import Friction

_DOUBT = 0.1
"""How likely it is beforehand, against 1, that the two answers or what is told do not fit together: then the ratio and
the friction that is told decide alone. Chosen on simulated days of selection; from 0.03 to 0.3 little changes."""
_RARE = 0.05
"""Least density of a friction in the training, over an even one: what was never met is rare, not impossible."""


def told_probabilities(
    margin: Float[np.ndarray, "frames bins"],
    ratio: Float[np.ndarray, "frames ratio_bins"],
    *,
    edges: Float[np.ndarray, " edges"],
    ratio_edges: Float[np.ndarray, " ratio_edges"],
    friction: Friction,
    trained_friction: Float[np.ndarray, " quantiles"],
) -> Float[np.ndarray, "frames bins"]:
    """Distribution over the margin where the friction is told, on the bins of the margin that was not told any.

    Of a frame x, a network answers with p(Gamma | x) and p(rho | x), rho = F_t / F_n, both as if friction were drawn as
    in its training, from pi. Friction and margin tell the ratio, rho = mu (1 - Gamma), so that friction drawn from q
    instead gives

        p(Gamma | x, q) ~ p(Gamma | x) * integral over mu of q(mu) / pi(mu) * p(rho = mu (1 - Gamma) | x) * (1 - Gamma),

    the Jacobian last. Told nothing (q = pi) this is p(Gamma | x) itself; told all, what the ratio and friction leave of
    it. Beside it stands the closed form alone, Gamma = 1 - rho / mu cut to [0, 1], for what does not fit together:
    a ratio beyond what the friction that is told can hold is a margin of 0.

    Parameters
    ----------
    margin, ratio
        Probabilities of each frame, over the margin and over F_t / F_n; rows sum to 1.
    edges, ratio_edges
        Edges of their bins, each of one width.
    friction
        What is told.
    trained_friction
        Evenly spaced quantiles of the friction coefficients in the training, from the least to the largest.
    """
    fits, alone = _kernels(friction, tuple(edges), tuple(ratio_edges), tuple(trained_friction))
    posterior = margin * (ratio @ fits) + _DOUBT * (ratio @ alone)
    return posterior / posterior.sum(axis=1, keepdims=True)


@lru_cache(maxsize=16)  # a running sensor asks for the same friction frame by frame
def _kernels(
    friction: Friction, edges: tuple[float, ...], ratio_edges: tuple[float, ...], trained_friction: tuple[float, ...]
) -> tuple[Float[np.ndarray, "ratio_bins bins"], Float[np.ndarray, "ratio_bins bins"]]:
    """What a ratio in each bin says of each margin where the margin's own answer counts too, and where it does not."""
    centres, ratio_centres = _middles(np.array(edges)), _middles(np.array(ratio_edges))
    # labels at 0 and 1 reach into bins beyond them, which mean the ends
    left = 1 - np.clip(centres, 0, 1)
    values, weights = friction.nodes
    fits, alone = np.zeros((len(ratio_centres), len(centres))), np.zeros((len(ratio_centres), len(centres)))
    for value, weight, density in zip(values, weights, _density(values, np.array(trained_friction)), strict=True):
        fits += weight / density * _between(value * left, ratio_centres).T
        alone += weight * _between(np.clip(1 - ratio_centres / value, 0, 1), centres)
    # a full stick leaves nothing to compare: half a bin keeps its Jacobian from being none
    fits *= np.maximum(left, (edges[1] - edges[0]) / 2) / (ratio_edges[1] - ratio_edges[0])
    return fits, alone


def _middles(edges: Float[np.ndarray, " edges"]) -> Float[np.ndarray, " bins"]:
    return (edges[1:] + edges[:-1]) / 2


def _between(
    values: Float[np.ndarray, " values"], centres: Float[np.ndarray, " bins"]
) -> Float[np.ndarray, "values bins"]:
    """Shares of the two bins whose middles a value lies between; of the last one beyond the ends."""
    at = (np.clip(values, centres[0], centres[-1])[:, None] - centres) / (centres[1] - centres[0])
    return np.clip(1 - np.abs(at), 0, None)


def _density(
    values: Float[np.ndarray, " values"], quantiles: Float[np.ndarray, " quantiles"]
) -> Float[np.ndarray, " values"]:
    """Density of friction in the training, even between its quantiles."""
    # frictions that many trials share have a width of their own, else the density would be infinite
    widths = np.maximum(np.diff(quantiles), 1e-2)
    share = 1 / (len(quantiles) - 1)
    at = np.searchsorted(quantiles, values, side="right") - 1
    inside = (values >= quantiles[0]) & (values <= quantiles[-1])
    even = 1 / max(quantiles[-1] - quantiles[0], 1e-2)
    density = np.where(inside, share / widths[np.clip(at, 0, len(widths) - 1)], 0)
    return np.maximum(density, _RARE * even)
