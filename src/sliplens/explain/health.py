"""Sentences that tell a reader when a map should not be trusted."""

import torch
from jaxtyping import Float
from torch import Tensor

CLOSE = 0.02  # margin units; a difference below the regressor's own error explains nothing
GAP = 0.01  # share of |f(x) - f(reference)| that may stay unexplained


def check_maps(
    relevance: Float[Tensor, "batch height width"],
    *,
    prediction: Float[Tensor, " batch"],
    reference_prediction: Float[Tensor, " batch"],
    completeness_gap: Float[Tensor, " batch"] | None,
) -> tuple[str, ...]:
    """List what is wrong with each map, one sentence a finding, in the order of the images.

    Parameters
    ----------
    relevance
        Signed maps in margin units.
    prediction, reference_prediction
        f(x) and f(reference) in margin units.
    completeness_gap
        |sum of the relevance - (f(x) - f(reference))| in margin units, or None where it is not promised.
    """
    findings = []
    for index, (image_map, high, low) in enumerate(
        zip(relevance, prediction.tolist(), reference_prediction.tolist(), strict=True)
    ):
        change = high - low
        if abs(change) < CLOSE:
            findings.append(
                f"image {index}: f(x) = {high:.3g} is within {CLOSE} of f(reference) = {low:.3g}, "
                "so there is next to nothing to explain"
            )
        if not torch.isfinite(image_map).all():
            findings.append(f"image {index}: the map holds NaN or infinity and must not be shown or scored")
        elif not image_map.any():
            findings.append(f"image {index}: the map is zero everywhere and says nothing about the image")
        if completeness_gap is not None:
            gap = float(completeness_gap[index])
            if gap > GAP * abs(change):
                findings.append(
                    f"image {index}: the map leaves {gap:.2g} of f(x) - f(reference) = {change:.2g} unexplained, "
                    f"more than {GAP:.0%}"
                )
    return tuple(findings)
