"""How sure a network may be: the temperature of its distribution, and intervals that hold as often as they say."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sliplens.errors import ModelError

LEVELS = (0.5, 0.68, 0.8, 0.9, 0.95)
"""Shares of the frames for which an interval is to hold."""
_COLDEST, _HOTTEST = -3.0, 3.0  # natural logarithms of the temperature


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Temperature and intervals, fitted on validation frames.

    Of a distribution, the interval of a level lies between its quantiles, widened by an offset (conformalised quantile
    regression); of one number, it is that number plus and minus the offset (split conformal). Both hold for the level's
    share of frames like those of the validation, and promise nothing for others.

    Vovk et al., *Algorithmic Learning in a Random World* (2005); Romano et al., *Conformalized Quantile Regression*
    (2019); Guo et al., *On Calibration of Modern Neural Networks* (2017), for the temperature.
    """

    temperature: float
    """What logits are divided by; 1 for a network that answers with one number."""
    offsets: dict[str, float]
    """Widening of each level's interval, in margin units; negative where quantiles were too far apart."""
    frames: int
    """Validation frames."""
    mse: float
    """Mean squared error of the answers to them, at this temperature (it moves the mean of a distribution a little)."""

    def __post_init__(self) -> None:
        if not self.temperature > 0:
            raise ModelError(f"the temperature of a calibration must be positive, got {self.temperature:g}")

    def offset(self, level: float) -> float:
        """Offset of a level."""
        if str(level) not in self.offsets:
            raise ModelError(f"there is no interval of level {level:g}; choose {', '.join(self.offsets)}")
        return self.offsets[str(level)]


@dataclass(frozen=True, kw_only=True)
class Traction:
    """What the second answer of a network, the traction ratio F_t / F_n, is and how it turns into a margin."""

    calibration: Calibration
    """Of the ratio; its errors are ratios, not margins."""
    told: Calibration
    """Of the margin where each validation trial's friction is told; the temperature is that of the first answer."""
    friction: tuple[float, ...]
    """Evenly spaced quantiles of the coefficient of friction over the training frames, from the least to the largest:
    what the network expects where it is told none."""

    def __post_init__(self) -> None:
        if not self.friction or min(self.friction) <= 0 or list(self.friction) != sorted(self.friction):
            raise ValueError("quantiles of friction are positive and rise")


def spread(
    values: Float[np.ndarray, " frames"],
    probabilities: Float[np.ndarray, "frames bins"],
    edges: Float[np.ndarray, " edges"],
) -> Float[np.ndarray, " frames"]:
    """Standard deviation of each distribution around a value, such as its mean."""
    squares = ((edges[1:] + edges[:-1]) / 2 - values[:, None]) ** 2
    return np.sqrt((probabilities * squares).sum(axis=1))


def fit_temperature(logits: Float[Tensor, "frames bins"], targets: Float[Tensor, "frames bins"]) -> float:
    """Temperature of least cross-entropy, by golden-section search on its logarithm; the loss is convex in 1/T."""

    def loss(log_temperature: float) -> float:
        return float(torch.nn.functional.cross_entropy(logits / float(np.exp(log_temperature)), targets))

    ratio, low, high = (np.sqrt(5) - 1) / 2, _COLDEST, _HOTTEST
    while high - low > 1e-4:
        left, right = high - ratio * (high - low), low + ratio * (high - low)
        low, high = (low, right) if loss(left) < loss(right) else (left, high)
    return float(np.exp((low + high) / 2))


def quantiles(
    probabilities: Float[np.ndarray, "frames bins"], edges: Float[np.ndarray, " edges"], share: float
) -> Float[np.ndarray, " frames"]:
    """Margin below which a share of each distribution lies; within a bin the distribution is even.

    `probabilities`: each row sums to 1; `share`: between 0 and 1.
    """
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
    """Interval of a level before it is widened: quantiles of each distribution, or the number itself, twice."""
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
    """By how much intervals must widen to hold for a share of the frames, a frame more counted as missed.

    `low`, `high`: intervals of validation frames; equal for one number.

    Romano et al. (2019), eq. 6 and 7.
    """
    missed = np.sort(np.maximum(low - margins, margins - high))
    rank = int(np.ceil(level * (len(missed) + 1)))
    return float(missed[min(rank, len(missed)) - 1])
