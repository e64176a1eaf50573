"""How Poly-CAM turns the predictions of masked images into the effect of a channel."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Variant:
    """Which of the two points of a channel's effect are measured."""

    keep: bool
    """Predict the image with only the channel's region kept."""
    remove: bool
    """Predict the image with the channel's region removed."""

    @property
    def passes(self) -> int:
        """Masked images a channel."""
        return self.keep + self.remove


VARIANTS = {
    "+": Variant(keep=True, remove=False),
    "-": Variant(keep=False, remove=True),
    "+/-": Variant(keep=True, remove=True),
}


@dataclass(frozen=True, kw_only=True)
class Predictions:
    """Predictions of one image and of its masked versions, in margin units."""

    image: Float[Tensor, ""]
    """f(x)."""
    reference: Float[Tensor, ""]
    """f(b)."""
    kept: Float[Tensor, " channels"] | None
    """f(b + (x - b) M) for each channel's mask M, or None where the variant has no such pass."""
    removed: Float[Tensor, " channels"] | None
    """f(b + (x - b)(1 - M)), or None."""


def regression_score(predictions: Predictions) -> Float[Tensor, " channels"]:
    """Effect of each channel's region in margin units: 0 for the empty mask, f(x) - f(b) for the full one.

    The mean of what the region adds to the reference, f(b + (x - b) M) - f(b), and of what the image loses without it,
    f(x) - f(b + (x - b)(1 - M)), or the one of them that was measured. Unlike a softmax or sigmoid of the output it
    is signed and does not saturate.
    """
    effects = []
    if predictions.kept is not None:
        effects.append(predictions.kept - predictions.reference)
    if predictions.removed is not None:
        effects.append(predictions.image - predictions.removed)
    return torch.stack(effects).mean(dim=0)


SCORES: dict[str, Callable[[Predictions], Tensor]] = {"regression": regression_score}
