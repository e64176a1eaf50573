"""Base of the explainers: checks of the images, a frozen network, the clock, the record."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Protocol, TypeAlias, runtime_checkable

import torch
from jaxtyping import Float, Shaped
from torch import Tensor, nn

from sliplens.errors import ImageError, InputError, ModelError
from sliplens.explainers.attribution import CLOSE, Attribution, check_maps, frame_of
from sliplens.models.engines import Engine, prepare
from sliplens.models.wrapping import OneOutput
from sliplens.progress import report_each

Batch: TypeAlias = Shaped[Tensor, "..."]
"""Images or a reference as a caller gave them, before they are checked."""
_SLACK = 1e-6  # rounding of a resize or a division may step over 1
_FORWARD_BATCH = 32  # bounds the memory of the plain predictions, whatever the number of images


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


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Images compared with their references by a frozen network: f(x) less f(b), in margin units, which is explained.

    Made by `freeze` and valid inside it only; predictions are computed at the first access.
    """

    model: nn.Module
    images: Float[Tensor, "batch colours height width"]
    """Images x in the network's own type and on its device."""
    references: Float[Tensor, "batch_or_one colours height width"]
    """Reference b, one for each image or one for all."""

    def predict(self, images: Float[Tensor, "batch colours height width"]) -> Float[Tensor, " batch"]:
        """Run the network and return one margin an image, with the graph where gradients are on."""
        output = self.model(images)
        if not isinstance(output, Tensor):
            raise ModelError(
                f"the model returns {type(output).__name__} instead of a tensor; "
                "wrap it so that it gives one margin an image"
            )
        if tuple(output.shape) not in {(len(images),), (len(images), 1)}:
            raise ModelError(
                f"the model's output has shape {tuple(output.shape)} for {len(images)} image(s), not one number an "
                "image; end it with one output, such as Linear(features, 1)"
            )
        if images.requires_grad and torch.is_grad_enabled() and not output.requires_grad:
            raise ModelError(
                "the model's output has no gradient; take torch.no_grad() or detach() out of its forward pass, or use "
                "occlusion, which needs none"
            )
        return output.reshape(len(images))

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
        return _require_finite(torch.cat([self.predict(part) for part in images.split(_FORWARD_BATCH)]), name)

    def with_predictions(self, prediction: Tensor, reference_prediction: Tensor) -> "Comparison":
        """Return a comparison with predictions that were made elsewhere, after checking them."""
        comparison = replace(self)
        vars(comparison)["prediction"] = _require_finite(prediction, "image")
        vars(comparison)["reference_prediction"] = _require_finite(reference_prediction, "reference")
        return comparison

    @property
    def close(self) -> float:
        """Change of the prediction below which there is next to nothing to explain."""
        return CLOSE if self.of_margin else CLOSE * float(self.change.abs().max())

    @property
    def of_margin(self) -> bool:
        """True if the network predicts safety margins, False for a wrapped module of another output."""
        return not isinstance(self.model, OneOutput)

    @property
    def reference(self) -> Float[Tensor, "batch colours height width"]:
        """Reference b of each image."""
        return self.references.expand_as(self.images)

    @property
    def change(self) -> Float[Tensor, " batch"]:
        """f(x) - f(b), the difference that is explained."""
        return self.prediction - self.reference_prediction

    def prepare(self, passes: int, *, engine: str = "auto", batch_size: int | None = None) -> Engine:
        """Prepare an engine for a number of passes of the network (`models.engines.prepare`)."""
        images = torch.cat([self.images[:1], self.reference[:1]])
        predictions = torch.stack([self.prediction[0], self.reference_prediction[0]])
        return prepare(self.model, images, predictions, passes=passes, engine=engine, batch_size=batch_size)

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
    ) -> Attribution:
        """Return maps with predictions and warnings; if `complete`, the relevance should add up to the change."""
        gap = (relevance.sum(dim=(1, 2)) - self.change).abs().float() if complete else None
        single = relevance.float()
        checks = check_maps(
            single,
            prediction=self.prediction,
            reference_prediction=self.reference_prediction,
            completeness_gap=gap,
            close=self.close,
            of_margin=self.of_margin,
        )
        return Attribution(
            images=self.images.float(),
            relevance=single,
            target=target,
            prediction=self.prediction.float(),
            reference_prediction=self.reference_prediction.float(),
            completeness_gap=gap,
            warnings=(*checks, *warnings),
        )


@contextmanager
def freeze(model: nn.Module, images: Batch, *, reference: Batch | None) -> Iterator[Comparison]:
    """Check the images and freeze the network, with gradients on and autocast off whatever the caller's mode."""
    _require_images(images)
    reference = _require_reference(reference, images=images)
    # a caller inside no_grad or inference_mode may still ask for gradients of the output
    with torch.inference_mode(mode=False), torch.enable_grad(), frozen(model):
        weights = next((parameter for parameter in model.parameters() if parameter.is_floating_point()), images)
        # clone: tensors made in inference mode cannot enter a graph
        images, reference = (
            tensor.to(device=weights.device, dtype=weights.dtype).detach().clone() for tensor in (images, reference)
        )
        # differences of predictions are explained, of which half precision leaves two digits
        with torch.autocast(images.device.type, enabled=False):
            yield Comparison(model=model, images=images, references=reference)


def _require_finite(predictions: Tensor, name: str) -> Tensor:
    for index in torch.nonzero(~predictions.isfinite()).flatten().tolist():
        raise ModelError(f"the model predicts {float(predictions[index])} for {name} {index}; train or load it again")
    return predictions


def _require_images(images: Batch) -> None:
    """Refuse images that are not float, finite, in [0, 1] and shaped (batch, 3, height, width)."""
    shape = tuple(images.shape)
    if len(shape) != 4:
        raise ImageError(
            f"images have shape {shape}, which is not (batch, 3, height, width); add a batch axis with images[None]"
        )
    if shape[1] not in {3, 6}:
        raise ImageError(
            f"images have {shape[1]} channels instead of 3; pass RGB images with the channels on the second axis"
        )
    if 0 in shape:
        raise ImageError(f"images of shape {shape} are empty; pass at least one image with at least one pixel")
    _require_unit_interval(images, name="image")


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
    _require_unit_interval(reference, name="reference")
    return reference


def black_frames(images: Float[Tensor, "*batch colours height width"]) -> Float[Tensor, "*batch colours height width"]:
    """Return images whose frame is black; the reference beside it, if any, stays."""
    black = images.clone()
    frame_of(black).zero_()
    return black


def _require_unit_interval(images: Tensor, *, name: str) -> None:
    if not images.is_floating_point():
        raise ImageError(f"{name} values are {images.dtype} instead of float; divide 8-bit images by 255")
    for index, image in enumerate(images):
        if bad := int((~image.isfinite()).sum()):
            raise ImageError(
                f"{name} {index} holds NaN or infinity in {bad} of {image.numel()} values; "
                "read the frame again, or drop it from the batch"
            )
        low, high = (float(bound) for bound in torch.aminmax(image))
        if low < -_SLACK or high > 1 + _SLACK:
            raise ImageError(
                f"{name} {index} has values from {low:.3g} to {high:.3g}, outside [0, 1]; "
                "scale it as the network's training images were"
            )


@runtime_checkable
class Explainer(Protocol):
    """A frozen dataclass whose fields are the options of a method and whose call explains a batch."""

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
        ...


class Method(ABC):
    """Base of explainers: a subclass computes the maps of checked images with a frozen network."""

    method: ClassVar[str]
    """Name of the method in the records of its maps."""

    def __call__(self, model: nn.Module, images: Batch, *, reference: Batch | None = None) -> Attribution:
        """Explain a batch; see `Explainer` for the arguments and errors."""
        start = time.perf_counter()
        with freeze(model, images, reference=reference) as comparison:
            attribution = self._explain(comparison)
        if attribution.relevance.is_cuda:
            torch.cuda.synchronize(attribution.relevance.device)
        return replace(attribution, method=self.method, seconds=time.perf_counter() - start)

    @abstractmethod
    def _explain(self, comparison: Comparison) -> Attribution:
        """Compute the maps (`Comparison.attribution`); gradients are on."""


def require_at_least_one(name: str, **options: int) -> None:
    """Raise an error for options below 1."""
    for option, value in options.items():
        if value < 1:
            raise InputError(f"{name}'s {option} is {value}; give at least 1")
