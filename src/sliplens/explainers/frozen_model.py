"""A frozen network, the images it is shown, their reference, and both predictions."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

import torch
from jaxtyping import Float, Shaped
from torch import Tensor, nn

from sliplens.errors import ImageError, ModelError
from sliplens.explainers.explanation import Approximation, Explanation, Level, check_maps
from sliplens.models.engines import Engine, prepare
from sliplens.progress import OnProgress

CHANNELS = 3
_SLACK = 1e-6  # rounding of a resize or a division may step over 1
_FORWARD_BATCH = 32  # bounds the memory of the plain predictions, whatever the number of images


@contextmanager
def frozen(model: nn.Module) -> Iterator[None]:
    """Put a network into evaluation mode without parameter gradients, and give it back as it was.

    In evaluation mode batch normalisation keeps its statistics, and without `requires_grad` no `.grad` can be
    written, so the state that is restored, also after an exception, is the training flag of every module and the
    `requires_grad` of every parameter. Two threads must not freeze one network at the same time.
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


@dataclass(frozen=True, kw_only=True)
class FrozenModel:
    """A frozen network with checked images; made by `freeze` and valid inside it only."""

    model: nn.Module
    images: Float[Tensor, "batch 3 height width"]
    """Images x in the network's own type and on its device."""
    references: Float[Tensor, "batch_or_one 3 height width"]
    """Reference b, one for each image or one for all."""

    def predict(self, images: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, " batch"]:
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
        return output.reshape(len(images))

    @torch.no_grad()
    def compare(self) -> "Comparison":
        """Predict the images and their references, without gradients."""
        predictions = (
            torch.cat([self.predict(part) for part in images.split(_FORWARD_BATCH)])
            for images in (self.images, self.references)
        )
        return self.compared(*predictions)

    def compared(
        self, prediction: Float[Tensor, " batch"], reference_prediction: Float[Tensor, " batch_or_one"]
    ) -> "Comparison":
        """Comparison with these predictions, checked."""
        return Comparison(
            model=self.model,
            images=self.images,
            references=self.references,
            prediction=_require_finite(prediction, what="image"),
            reference_prediction=_require_finite(reference_prediction, what="reference").expand_as(prediction),
        )


@dataclass(frozen=True, kw_only=True)
class Comparison(FrozenModel):
    """Images compared with their references: f(x) - f(b), which is explained."""

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

    def prepare(self, passes: int, *, engine: str = "auto", batch_size: int | None = None) -> Engine:
        """Make an engine ready for so many passes of the network (`models.engines.prepare`)."""
        return prepare(
            self.model,
            torch.cat([self.images[:1], self.reference[:1]]),
            torch.stack([self.prediction[0], self.reference_prediction[0]]),
            passes=passes,
            engine=engine,
            batch_size=batch_size,
        )

    def map_each(
        self, relevance: Callable[[int], Float[Tensor, "height width"]], *, on_progress: OnProgress | None
    ) -> Float[Tensor, "batch height width"]:
        """Maps of all images, made one after another, each from its place in the batch."""
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
        complete: bool,
        target: str = "f(x) - f(reference)",
        warnings: Iterable[str] = (),
        levels: tuple[Level, ...] = (),
        approximations: tuple[Approximation, ...] = (),
        engine: str = "eager",
    ) -> Explanation:
        """Record of an explanation, with its warnings."""
        gap = (relevance.sum(dim=(1, 2)) - self.change).abs().float() if complete else None
        single = relevance.float()
        predictions = {"prediction": self.prediction, "reference_prediction": self.reference_prediction}
        return Explanation(
            images=self.images.float(),
            relevance=single,
            method=method,
            target=target,
            **{name: values.float() for name, values in predictions.items()},
            completeness_gap=gap,
            seconds=0.0,  # known when the call ends
            warnings=(*check_maps(single, **predictions, completeness_gap=gap), *warnings),
            levels=levels,
            approximations=approximations,
            engine=engine,
        )


@contextmanager
def freeze(
    model: nn.Module, images: Shaped[Tensor, "..."], *, reference: Shaped[Tensor, "..."] | None
) -> Iterator[FrozenModel]:
    """Check the images and freeze the network.

    Inside, gradients of the output are on and autocast is off, whatever the caller's mode. Arguments are those of
    `Explainer`.
    """
    require_images(images)
    reference = _require_reference(reference, images=images)
    with ExitStack() as stack:
        # a caller inside no_grad or inference_mode may still ask for gradients of the output
        stack.enter_context(torch.inference_mode(mode=False))
        stack.enter_context(torch.enable_grad())
        stack.enter_context(frozen(model))
        # clone: tensors made in inference mode cannot enter a graph
        images, reference = (_like_model(model, tensor).detach().clone() for tensor in (images, reference))
        # differences of predictions are explained, of which half precision leaves two digits
        stack.enter_context(torch.autocast(images.device.type, enabled=False))
        yield FrozenModel(model=model, images=images, references=reference)


def require_images(images: Shaped[Tensor, "..."]) -> None:
    """Refuse images that are not float, finite, in [0, 1] and shaped (batch, 3, height, width)."""
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
        raise ImageError(
            f"images of {images.shape[2]} x {images.shape[3]} pixels are empty; pass images with at least one pixel"
        )
    _require_unit_interval(images, what="image")


def _require_reference(reference: Tensor | None, *, images: Tensor) -> Tensor:
    """The reference with a batch axis of one (shared) or of the batch's length, zeros when None is given."""
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


def _require_unit_interval(images: Tensor, *, what: str) -> None:
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


def _require_finite(prediction: Tensor, *, what: str) -> Tensor:
    bad = torch.nonzero(~prediction.isfinite()).flatten().tolist()
    if bad:
        raise ModelError(f"the model predicts {float(prediction[bad[0]])} for {what} {bad[0]}; train or load it again")
    return prediction


def _like_model(model: nn.Module, images: Tensor) -> Tensor:
    parameter = next((p for p in model.parameters() if p.is_floating_point()), None)
    return images if parameter is None else images.to(device=parameter.device, dtype=parameter.dtype)
