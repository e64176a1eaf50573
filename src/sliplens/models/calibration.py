"""Calibration: temperature, conformal intervals, and the margin under a known friction."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Float
from msgspec import Meta
from torch import Tensor

from sliplens.friction import Friction
from sliplens.models.backbones import bin_centres, histogram_targets

LEVELS = (0.5, 0.68, 0.8, 0.9, 0.95)
"""Shares of the frames for which an interval is to hold."""
_TEMPERATURES = -3.0, 3.0  # natural logarithms


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Temperature and intervals, fitted on validation frames.

    Of a distribution, the interval of a level lies between its quantiles, widened by an offset (conformalised quantile
    regression); of one number, it is that number plus and minus the offset (split conformal). Both hold for the level's
    share of frames like those of the validation, and promise nothing for others.

    Vovk et al., *Algorithmic Learning in a Random World* (2005); Romano et al., *Conformalized Quantile Regression*
    (2019); Guo et al., *On Calibration of Modern Neural Networks* (2017), for the temperature.
    """

    temperature: Annotated[float, Meta(gt=0)]
    """Divisor of the logits; 1 for a network with one number as its output."""
    offsets: dict[str, float]
    """Widening of each level's interval, in margin units; negative where quantiles were too far apart."""
    frames: int
    """Validation frames."""
    mse: float
    """Mean squared error of the answers to them, at this temperature (it moves the mean of a distribution a little)."""


@dataclass(frozen=True, kw_only=True)
class Traction:
    """Calibration of the second output, the traction ratio F_t / F_n, and facts to turn it into a margin."""

    calibration: Calibration
    """Of the ratio; its errors are ratios, not margins."""
    known_friction: Calibration
    """Calibration of the margin under each validation trial's known friction; the temperature is that of the margin."""
    friction: Annotated[tuple[Annotated[float, Meta(gt=0)], ...], Meta(min_length=1)]
    """Evenly spaced quantiles of the coefficient of friction over the training frames, from the least to the largest:
    the prior of the network where no friction is known."""


def standard_deviation(
    values: Float[np.ndarray, " frames"],
    probabilities: Float[np.ndarray, "frames bins"],
    edges: Float[np.ndarray, " edges"],
) -> Float[np.ndarray, " frames"]:
    """Compute the standard deviation of each distribution around a value, such as its mean."""
    squares = (bin_centres(edges) - values[:, None]) ** 2
    return np.sqrt((probabilities * squares).sum(axis=1))


def fit_temperature(logits: Float[Tensor, "frames bins"], targets: Float[Tensor, "frames bins"]) -> float:
    """Find the temperature of least cross-entropy; the loss is convex in 1/T."""

    def loss(log_temperature: float) -> float:
        return float(torch.nn.functional.cross_entropy(logits / float(np.exp(log_temperature)), targets))

    from scipy.optimize import minimize_scalar  # noqa: PLC0415 (it takes long to import)

    fitted = minimize_scalar(loss, bounds=_TEMPERATURES, method="bounded", options={"xatol": 1e-4})
    return float(np.exp(fitted.x))  # pyright: ignore[reportAttributeAccessIssue]


def quantiles(
    probabilities: Float[np.ndarray, "frames bins"], edges: Float[np.ndarray, " edges"], share: float
) -> Float[np.ndarray, " frames"]:
    """Return the margin below which a share, from 0 to 1, of each distribution lies; a bin is even inside."""
    below = np.concatenate([np.zeros((len(probabilities), 1)), np.cumsum(probabilities, axis=1)], axis=1)
    below /= below[:, -1:]
    at = np.clip((below <= share).sum(axis=1) - 1, 0, probabilities.shape[1] - 1)
    rows = np.arange(len(probabilities))
    inside = np.maximum(below[rows, at + 1] - below[rows, at], 1e-12)
    part = np.clip((share - below[rows, at]) / inside, 0, 1)
    return edges[at] + part * (edges[at + 1] - edges[at])


def raw_interval(
    margin: Float[np.ndarray, " frames"],
    probabilities: Float[np.ndarray, "frames bins"] | None,
    edges: Float[np.ndarray, " edges"] | None,
    level: float,
) -> tuple[Float[np.ndarray, " frames"], Float[np.ndarray, " frames"]]:
    """Return the interval of a level before it is widened: quantiles of each distribution, or the number twice."""
    if probabilities is None or edges is None:
        return margin, margin
    return quantiles(probabilities, edges, (1 - level) / 2), quantiles(probabilities, edges, (1 + level) / 2)


def conformal_offset(
    low: Float[np.ndarray, " frames"],
    high: Float[np.ndarray, " frames"],
    margins: Float[np.ndarray, " frames"],
    *,
    level: float,
) -> float:
    """Compute by how much intervals must widen to hold for a share of the frames, one more counted as missed.

    Romano et al. (2019), eq. 6 and 7.
    """
    missed = np.sort(np.maximum(low - margins, margins - high))
    rank = int(np.ceil(level * (len(missed) + 1)))
    return float(missed[min(rank, len(missed)) - 1])


def calibrate_histogram(
    logits: Float[Tensor, "frames bins"],
    edges: Tensor,
    temperature: Tensor,
    labels: Float[Tensor, " frames"],
    *,
    calibration: Calibration | None = None,
) -> tuple[Calibration, Float[np.ndarray, "frames bins"]]:
    """Fit the temperature of a histogram in place; return its calibration and its probabilities.

    `calibration`: an earlier one that is to stay, with its temperature; fitted if None.
    """
    if calibration is None:
        temperature.fill_(fit_temperature(logits, histogram_targets(labels, edges.cpu())))
    probabilities = torch.softmax(logits / temperature.cpu(), dim=-1).double().numpy()
    numbers = edges.cpu().double().numpy()
    values = probabilities @ bin_centres(numbers)
    if calibration is None:
        calibration = conformal_calibration(values, probabilities, numbers, labels, temperature=float(temperature))
    return calibration, probabilities


def conformal_calibration(
    values: Float[np.ndarray, " frames"],
    probabilities: Float[np.ndarray, "frames bins"] | None,
    edges: Float[np.ndarray, " edges"] | None,
    labels: Float[Tensor, " frames"],
    *,
    temperature: float,
) -> Calibration:
    """Calibrate intervals on validation frames, so that each level holds for its share of them."""
    truth = labels.double().numpy()
    ends = {level: raw_interval(values, probabilities, edges, level) for level in LEVELS}
    return Calibration(
        temperature=temperature,
        offsets={str(level): conformal_offset(*ends[level], truth, level=level) for level in LEVELS},
        frames=len(truth),
        mse=float(np.mean((values - truth) ** 2)),
    )


_DOUBT = 0.1
"""Prior odds that the two outputs and the friction contradict each other: then the ratio and the friction decide alone.
Chosen on simulated days of selection; from 0.03 to 0.3 little changes."""
_RARE = 0.05
"""Least density of a friction in the training, over an even one: an unseen friction is rare, not impossible."""


def condition_on_friction(
    margin: Float[np.ndarray, "frames bins"],
    ratio: Float[np.ndarray, "frames ratio_bins"],
    *,
    edges: Float[np.ndarray, " edges"],
    ratio_edges: Float[np.ndarray, " ratio_edges"],
    friction: Friction,
    trained_friction: Float[np.ndarray, " quantiles"],
) -> Float[np.ndarray, "frames bins"]:
    """Compute the distribution over the margin under a known friction, on the bins of the margin.

    For a frame x, a network predicts p(Gamma | x) and p(rho | x), rho = F_t / F_n, both with friction drawn as in its
    training, from pi. Friction and margin give the ratio, rho = mu (1 - Gamma), so that friction drawn from q instead
    gives

        p(Gamma | x, q) ~ p(Gamma | x) * integral over mu of q(mu) / pi(mu) * p(rho = mu (1 - Gamma) | x) * (1 - Gamma),

    the Jacobian last. With the friction of the training (q = pi) this is nearly p(Gamma | x). Beside it stands the
    closed form alone, Gamma = 1 - rho / mu cut to [0, 1], for outputs that contradict the friction: a ratio above the
    friction is a margin of 0.

    `trained_friction`: evenly spaced quantiles of the friction coefficients in the training.
    """
    fits, alone = _kernels(friction, tuple(edges), tuple(ratio_edges), tuple(trained_friction))
    posterior = margin * (ratio @ fits) + _DOUBT * (ratio @ alone)
    return posterior / posterior.sum(axis=1, keepdims=True)


@lru_cache(maxsize=16)  # a running sensor asks for the same friction frame by frame
def _kernels(
    friction: Friction, edges: tuple[float, ...], ratio_edges: tuple[float, ...], trained_friction: tuple[float, ...]
) -> tuple[Float[np.ndarray, "ratio_bins bins"], Float[np.ndarray, "ratio_bins bins"]]:
    """Compute the likelihood of each margin by ratio bin, with the network's own margin and without it."""
    centres, ratio_centres = bin_centres(np.array(edges)), bin_centres(np.array(ratio_edges))
    # labels at 0 and 1 reach into bins beyond them, which mean the ends
    used = 1 - np.clip(centres, 0, 1)
    values, weights = friction.nodes
    fits = _between(values[:, None] * used, ratio_centres, weights / _density(values, np.array(trained_friction))).T
    alone = _between(np.clip(1 - ratio_centres / values[:, None], 0, 1), centres, weights)
    # a full stick leaves nothing to compare: half a bin keeps its Jacobian from being none
    fits *= np.maximum(used, (edges[1] - edges[0]) / 2) / (ratio_edges[1] - ratio_edges[0])
    return fits, alone


def _between(
    values: Float[np.ndarray, "draws values"], centres: Float[np.ndarray, " bins"], weights: Float[np.ndarray, " draws"]
) -> Float[np.ndarray, "values bins"]:
    """Share each value out to the two bins around it, beyond the ends to the last bin; sum over draws."""
    at = (np.clip(values, centres[0], centres[-1]) - centres[0]) / (centres[1] - centres[0])
    below = np.minimum(at.astype(int), len(centres) - 2)
    rows, table = len(centres) * np.arange(values.shape[1]), np.zeros(values.shape[1] * len(centres))
    for place, share in ((below, 1 + below - at), (below + 1, at - below)):
        table += np.bincount((rows + place).ravel(), (weights[:, None] * share).ravel(), minlength=len(table))
    return table.reshape(-1, len(centres))


def _density(
    values: Float[np.ndarray, " values"], quantiles: Float[np.ndarray, " quantiles"]
) -> Float[np.ndarray, " values"]:
    """Compute the density of friction in the training, even between its quantiles."""
    # frictions that many trials share get a width, else the density would be infinite
    widths = np.maximum(np.diff(quantiles), 1e-2)
    share = 1 / (len(quantiles) - 1)
    at = np.searchsorted(quantiles, values, side="right") - 1
    inside = (values >= quantiles[0]) & (values <= quantiles[-1])
    even = 1 / max(quantiles[-1] - quantiles[0], 1e-2)
    density = np.where(inside, share / widths[np.clip(at, 0, len(widths) - 1)], 0)
    return np.maximum(density, _RARE * even)
