"""Checks on the images and the reference of an explanation."""

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from sliplens.errors import ImageError

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
