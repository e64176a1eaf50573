"""Novelty: strangeness of an input, by its features' distance from the training's and the spread of the prediction."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Annotated, TypeAlias

import numpy as np
import torch
from jaxtyping import Float
from msgspec import Meta
from torch import Tensor, nn

from sliplens.errors import ModelError
from sliplens.models.backbones import Answers, bin_edges
from sliplens.models.calibration import standard_deviation

_STRIDE = 8
"""Stride of the features: early enough to cost a third of a pass, and to respond to light, focus and print."""
_MOST_DIRECTIONS = 12
_LEAST_FRAMES = 40
_SHARES = (1.0, 0.8, 0.5, 0.3, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005)
"""Shares of the validation frames, for each of which `Novelty` keeps the strangeness that so many reach."""


_Positive: TypeAlias = Annotated[float, Meta(gt=0)]


@dataclass(frozen=True, kw_only=True)
class Novelty:
    """Distribution of the features of healthy frames: mean, principal directions, and the remaining variance.

    Features are the mean over the image of each channel of an early layer. The distance is that of Mahalanobis under
    probabilistic principal components, over the square root of the number of features: about 1 for frames like those
    it was fitted on.

    Lee, Lee, Lee and Shin, *A Simple Unified Framework for Detecting Out-of-Distribution Samples and Adversarial
    Attacks*, NeurIPS 2018; Tipping and Bishop, *Probabilistic Principal Component Analysis*, 1999.
    """

    layer: str
    """Path in the network of the module whose output is used."""
    mean: tuple[float, ...]
    scale: tuple[_Positive, ...]
    """Standard deviation of each feature."""
    directions: tuple[tuple[float, ...], ...]
    """Unit vectors, in scaled features."""
    variances: tuple[_Positive, ...]
    rest: _Positive
    """Variance along every other direction, a ratio to that of the feature."""
    limit: _Positive
    """Distance, a ratio to the usual one, that all but 0.5 % of the validation frames stay below."""
    frames: int
    """Validation frames."""
    spread_limit: float | None = None
    """Standard deviation of the prediction that the same frames stay below, in margin units; None for a network with
    one number as its output."""
    strangeness: tuple[float, ...] = _SHARES
    """Values of `measure_strangeness` that each share of `_SHARES` of the validation frames reaches."""

    def distance(self, features: Float[np.ndarray, "frames features"]) -> Float[np.ndarray, " frames"]:
        """Compute the distance of features from those of healthy frames."""
        unit = (features - np.array(self.mean)) / np.array(self.scale)
        directions = np.array(self.directions)
        along = unit @ directions.T
        rest = np.maximum((unit**2).sum(axis=1) - (along**2).sum(axis=1), 0)
        squared = (along**2 / np.array(self.variances)).sum(axis=1) + rest / self.rest
        return np.sqrt(squared / features.shape[1])

    def measure_strangeness(
        self, features: Float[np.ndarray, "frames features"], sigma: Float[np.ndarray, " frames"] | None
    ) -> Float[np.ndarray, " frames"]:
        """Return the larger of distance and spread, each over its limit."""
        distance = self.distance(features) / self.limit
        if sigma is None or self.spread_limit is None:
            return distance
        return np.maximum(distance, sigma / self.spread_limit)

    def known(
        self, features: Float[np.ndarray, "frames features"], sigma: Float[np.ndarray, " frames"] | None
    ) -> Float[np.ndarray, " frames"]:
        """Return the share of the validation frames that were as strange or stranger, as p values are.

        Beyond the strangest half percent the logarithm continues with the same slope.
        """
        levels, shares = np.array(self.strangeness), np.log(_SHARES)
        strange = self.measure_strangeness(features, sigma)
        slope = (shares[-1] - shares[-4]) / max(levels[-1] - levels[-4], 1e-6)
        beyond = shares[-1] + slope * np.maximum(strange - levels[-1], 0)
        return np.exp(np.where(strange > levels[-1], beyond, np.interp(strange, levels, shares)))


@torch.no_grad()
def find_layer(model: nn.Module, images: Float[Tensor, "batch colours height width"]) -> str | None:
    """Find the last module whose output has an eighth of the image's side; None if there is none."""
    layers: list[str] = []
    names = {module: name for name, module in model.named_modules() if name}
    side = images.shape[-1] / _STRIDE

    def record(module: nn.Module, _: object, output: object) -> None:
        if isinstance(output, Tensor) and output.ndim == 4 and 0.75 * side <= output.shape[-1] <= 1.25 * side:
            layers.append(names[module])

    handles = [module.register_forward_hook(record) for module in names]
    try:
        model(images.to(next(model.parameters()).device))
    finally:
        for handle in handles:
            handle.remove()
    # of nested modules the outermost, which returns last
    return layers[-1] if layers else None


def fit_novelty(model: nn.Module, train: Iterable[Tensor], validation: Iterable[Tensor]) -> Novelty | None:
    """Fit the features of batches of training frames, and set the limits by validation frames of other trials.

    None where the network has no suitable layer, or there are too few frames.
    """
    batches, others = list(train), list(validation)
    layer = find_layer(model, batches[0][:1]) if batches else None
    if layer is None or min(sum(map(len, batches)), sum(map(len, others))) < _LEAST_FRAMES:
        return None
    (*_, features), (margins, *probabilities, validation_features) = (
        [torch.cat(part).cpu().double().numpy() for part in zip(*Answers(model, layer).run(some), strict=True)]
        for some in (batches, others)
    )
    edges = bin_edges(model)
    sigma = None if edges is None else standard_deviation(margins, probabilities[0], edges)
    if not np.isfinite(features).all():
        raise ModelError(f"the layer {layer} of {type(model).__name__} returns NaN or infinity; train it again")
    mean, scale = features.mean(axis=0), features.std(axis=0)
    scale = np.maximum(scale, 1e-6 + 1e-3 * float(scale.max()))  # channels that are constant
    unit = (features - mean) / scale
    _, singular, directions = np.linalg.svd(unit, full_matrices=False)
    variances = singular**2 / len(unit)
    count, usual = min(_MOST_DIRECTIONS, len(variances) - 1), 1 - _SHARES[-1]
    novelty = Novelty(
        layer=layer,
        mean=_rounded(mean),
        scale=_rounded(scale),
        directions=tuple(_rounded(row) for row in directions[:count]),
        variances=_rounded(variances[:count]),
        rest=float(variances[count:].sum() / max(1, unit.shape[1] - count)) + 1e-6,
        limit=np.inf,
        frames=len(validation_features),
        spread_limit=None if sigma is None else float(np.quantile(sigma, usual)),
    )
    novelty = replace(novelty, limit=float(np.quantile(novelty.distance(validation_features), usual)))
    reached = np.quantile(novelty.measure_strangeness(validation_features, sigma), 1 - np.array(_SHARES))
    return replace(novelty, strangeness=_rounded(reached))


def _rounded(values: np.ndarray) -> tuple[float, ...]:
    """Round to five digits, since people read manifests."""
    return tuple(float(f"{value:.5g}") for value in values)
