"""Base of the explainers: checked images, a frozen network, its predictions, warnings and the clock."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, TypeAlias

import torch
from jaxtyping import Float, Shaped
from torch import Tensor, nn

from sliplens.errors import ImageError, ModelError
from sliplens.explainers.attribution import Approximation, Attribution
from sliplens.models.engines import Engine, prepare
from sliplens.models.wrapping import OneOutput, one_output
from sliplens.progress import report_each
from sliplens.results.explanation import CLOSE

Batch: TypeAlias = Shaped[Tensor, "..."]
"""Images or a reference as a caller gave them, before they are checked."""
Explainer: TypeAlias = Callable[..., Attribution]
"""Function that explains a batch, with the arguments of `Method.__call__`."""
BATCH = 32
"""Images in a pass, which bounds the memory."""
_NO_GRADIENT = (
    "the model's output has no gradient; take torch.no_grad() or detach() out of its forward pass, explain a quantised "
    "module before it is quantised, or use occlusion, which needs none"
)
_SLACK = 1e-6  # rounding of a resize or a division may step over 1
_GAP = 0.01  # share of |f(x) - f(reference)| that may stay unexplained
_LOWEST, _HIGHEST = -0.1, 1.1  # predictions of a regressor on data like its training data
_FLAT = 0.1  # share of |f(x) - f(reference)| that gradients at the image must make up, all of one sign


@contextmanager
def frozen(model: nn.Module) -> Iterator[None]:
    """Put a network into evaluation mode without parameter gradients, and restore it afterwards.

    Two threads must not freeze one network at the same time.
    """
    training = [(module, module.training) for module in model.modules()]
    trainable = [(parameter, parameter.requires_grad) for parameter in model.parameters()]
    try:
        model.eval().requires_grad_(requires_grad=False)
        yield
    finally:
        # flag by flag: train() would recurse and undo what a caller had frozen
        for module, flag in training:
            module.training = flag
        for parameter, flag in trainable:
            parameter.requires_grad_(flag)


@dataclass(kw_only=True)
class Comparison:
    """Images compared with their references by a frozen network: f(x) less f(b), in margin units, which is explained.

    Predictions are computed at the first access, unless a method sets those of a pass of its own.
    """

    model: nn.Module
    images: Float[Tensor, "batch colours height width"]
    """Images x in the network's own type and on its device."""
    references: Float[Tensor, "batch_or_one colours height width"]
    """Reference b, one for each image or one for all."""

    def predict(self, images: Float[Tensor, "batch colours height width"]) -> Float[Tensor, " batch"]:
        """Run the network and return one margin an image, with the graph where gradients are on."""
        output = one_output(self.model(images), len(images))
        if images.requires_grad and torch.is_grad_enabled() and not output.requires_grad:
            raise ModelError(_NO_GRADIENT)
        return output

    @cached_property
    def prediction(self) -> Float[Tensor, " batch"]:
        """f(x), without gradients."""
        return self._predict_all(self.images, "image")

    @cached_property
    def reference_prediction(self) -> Float[Tensor, " batch"]:
        """f(b) of each image, without gradients."""
        prediction = self.prediction  # its errors are reported first
        return self._predict_all(self.references, "reference").expand_as(prediction)

    @torch.no_grad()
    def _predict_all(self, images: Tensor, name: str) -> Tensor:
        return _require_finite(torch.cat([self.predict(part) for part in images.split(BATCH)]), name)

    @property
    def close(self) -> float:
        """Change of the prediction below which there is next to nothing to explain."""
        # of a wrapped module the output has another unit
        return CLOSE * float(self.change.abs().max()) if isinstance(self.model, OneOutput) else CLOSE

    @property
    def reference(self) -> Float[Tensor, "batch colours height width"]:
        """Reference b of each image."""
        return self.references.expand_as(self.images)

    @property
    def change(self) -> Float[Tensor, " batch"]:
        """f(x) - f(b), the difference that is explained."""
        return self.prediction - self.reference_prediction

    def prepare(self, passes: int, *, engine: str = "auto") -> Engine:
        """Prepare an engine for a number of passes of the network (`models.engines.prepare`)."""
        _ = self.change  # errors of the predictions are reported first
        return prepare(self.model, torch.cat([self.images[:1], self.reference[:1]]), passes=passes, engine=engine)

    def map_each(
        self, relevance: Callable[[int], Float[Tensor, "height width"]]
    ) -> Float[Tensor, "batch height width"]:
        """Compute the maps of all images one after another, each from its index in the batch."""
        return torch.stack([relevance(index) for index in report_each(range(len(self.images)))])

    def attribution(
        self,
        relevance: Float[Tensor, "batch height width"],
        *,
        complete: bool,
        target: str = "f(x) - f(reference)",
        warnings: Iterable[str] = (),
        engine: str = "torch",
        approximations: Sequence[Approximation] = (),
        raises_only: bool = False,
    ) -> Attribution:
        """Return maps with predictions and warnings; if `complete`, the relevance should add up to the change."""
        for predictions, name in ((self.prediction, "image"), (self.reference_prediction, "reference")):
            _require_finite(predictions, name)
        gap = (relevance.sum(dim=(1, 2)) - self.change).abs().float() if complete else None
        return Attribution(
            relevance=relevance.float(),
            target=target,
            prediction=self.prediction.float(),
            reference_prediction=self.reference_prediction.float(),
            completeness_gap=gap,
            warnings=(*self._faults(relevance.float(), gap), *warnings),
            engine=engine,
            approximations=tuple(approximations),
            raises_only=raises_only,
        )

    def _faults(self, relevance: Tensor, gap: Tensor | None) -> Iterator[str]:
        """Describe the faults of each map, a sentence a fault, in the order of the images."""
        gaps = torch.zeros_like(self.prediction) if gap is None else gap
        numbers = (values.tolist() for values in (self.prediction, self.reference_prediction, gaps))
        for index, (image_map, high, low, missing) in enumerate(zip(relevance, *numbers, strict=True)):
            change, finite, close = high - low, bool(torch.isfinite(image_map).all()), self.close
            findings = {
                f"f(x) = {high:.3g} is within {close:.2g} of f(reference) = {low:.3g}, so there is next to nothing to "
                "explain": abs(change) < close,
                f"f(reference) = {low:.3g} is no safety margin, so the reference lies far from the data and the map "
                "shows the way from there": not isinstance(self.model, OneOutput) and not _LOWEST <= low <= _HIGHEST,
                "the map holds NaN or infinity and must not be shown or scored": not finite,
                "the map is zero everywhere and says nothing about the image": finite and not image_map.any(),
                f"the map leaves {missing:.2g} of f(x) - f(reference) = {change:.2g} unexplained, more than "
                f"{_GAP:.0%}": missing > _GAP * abs(change),
            }
            yield from (f"image {index}: {finding}" for finding, holds in findings.items() if holds)

    def saturated(self, sizes: Sequence[float]) -> Iterator[str]:
        """Warn of images at which the gradients, even if all of one sign, make up next to none of the change."""
        for index, (size, change) in enumerate(zip(sizes, self.change.tolist(), strict=True)):
            if abs(change) >= self.close and size < _FLAT * abs(change):
                yield (
                    f"image {index}: the gradients at the image make up {size / abs(change):.2g} of "
                    f"f(x) - f(reference) = {change:.2g}, less than {_FLAT:g}: the network is saturated there, so "
                    "compare with poly-cam or occlusion, which need no gradient"
                )


def _require_finite(predictions: Tensor, name: str) -> Tensor:
    for index in torch.nonzero(~predictions.isfinite()).flatten().tolist():
        raise ModelError(f"the model predicts {float(predictions[index])} for {name} {index}; train or load it again")
    return predictions


def require_images(images: Batch, *, name: str = "image") -> None:
    """Refuse images that are not float, finite, in [0, 1] and shaped (batch, 3, height, width)."""
    shape = tuple(images.shape)
    if len(shape) != 4 or shape[1] not in {3, 6} or 0 in shape:
        raise ImageError(
            f"{name}s have shape {shape}, which is not (batch, 3, height, width) of pixels; pass RGB images, a "
            "single one as images[None]"
        )
    if not images.is_floating_point():
        raise ImageError(f"{name} values are {images.dtype} instead of float; divide 8-bit images by 255")
    for index, image in enumerate(images):
        low, high = (float(bound) for bound in torch.aminmax(image))
        if not (low >= -_SLACK and high <= 1 + _SLACK):  # NaN neither
            raise ImageError(
                f"{name} {index} has values from {low:.3g} to {high:.3g}, outside [0, 1]; scale it as the network's "
                "training images were, or drop it from the batch"
            )


def _require_reference(reference: Tensor | None, *, images: Tensor) -> Tensor:
    """Return the reference with a batch axis of one (shared) or of the batch's length; the untouched sensor if None."""
    if reference is None:
        # no difference, or the reference beside the frame
        return torch.zeros_like(images[:1]) if images.shape[1] == 3 else torch.cat([images[:, 3:]] * 2, dim=1)
    shared = tuple(reference.shape) == tuple(images.shape[1:])
    if not shared and reference.shape != images.shape:
        raise ImageError(
            f"the reference has shape {tuple(reference.shape)} but the images have {tuple(images.shape)}; "
            f"pass one reference of shape {tuple(images.shape[1:])} or one for each image"
        )
    reference = reference[None] if shared else reference
    require_images(reference, name="reference")
    return reference


class Method(ABC):
    """Base of explainers: a subclass computes the maps of checked images with a frozen network."""

    method: ClassVar[str]
    """Name of the method in the records of its maps."""

    def __call__(self, model: nn.Module, images: Batch, *, reference: Batch | None = None) -> Attribution:
        """Explain f(x) - f(reference) of a regressor with one output.

        Parameters
        ----------
        model
            Network from images (batch, 3, height, width) to one safety margin each, (batch,) or (batch, 1).
            It is put into evaluation mode for the call and restored afterwards.
        images
            Images x, float in [0, 1], shape (batch, 3, height, width).
        reference
            What the images are compared with, float in [0, 1], one for all (3, height, width) or one each
            (batch, 3, height, width); by default zeros, the untouched sensor of difference images. Images with six
            channels hold the reference in the last three, which stays: the frame is explained.

        Raises
        ------
        ImageError
            If the images or the reference have a wrong shape, type or range, or hold NaN.
        ModelError
            If the network has several outputs, predicts NaN, or lacks a layer that the method needs.
        """
        start = time.perf_counter()
        require_images(images)
        reference = _require_reference(reference, images=images)
        weights = next((parameter for parameter in model.parameters() if parameter.is_floating_point()), images)
        # a caller inside no_grad or inference_mode may still ask for gradients of the output; and differences of
        # predictions are explained, of which half precision leaves two digits
        with (
            torch.inference_mode(mode=False),
            torch.enable_grad(),
            frozen(model),
            torch.autocast(weights.device.type, enabled=False),
        ):
            # clone: tensors made in inference mode cannot enter a graph
            images, reference = (
                tensor.to(device=weights.device, dtype=weights.dtype).detach().clone() for tensor in (images, reference)
            )
            try:
                attribution = self._explain(Comparison(model=model, images=images, references=reference))
            except RuntimeError as error:
                if "used in the graph" not in str(error):
                    raise
                raise ModelError(_NO_GRADIENT) from error
        if attribution.relevance.is_cuda:
            torch.cuda.synchronize(attribution.relevance.device)
        return replace(attribution, method=self.method, seconds=time.perf_counter() - start)

    @abstractmethod
    def _explain(self, comparison: Comparison) -> Attribution:
        """Compute the maps (`Comparison.attribution`); gradients are on."""
