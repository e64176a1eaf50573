"""Distance of an input from what a network was trained on, in the network's own features."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from sliplens.errors import ModelError

_STRIDE = 8
"""Of the features: early enough to cost a third of a pass, and to see light, focus and print."""
_MOST_DIRECTIONS = 12
_LEAST_FRAMES = 40
_HEALTHY_SHARE = 0.995


@dataclass(frozen=True, kw_only=True)
class Novelty:
    """Where the features of healthy frames lie: their mean, the directions in which they vary, and what is left.

    Features are the mean over the image of each channel of an early layer. The distance is that of Mahalanobis under
    probabilistic principal components, over the square root of the number of features: about 1 for frames like those
    it was fitted on.

    Lee, Lee, Lee and Shin, *A Simple Unified Framework for Detecting Out-of-Distribution Samples and Adversarial
    Attacks*, NeurIPS 2018; Tipping and Bishop, *Probabilistic Principal Component Analysis*, 1999.
    """

    layer: str
    """Module whose output is looked at, by its path in the network."""
    mean: tuple[float, ...]
    scale: tuple[float, ...]
    """Standard deviation of each feature."""
    directions: tuple[tuple[float, ...], ...]
    """Unit vectors, in scaled features."""
    variances: tuple[float, ...]
    rest: float
    """Variance along every other direction, a ratio to that of the feature."""
    limit: float
    """Distance, a ratio to the usual one, that all but 0.5 % of the validation frames stay below."""
    frames: int
    """Validation frames."""

    def __post_init__(self) -> None:
        width = len(self.mean)
        if {len(self.scale), *map(len, self.directions)} - {width} or len(self.variances) != len(self.directions):
            raise ValueError("mean, scale and directions of features are of different lengths")
        if not min(*self.scale, *self.variances, self.rest, 1.0) > 0:
            raise ValueError("deviations and variances of features are positive")

    def distance(self, features: Float[np.ndarray, "frames features"]) -> Float[np.ndarray, " frames"]:
        """Distance of features, as `read_features` gives them."""
        unit = (features - np.array(self.mean)) / np.array(self.scale)
        directions = np.array(self.directions)
        along = unit @ directions.T
        left = np.maximum((unit**2).sum(axis=1) - (along**2).sum(axis=1), 0)
        squared = (along**2 / np.array(self.variances)).sum(axis=1) + left / self.rest
        return np.sqrt(squared / features.shape[1])


class _Enough(Exception):  # noqa: N818 (no error: it ends a pass early)
    """The layer that was waited for has answered."""


@torch.no_grad()
def read_features(
    model: nn.Module, layer: str, images: Float[Tensor, "batch colours height width"]
) -> Float[np.ndarray, "batch features"]:
    """Mean over the image of each channel of a layer; what comes after it is not run."""
    kept: list[Tensor] = []

    def keep(_: nn.Module, __: object, output: Tensor) -> None:
        kept.append(output.mean(dim=(2, 3)))
        raise _Enough

    handle = model.get_submodule(layer).register_forward_hook(keep)
    try:
        model(images.to(next(model.parameters()).device))
    except _Enough:
        pass
    finally:
        handle.remove()
    return kept[0].double().cpu().numpy()


@torch.no_grad()
def find_layer(model: nn.Module, images: Float[Tensor, "batch colours height width"]) -> str | None:
    """Last module of those that answer with an eighth of the image's side; None where none does."""
    found: list[str] = []
    names = {module: name for name, module in model.named_modules() if name}
    side = images.shape[-1] / _STRIDE

    def look(module: nn.Module, _: object, output: object) -> None:
        if isinstance(output, Tensor) and output.ndim == 4 and 0.75 * side <= output.shape[-1] <= 1.25 * side:
            found.append(names[module])

    handles = [module.register_forward_hook(look) for module in names]
    try:
        model(images.to(next(model.parameters()).device))
    finally:
        for handle in handles:
            handle.remove()
    # of modules within each other the outermost, which answers last
    return found[-1] if found else None


def fit_novelty(model: nn.Module, train: Iterable[Tensor], validation: Iterable[Tensor]) -> Novelty | None:
    """Fit the features of training frames; the limit is from validation frames, of other trials.

    `model` is in evaluation mode; `train`, `validation`: batches of encoded frames, (batch, 3, size, size). None where
    the network has no layer to look at, or there are too few frames.
    """
    batches = list(train)
    layer = find_layer(model, batches[0][:1]) if batches else None
    if layer is None:
        return None
    features, held = (
        np.concatenate([read_features(model, layer, batch) for batch in part] or [np.zeros((0, 1))])
        for part in (batches, validation)
    )
    if min(len(features), len(held)) < _LEAST_FRAMES:
        return None
    if not np.isfinite(features).all():
        raise ModelError(f"the layer {layer} of {type(model).__name__} answers with numbers that are not finite")
    mean, scale = features.mean(axis=0), features.std(axis=0)
    scale = np.maximum(scale, 1e-6 + 1e-3 * float(scale.max()))  # channels that never answer
    unit = (features - mean) / scale
    _, spread, directions = np.linalg.svd(unit, full_matrices=False)
    variances = spread**2 / len(unit)
    kept = min(_MOST_DIRECTIONS, len(variances) - 1)
    begun = Novelty(
        layer=layer,
        mean=_rounded(mean),
        scale=_rounded(scale),
        directions=tuple(_rounded(row) for row in directions[:kept]),
        variances=_rounded(variances[:kept]),
        rest=float(variances[kept:].sum() / max(1, unit.shape[1] - kept)) + 1e-6,
        limit=np.inf,
        frames=len(held),
    )
    limit = float(np.quantile(begun.distance(held), _HEALTHY_SHARE))
    return Novelty(**{**vars(begun), "limit": limit})


def _rounded(values: np.ndarray) -> tuple[float, ...]:
    """Five digits: a manifest is read by people."""
    return tuple(float(f"{value:.5g}") for value in values)
