"""What is explained: a network held still, its images, their reference, and both predictions."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Shaped
from torch import Tensor, nn

from sliplens.errors import ModelError
from sliplens.explain.clock import Clock
from sliplens.explain.explanation import Explanation, Progress
from sliplens.explain.health import check_maps
from sliplens.explain.inputs import require_images, require_reference
from sliplens.explain.still import still

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
