"""Poly-CAM for a regressor: channel masks, scored by what they keep and what they remove."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Shaped
from torch import Tensor, nn

from sliplens.errors import InputError
from sliplens.explain.clock import Clock
from sliplens.explain.explanation import Explanation, Level, Progress
from sliplens.explain.health import check_maps
from sliplens.explain.layers import Layer, capture, find_layers
from sliplens.explain.maps import FLOOR, resize, to_masks
from sliplens.explain.scores import SCORES, VARIANTS, Predictions, Variant
from sliplens.explain.subject import Subject, explaining


@dataclass(frozen=True, kw_only=True)
class PolyCam:
    """Poly-CAM with the regression score.

    A channel's mask M (its activation between its extreme percentiles, resized to the image) blends the image x with
    the reference b. Its effect in margin units is measured at one or both ends,

        kept     f(b + (x - b) M) - f(b)                "+"
        removed  f(x) - f(b + (x - b) (1 - M))          "-"

    and their mean is "+/-": 0 for the empty mask, f(x) - f(b) for the full one. A channel's weight is
    relu(effect / (f(x) - f(b))), which is the supporting part relu(sign(f(x) - f(b)) effect) over |f(x) - f(b)|; the
    division changes no map, since each is normalised, and keeps the numbers clear of the floor of 1e-12 below.

    A layer's map is relu(sum of weight x activation). From the last layer to the first it is divided by itself
    resized to the coarser result and back, then multiplied by that result. The finest product, normalised like a
    mask, is the saliency.

    The relevance is that saliency scaled to add up to f(x) - f(b). The scaling is a convention, not a property of the
    method: it gives the map the sign and unit of the others, and says nothing about how much one pixel contributes.

    Parameters
    ----------
    variant
        "+", "-" or "+/-"; the last costs two passes a channel, the others one.
    score
        What the masked predictions are turned into, a key of `SCORES`.
    layers
        Names of the layers; by default those that `find_layers` finds.
    batch_size
        Masked images in one pass.
    levels
        Keep the saliency and the weights of each layer in the explanation.

    References
    ----------
    Englebert, Cornu and De Vleeschouwer, *Poly-CAM: High resolution class activation map for convolutional neural
    networks*, ICPR 2022. The regression score is ours.
    """

    variant: str = "+/-"
    score: str = "regression"
    layers: tuple[str, ...] | None = None
    batch_size: int = 64
    levels: bool = False

    def __post_init__(self) -> None:
        if self.variant not in VARIANTS:
            raise InputError(f"Poly-CAM has no variant {self.variant!r}; choose among {', '.join(VARIANTS)}")
        if self.score not in SCORES:
            raise InputError(f"Poly-CAM has no score {self.score!r}; choose among {', '.join(SCORES)}")
        if self.batch_size < 1:
            raise InputError(f"Poly-CAM's batch_size is {self.batch_size}; give at least 1")

    def __call__(
        self,
        model: nn.Module,
        images: Shaped[Tensor, "*batch channels height width"],
        *,
        reference: Shaped[Tensor, "..."] | None = None,
        on_progress: Progress | None = None,
    ) -> Explanation:
        """Explain a batch; see `Explainer` for the arguments and errors. Progress counts channels of every image."""
        clock = Clock()
        with explaining(model, images, reference=reference) as subject, torch.no_grad():
            layers = find_layers(model, subject.images[:1], names=self.layers)
            count = _Count(total=len(subject.images) * sum(layer.channels for layer in layers), report=on_progress)
            findings: list[str] = []
            results = []
            for index in range(len(subject.images)):
                activations = _activations(subject, index, layers)
                weights = [self._weights(subject, index, a, count=count) for a in activations]
                findings += _check_weights(index, layers, weights, change=float(subject.change[index]))
                results.append((weights, combine(activations, weights, size=_size(subject.images))))
            levels = tuple(
                Level(
                    layer=layer.name,
                    saliency=torch.stack([saliencies[depth] for _, saliencies in results]).float(),
                    weights=torch.stack([weights[depth] for weights, _ in results]).float(),
                )
                for depth, layer in enumerate(layers)
            )
            exact = _scale(torch.stack([saliencies[0] for _, saliencies in results]), total=subject.change)
            gap = (exact.sum(dim=(1, 2)) - subject.change).abs().float()
            relevance = exact.float()
        return Explanation(
            relevance=relevance,
            method="poly-cam",
            target="f(x) - f(reference)",
            prediction=subject.prediction.float(),
            reference_prediction=subject.reference_prediction.float(),
            completeness_gap=gap,
            seconds=clock.seconds(relevance),
            warnings=(
                *check_maps(
                    relevance,
                    prediction=subject.prediction,
                    reference_prediction=subject.reference_prediction,
                    completeness_gap=gap,
                ),
                *findings,
            ),
            levels=levels if self.levels else (),
        )

    def _weights(
        self, subject: Subject, index: int, activations: Float[Tensor, "channels rows columns"], *, count: "_Count"
    ) -> Float[Tensor, " channels"]:
        """Share of f(x) - f(b) that each channel's region supports, >= 0."""
        masks = to_masks(activations)
        # an empty mask keeps nothing and removes nothing, so its effect is 0 without a pass; NaN is kept
        active = torch.nonzero((masks != 0).flatten(1).any(dim=1)).flatten()
        count.add(len(masks) - len(active))
        effects = masks.new_zeros(len(masks))
        variant = VARIANTS[self.variant]
        for part in active.split(max(1, self.batch_size // variant.passes)):
            effects[part] = SCORES[self.score](_predictions(subject, index, masks[part], variant=variant))
            count.add(len(part))
        change = subject.change[index]
        return torch.relu(effects / change) if change else torch.zeros_like(effects)


def combine(
    activations: list[Float[Tensor, "_channels _rows _columns"]],
    weights: list[Float[Tensor, " _channels"]],
    *,
    size: tuple[int, int],
) -> list[Float[Tensor, "height width"]]:
    """Turn the channel weights of every layer into one saliency a layer, in [0, 1], resized to the image.

    Parameters
    ----------
    activations, weights
        Those of each layer, fine to coarse.
    size
        Height and width of the image in pixels.
    """
    saliencies = []
    coarser: Tensor | None = None
    for activation, weight in zip(reversed(activations), reversed(weights), strict=True):
        product = torch.relu(torch.einsum("c,chw->hw", weight, activation))
        if coarser is not None:
            here, there = _size(product), _size(coarser)
            local = product / resize(resize(product, there), here).clamp_min(FLOOR)
            product = torch.relu(local * resize(coarser, here))
        saliencies.append(resize(to_masks(product), size))
        coarser = product
    return saliencies[::-1]


def _activations(subject: Subject, index: int, layers: tuple[Layer, ...]) -> list[Tensor]:
    with capture(subject.model, [layer.name for layer in layers]) as outputs:
        subject.predict(subject.images[index, None])
    return [outputs[layer.name][0] for layer in layers]


def _predictions(subject: Subject, index: int, masks: Tensor, *, variant: Variant) -> Predictions:
    image, reference = subject.images[index], subject.reference[index]
    masked = (image - reference) * resize(masks, _size(image))[:, None]
    blends = [reference + masked] * variant.keep + [image - masked] * variant.remove
    # channels last: convolutions on a CPU then need no reordering, about a fifth faster with the same result
    batch = torch.cat(blends).contiguous(memory_format=torch.channels_last)
    outputs = iter(subject.predict(batch).split(len(masks)))
    return Predictions(
        image=subject.prediction[index],
        reference=subject.reference_prediction[index],
        kept=next(outputs) if variant.keep else None,
        removed=next(outputs) if variant.remove else None,
    )


def _scale(saliencies: Tensor, *, total: Tensor) -> Tensor:
    sums = saliencies.sum(dim=(1, 2))
    factor = torch.where(sums == 0, torch.zeros_like(sums), total / sums)
    return saliencies * factor[:, None, None]


def _check_weights(index: int, layers: tuple[Layer, ...], weights: list[Tensor], *, change: float) -> list[str]:
    findings = []
    for layer, weight in zip(layers, weights, strict=True):
        bad = int((~weight.isfinite()).sum())
        if bad:
            findings.append(
                f"image {index}: {bad} of {len(weight)} channels of layer {layer.name} have no finite weight, "
                "so the model cannot predict every masked image"
            )
        elif change and not weight.any():
            findings.append(
                f"image {index}: no channel of layer {layer.name} supports f(x) - f(reference), so the map is zero"
            )
        elif change and len(weight) > 1 and bool((weight == weight[0]).all()):
            findings.append(
                f"image {index}: every channel of layer {layer.name} has the weight {float(weight[0]):.3g}, "
                "so the masked passes chose nothing and the map shows activity only"
            )
    return findings


def _size(images: Tensor) -> tuple[int, int]:
    return images.shape[-2], images.shape[-1]


@dataclass
class _Count:
    """Channels done, reported as they are."""

    total: int
    report: Callable[[int, int], None] | None
    done: int = 0

    def add(self, channels: int) -> None:
        self.done += channels
        if self.report is not None and channels:
            self.report(self.done, self.total)
