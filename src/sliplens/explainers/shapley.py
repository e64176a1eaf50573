"""Shapley values: contribution of each marker or tile to the prediction, averaged over all coalitions."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from sliplens.errors import InputError
from sliplens.explainers.attribution import Attribution
from sliplens.explainers.contract import Comparison
from sliplens.explainers.gradients import IntegratedGradients
from sliplens.explainers.occlusion import RegionMethod, find_markers

_FEW = 20
"""Players of which all coalitions can be counted."""
_RANK = 1e-9
"""Singular value over the largest below which it is rounding: players that all count for more count for nothing."""
Value = Callable[[Bool[np.ndarray, "coalitions players"]], Float64[np.ndarray, " coalitions"]]
"""Worth of each coalition; True for players that take part."""


@dataclass(frozen=True, kw_only=True)
class ShapleyValues:
    """Contribution of each player, in the unit of the game; together they are the whole game's worth."""

    values: Float64[np.ndarray, " players"]
    standard_errors: Float64[np.ndarray, " players"]
    """Standard errors of the values from the sampled coalitions; 0 where all coalitions were evaluated."""


def shapley_values(
    value: Value,
    players: int,
    *,
    pairs: int,
    rng: np.random.Generator,
    guess: Float64[np.ndarray, " players"] | None = None,
) -> ShapleyValues:
    """Estimate the Shapley values of a game from pairs of coalitions, each with its complement.

    Values are those of the weighted least squares whose solution over all coalitions is the Shapley value, on sampled
    ones; games of pairs that help or hinder each other are solved exactly. Errors are the sandwich estimate.

    With a first guess the values are drawn towards a multiple of it, no farther than the noise of the coalitions asks
    for (empirical Bayes): a good guess saves most of the pairs, a poor one costs little.

    `pairs` are sampled, or all of them where there are no more, which is exact; at least twice as many as the players.

    Lundberg and Lee, *A Unified Approach to Interpreting Model Predictions* (2017), Theorem 2; Covert and Lee,
    *Improving KernelSHAP* (2021), section 4.2, for pairs; Patterson and Thompson (1971), restricted maximum
    likelihood, for how far to draw; Henderson (1975), best linear prediction, for the errors.
    """
    whole, empty = value(np.array([[True] * players, [False] * players])).tolist()
    if players == 1:
        return ShapleyValues(values=np.array([whole - empty]), standard_errors=np.zeros(1))
    exact = players <= _FEW and 2 ** (players - 1) - 1 <= pairs
    if not exact and pairs < 2 * players:
        raise InputError(
            f"{pairs} pairs of coalitions cannot distinguish {players} players; use at least {2 * players}"
        )
    members, weights = _all_pairs(players) if exact else _sample(players, pairs, rng)
    worth = value(np.concatenate([members, ~members])).reshape(2, -1)
    odd = (worth[0] - worth[1]) / 2
    # even shares first, so that the values add up to the worth of the whole; the members tell how they differ from that
    share = members.mean(axis=1)
    rest = odd - (share - 0.5) * (whole - empty)
    # the last column takes what the mere number of players does, a cubic that vanishes at both ends: its own Shapley
    # values are 0, and where an answer tips between few and many it is most of the noise
    number = (2 * share - 1) ** 3 - (2 * share - 1)
    root, centred = np.sqrt(weights), members - share[:, None]
    if guess is not None and not exact and np.ptp(guess):
        fixed = root[:, None] * np.column_stack([centred @ guess, number])
        differing, errors = _shrink(root[:, None] * centred, fixed, root * rest, guess)
    else:
        columns = np.column_stack([centred, number])
        solve = np.linalg.pinv(root[:, None] * columns, rcond=_RANK) * root
        differing = solve @ rest
        spread = (solve * (rest - columns @ differing)) ** 2 * len(odd) / max(len(odd) - players, 1)
        errors = np.zeros(players + 1) if exact else np.sqrt(spread.sum(axis=1))
    return ShapleyValues(values=differing[:players] + (whole - empty) / players, standard_errors=errors[:players])


def _shrink(
    columns: Float64[np.ndarray, "pairs players"],
    fixed: Float64[np.ndarray, "pairs 2"],
    worth: Float64[np.ndarray, " pairs"],
    guess: Float64[np.ndarray, " players"],
) -> tuple[Float64[np.ndarray, " players"], Float64[np.ndarray, " players"]]:
    """Coefficients, a multiple of the guess plus a ridge as wide as restricted likelihood says, and their errors."""
    basis = np.linalg.qr(fixed)[0]
    rest, inside = (values - basis @ (basis.T @ values) for values in (worth, columns))
    along, sizes, _ = np.linalg.svd(inside, full_matrices=False)
    projected = along.T @ rest
    freedom = len(worth) - fixed.shape[1]
    unexplained = max(float(rest @ rest - projected @ projected), 0.0)

    def variance(ridge: float) -> float:
        return float((unexplained + (projected**2 / (1 + sizes**2 / ridge)).sum()) / freedom)

    def doubt(log_ridge: float) -> float:
        ridge = np.exp(log_ridge)
        return freedom * np.log(variance(ridge) + 1e-300) + np.log1p(sizes**2 / ridge).sum()

    from scipy.optimize import fminbound  # noqa: PLC0415 (takes half a second)

    ridge = float(np.exp(fminbound(doubt, -12, 12)))
    # the multiple and the cubic are free, what players differ by from the multiple is drawn (Henderson's equations)
    design, players = np.column_stack([fixed, columns]), columns.shape[1]
    gram = design.T @ design + np.diag(np.r_[np.zeros(fixed.shape[1]), np.full(players, ridge)])
    fit = np.linalg.solve(gram, design.T)
    of_players = np.column_stack([guess, np.zeros(players), np.eye(players)])
    of_players -= of_players.mean(axis=0)
    solve = of_players @ fit
    # noise, and the part of each player that the shrinkage leaves
    noise = (solve * (worth - design @ (fit @ worth))) ** 2 * len(worth) / (len(worth) - np.trace(design @ fit))
    drawn = variance(ridge) / ridge * (solve @ columns - of_players[:, fixed.shape[1] :]) ** 2
    return solve @ worth, np.sqrt(noise.sum(axis=1) + drawn.sum(axis=1))


def _all_pairs(players: int) -> tuple[Bool[np.ndarray, "pairs players"], Float64[np.ndarray, " pairs"]]:
    """One coalition of each pair, those without the last player, and Shapley's kernel of each."""
    from scipy.special import comb  # noqa: PLC0415 (takes a tenth of a second)

    members = (np.arange(1, 2 ** (players - 1))[:, None] >> np.arange(players) & 1).astype(bool)
    sizes = members.sum(axis=1)
    return members, 1 / (comb(players, sizes) * sizes * (players - sizes))


def _sample(
    players: int, pairs: int, rng: np.random.Generator
) -> tuple[Bool[np.ndarray, "pairs players"], Float64[np.ndarray, " pairs"]]:
    """Coalitions of sizes drawn by the root of Shapley's kernel, each weighted by the same root.

    Drawn by the kernel itself, half of the coalitions are nearly empty or nearly whole, where the answer hardly varies.
    """
    sizes = np.arange(1, players)
    root = 1 / np.sqrt(sizes * (players - sizes))
    chance = np.cumsum(root) / root.sum()
    drawn = np.searchsorted(chance, (np.arange(pairs) + rng.uniform()) / pairs)
    members = rng.permuted(np.broadcast_to(np.arange(players), (pairs, players)), axis=1) < sizes[drawn, None]
    return members, root[drawn] / root.mean()


_GUESS = IntegratedGradients(steps=16, max_steps=16)
"""First guess, as good as complete Integrated Gradients at a quarter of the cost; 8 steps are too few."""
_UNSURE = 0.5
"""Standard error over the spread of the contributions, above which their order means little."""


@dataclass(frozen=True, kw_only=True)
class Shapley(RegionMethod):
    """Shapley values of tiles, or of markers where their places are given, signed and complete, in margin units.

    A region that does not take part is as in the reference. The relevance of a region is its Shapley value, spread
    evenly over its pixels, so that a map adds up to f(x) - f(b). Integrated Gradients of few steps, summed over each
    region, are the first guess of `shapley_values`. A warning says where the contributions are hardly surer than they
    differ.
    """

    tile_px: int = 28
    pairs: int = 200
    """Pairs of coalitions for each image, two passes of the network each."""

    @torch.no_grad()
    def _explain(self, comparison: Comparison) -> Attribution:
        engine = comparison.prepare(2 * self.pairs * len(comparison.images))
        unsure = []

        def contribute(index: int) -> Float[Tensor, "height width"]:
            image, empty = comparison.images[index], comparison.reference[index]
            with torch.enable_grad():
                gradients = _GUESS.integrate(comparison, index)[0].float().cpu().double()
            regions = self._regions(image, empty)
            # a number that no pixel has, such as that of what lies between markers which cover the image, is no player
            numbers, players = regions.unique(return_inverse=True)

            def worth(members: Bool[np.ndarray, "coalitions players"]) -> Float64[np.ndarray, " coalitions"]:
                taking_part = torch.from_numpy(members).to(image.device).split(engine.batch_size)
                batches = (torch.where(part[:, players][:, None], image, empty) for part in taking_part)
                return torch.cat(list(engine.run(batches))).cpu().double().numpy()

            rng = np.random.default_rng((0, index))
            guess = players.cpu().flatten().bincount(weights=gradients.flatten()).numpy()
            pairs = max(self.pairs, 2 * len(numbers))
            estimate = shapley_values(worth, len(numbers), pairs=pairs, rng=rng, guess=guess)
            unsure.append(float(np.sqrt((estimate.standard_errors**2).mean())) > _UNSURE * float(estimate.values.std()))
            shares = torch.from_numpy(estimate.values).to(image) / players.flatten().bincount()
            return shares[players]

        relevance = comparison.map_each(contribute)
        warning = (
            f"contributions hardly surer than they differ in {sum(unsure)} of {len(unsure)} frames; set more pairs"
        )
        return comparison.attribution(
            relevance,
            complete=True,
            target=f"f(x) - f(reference), shared out among {self._unit}",
            warnings=[warning] if any(unsure) else [],
            engine=engine.name,
        )


shapley_by_marker = partial(Shapley, markers_px=find_markers)
"""Shapley values of the markers that an image shows."""
