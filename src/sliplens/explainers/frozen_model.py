"""What is explained: a network held still, its images, their reference, and both predictions."""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Shaped
from torch import Tensor, nn

from sliplens.errors import ImageError, ModelError
from sliplens.explainers.explanation import Explanation, Progress, check_maps


class Clock:
    """Started when made; `seconds` waits for the device of a result before it reads."""

    def __init__(self) -> None:
        self._start = time.perf_counter()

    def seconds(self, result: Tensor) -> float:
        """Seconds since the start, with the work that led to `result` finished."""
        if result.is_cuda:
            torch.cuda.synchronize(result.device)
        return time.perf_counter() - self._start


@contextmanager
def still(model: nn.Module) -> Iterator[None]:
    """Put a network into evaluation mode without parameter gradients, and give it back as it was.

    In evaluation mode batch normalisation keeps its statistics, and without `requires_grad` no `.grad` can be
    written, so the state that is restored, also after an exception, is the training flag of every module and the
    `requires_grad` of every parameter. Two threads must not hold one network at the same time.
    """
    training = [(module, module.training) for module in model.modules()]
    trainable = [(parameter, parameter.requires_grad) for parameter in model.parameters()]
    try:
        model.eval()
        for parameter, _ in trainable:
            parameter.requires_grad_(False)
        yield
    finally:
        # flag by flag: train() would recurse and undo what a caller had frozen
        for module, flag in training:
            module.training = flag
        for parameter, flag in trainable:
            parameter.requires_grad_(flag)


CHANNELS = 3
_SLACK = 1e-6  # rounding of a resize or a division may step over 1


def require_images(images: Shaped[Tensor, "..."]) -> Float[Tensor, "batch 3 height width"]:
    """Return the images unchanged when they are float, finite, in [0, 1] and shaped (batch, 3, height, width).

    Raises
    ------
    ImageError
        If they are not.
    """
    if images.ndim != 4:
        raise ImageError(
            f"images have shape {tuple(images.shape)}, which is not (batch, 3, height, width); "
            "add a batch axis with images[None]"
        )
    if images.shape[0] == 0:
        raise ImageError("there is no image to explain, the batch is empty; pass at least one image")
    if images.shape[1] != CHANNELS:
        raise ImageError(
            f"images have {images.shape[1]} channels instead of {CHANNELS}; "
            "pass RGB images with the channels on the second axis"
        )
    if 0 in images.shape[2:]:
        raise ImageError(f"images of {_size(images)} pixels are empty; pass images with at least one pixel")
    _require_unit_interval(images, what="image")
    return images


def require_reference(
    reference: Shaped[Tensor, "..."] | None, *, images: Float[Tensor, "batch 3 height width"]
) -> Float[Tensor, "batch_or_one 3 height width"]:
    """Return the reference with a batch axis of one (shared) or of the batch's length, zeros when None is given.

    Raises
    ------
    ImageError
        If its shape differs from the images', or its values are not float, finite and in [0, 1].
    """
    if reference is None:
        return torch.zeros_like(images[:1])
    shared = tuple(reference.shape) == tuple(images.shape[1:])
    if not shared and reference.shape != images.shape:
        raise ImageError(
            f"the reference has shape {tuple(reference.shape)} but the images have {tuple(images.shape)}; "
            f"pass one reference of shape {tuple(images.shape[1:])} or one for each image"
        )
    reference = reference[None] if shared else reference
    _require_unit_interval(reference, what="reference")
    return reference


def _require_unit_interval(images: Shaped[Tensor, "batch channels height width"], *, what: str) -> None:
    if not images.is_floating_point():
        raise ImageError(f"{what} values are {images.dtype} instead of float; divide 8-bit images by 255")
    for index, image in enumerate(images):
        bad = int((~image.isfinite()).sum())
        if bad:
            raise ImageError(
                f"{what} {index} holds NaN or infinity in {bad} of {image.numel()} values; "
                "read the frame again, or drop it from the batch"
            )
        low, high = (float(bound) for bound in torch.aminmax(image))
        if low < -_SLACK or high > 1 + _SLACK:
            raise ImageError(
                f"{what} {index} has values from {low:.3g} to {high:.3g}, outside [0, 1]; "
                "scale it as the network's training images were"
            )


def _size(images: Tensor) -> str:
    return f"{images.shape[-2]} x {images.shape[-1]}"


_FORWARD_BATCH = 32  # bounds the memory of the plain predictions, whatever the number of images


@dataclass(frozen=True, kw_only=True)
class Held:
    """A network in evaluation mode with checked images; made by `holding` and valid inside it only."""

    model: nn.Module
    images: Float[Tensor, "batch 3 height width"]
    """Images x in the network's own type and on its device."""
    references: Float[Tensor, "batch_or_one 3 height width"]
    """Reference b, one for each image or one for all."""

    def predict(self, images: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, " batch"]:
        """Run the network and return one margin an image, with the graph where gradients are on.

        Raises
        ------
        ModelError
            If the network does not return one number an image.
        """
        return _predict(self.model, images)

    def predict_all(self) -> "Subject":
        """The subject, its predictions made without gradients.

        Raises
        ------
        ModelError
            If the network does not give one finite number an image.
        """
        with torch.no_grad():
            return self.predicted(*(_predict_all(self.model, part) for part in (self.images, self.references)))

    def predicted(
        self, prediction: Float[Tensor, " batch"], reference_prediction: Float[Tensor, " batch_or_one"]
    ) -> "Subject":
        """The subject whose predictions these are, checked.

        Raises
        ------
        ModelError
            If one of them is not finite.
        """
        return Subject(
            model=self.model,
            images=self.images,
            references=self.references,
            prediction=_finite(prediction, what="image"),
            reference_prediction=_finite(reference_prediction, what="reference").expand_as(prediction),
        )


@dataclass(frozen=True, kw_only=True)
class Subject(Held):
    """What is explained: f(x) - f(b)."""

    prediction: Float[Tensor, " batch"]
    """f(x)."""
    reference_prediction: Float[Tensor, " batch"]
    """f(b)."""

    @property
    def reference(self) -> Float[Tensor, "batch 3 height width"]:
        """Reference b of each image."""
        return self.references.expand_as(self.images)

    @property
    def change(self) -> Float[Tensor, " batch"]:
        """f(x) - f(b) in margin units."""
        return self.prediction - self.reference_prediction

    def each_image(
        self, relevance: Callable[[int], Float[Tensor, "height width"]], *, on_progress: Progress | None
    ) -> Float[Tensor, "batch height width"]:
        """The maps of all images, made one after another, each from its place in the batch."""
        maps = []
        for index in range(len(self.images)):
            maps.append(relevance(index))
            if on_progress is not None:
                on_progress(index + 1, len(self.images))
        return torch.stack(maps)

    def explanation(
        self,
        relevance: Float[Tensor, "batch height width"],
        *,
        method: str,
        clock: Clock,
        complete: bool,
        target: str = "f(x) - f(reference)",
        findings: Iterable[str] = (),
        **more: Any,
    ) -> Explanation:
        """The record of a finished explanation, with its warnings.

        Parameters
        ----------
        relevance
            Signed maps in margin units, in the network's type.
        method
            Key of the explainer.
        clock
            Started when the call began.
        complete
            Whether the relevance of an image is meant to add up to f(x) - f(b).
        target
            What it adds up to, in words.
        findings
            Warnings of the method itself.
        more
            Further fields of `Explanation`.
        """
        gap = (relevance.sum(dim=(1, 2)) - self.change).abs().float() if complete else None
        single = relevance.float()
        warnings = check_maps(
            single,
            prediction=self.prediction,
            reference_prediction=self.reference_prediction,
            completeness_gap=gap,
        )
        return Explanation(
            relevance=single,
            method=method,
            target=target,
            prediction=self.prediction.float(),
            reference_prediction=self.reference_prediction.float(),
            completeness_gap=gap,
            seconds=clock.seconds(single),
            warnings=(*warnings, *findings),
            **more,
        )


@contextmanager
def holding(
    model: nn.Module,
    images: Shaped[Tensor, "..."],
    *,
    reference: Shaped[Tensor, "..."] | None,
) -> Iterator[Held]:
    """Check the images and hold the network still.

    Inside, the network is held `still`, gradients are on and autocast is off, whatever the caller's mode.

    Parameters
    ----------
    model
        Network from images (batch, 3, height, width) to (batch,) or (batch, 1).
    images
        Images x, float in [0, 1], shape (batch, 3, height, width).
    reference
        Reference b, float in [0, 1], shape (3, height, width) or the images' own; None for zeros.

    Yields
    ------
    Held
        The network, images and reference.

    Raises
    ------
    ImageError
        If the images or the reference cannot be used.
    """
    images = require_images(images)
    reference = require_reference(reference, images=images)
    with ExitStack() as stack:
        # a caller inside no_grad or inference_mode may still ask for gradients of the output
        stack.enter_context(torch.inference_mode(mode=False))
        stack.enter_context(torch.enable_grad())
        stack.enter_context(still(model))
        # clone: tensors made in inference mode cannot enter a graph
        images, reference = (_like_model(model, tensor).detach().clone() for tensor in (images, reference))
        # differences of predictions are explained, of which half precision leaves two digits
        stack.enter_context(torch.autocast(images.device.type, enabled=False))
        yield Held(model=model, images=images, references=reference)


@contextmanager
def explaining(
    model: nn.Module,
    images: Shaped[Tensor, "..."],
    *,
    reference: Shaped[Tensor, "..."] | None,
) -> Iterator[Subject]:
    """Hold the network still as `holding` does, and predict the images and the reference.

    Raises
    ------
    ImageError
        If the images or the reference cannot be used.
    ModelError
        If the network does not give one finite number an image.
    """
    with holding(model, images, reference=reference) as held:
        yield held.predict_all()


def _predict(model: nn.Module, images: Tensor) -> Tensor:
    output = model(images)
    if not isinstance(output, Tensor):
        raise ModelError(
            f"the model returns {type(output).__name__} instead of a tensor; "
            "wrap it so that it gives one margin an image"
        )
    if tuple(output.shape) not in {(len(images),), (len(images), 1)}:
        raise ModelError(
            f"the model's output has shape {tuple(output.shape)} for {len(images)} image(s), not one number an image; "
            "end it with one output, such as Linear(features, 1)"
        )
    return output.reshape(len(images))


def _predict_all(model: nn.Module, images: Tensor) -> Tensor:
    return torch.cat([_predict(model, part) for part in images.split(_FORWARD_BATCH)])


def _finite(prediction: Tensor, *, what: str) -> Tensor:
    bad = torch.nonzero(~prediction.isfinite()).flatten().tolist()
    if bad:
        raise ModelError(f"the model predicts {float(prediction[bad[0]])} for {what} {bad[0]}; train or load it again")
    return prediction


def _like_model(model: nn.Module, images: Tensor) -> Tensor:
    parameter = next((p for p in model.parameters() if p.is_floating_point()), None)
    return images if parameter is None else images.to(device=parameter.device, dtype=parameter.dtype)
