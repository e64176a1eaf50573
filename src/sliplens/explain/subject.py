"""What is explained: a network held still, its images, their reference, and both predictions."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

import torch
from jaxtyping import Float, Shaped
from torch import Tensor, nn

from sliplens.errors import ModelError
from sliplens.explain.inputs import require_images, require_reference
from sliplens.explain.still import still

_FORWARD_BATCH = 32  # bounds the memory of the plain predictions, whatever the number of images


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A network in evaluation mode with checked images; made by `explaining` and valid inside it only."""

    model: nn.Module
    images: Float[Tensor, "batch 3 height width"]
    """Images x in the network's own type and on its device."""
    reference: Float[Tensor, "batch 3 height width"]
    """Reference b, one for each image."""
    prediction: Float[Tensor, " batch"]
    """f(x)."""
    reference_prediction: Float[Tensor, " batch"]
    """f(b)."""

    @property
    def change(self) -> Float[Tensor, " batch"]:
        """f(x) - f(b) in margin units."""
        return self.prediction - self.reference_prediction

    def predict(self, images: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, " batch"]:
        """Run the network and return one margin an image, with the graph where gradients are on.

        Raises
        ------
        ModelError
            If the network does not return one number an image.
        """
        return _predict(self.model, images)


@contextmanager
def explaining(
    model: nn.Module,
    images: Shaped[Tensor, "..."],
    *,
    reference: Shaped[Tensor, "..."] | None,
) -> Iterator[Subject]:
    """Check the images, hold the network still, and predict the images and the reference.

    Inside, the network is held `still` and gradients are on, whatever the caller's mode.

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
    Subject
        The network, images, reference and predictions.

    Raises
    ------
    ImageError
        If the images or the reference cannot be used.
    ModelError
        If the network does not give one finite number an image.
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
        with torch.no_grad():
            prediction = _finite(_predict_all(model, images), what="image")
            reference_prediction = _finite(_predict_all(model, reference), what="reference")
        yield Subject(
            model=model,
            images=images,
            reference=reference.expand_as(images),
            prediction=prediction,
            reference_prediction=reference_prediction.expand_as(prediction),
        )


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
