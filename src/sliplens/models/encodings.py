"""Encodings: frames and a reference frame to the network's input."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from sliplens.errors import InputError
from sliplens.images import absolute_difference, require_rgb, require_same_size, signed_difference

Frames = UInt8[np.ndarray, "batch height width 3"]
Reference = UInt8[np.ndarray, "_ _ 3"]


def _keep(frames: Frames, reference: Reference) -> Frames:
    require_same_size(frames, reference)
    return frames


@dataclass(frozen=True, kw_only=True)
class Encoding:
    """Way to make a network's input of frames.

    `compare` sets the frames against the reference frame T_0, still in 8 bits; `resize` brings them to the network's
    size, also in 8 bits, so that a data set can be held in memory (`compare_small` does both); `normalise` makes the
    floats. A folder of images that someone else has already compared enters at `resize`.
    """

    name: str
    formula: str
    """Image that the network sees, of the frame T_n and the reference T_0."""
    compare: Callable[[Frames, Reference], Frames] = _keep
    empty_is_black: bool = False
    """True where an untouched sensor gives a black image, so that an explanation needs no reference frame."""
    own_maximum: bool = True
    """If True, divide each image by its own maximum, as in the thesis; else by 255, which keeps its amplitude."""
    neutral: float = 0.0
    """Level of the network's input that means no change."""
    beside: bool = False
    """If True, the input holds the reference beside the frame."""

    @property
    def compares(self) -> bool:
        """True if the input depends on the reference frame."""
        return self.beside or self.compare is not _keep

    @property
    def colours(self) -> int:
        """Number of channels of the input: those of the frame, then those of the reference where it stands beside."""
        return 6 if self.beside else 3

    def resize(self, compared: Frames, *, image_size: int) -> UInt8[Tensor, "batch 3 size size"]:
        """Bring compared frames to the network's square size, in 8 bits.

        Bilinear with antialiasing: the noise of neighbouring pixels averages out instead of aliasing. Its weights are
        rounded so that all is done in 8 bits, a tenth of the time of floats and within a grey level of them.
        """
        require_rgb(compared)
        images = torch.from_numpy(np.require(compared, requirements=["C", "W"])).permute(0, 3, 1, 2)
        if images.shape[-2:] != (image_size, image_size):
            size = image_size, image_size
            images = functional.interpolate(images, size=size, mode="bilinear", antialias=True, align_corners=False)
        return images.contiguous()

    def compare_small(
        self, frames: Frames, reference: Reference, *, image_size: int
    ) -> UInt8[Tensor, "batch colours size size"]:
        """Compare frames with their reference frame and bring them to the network's square size, in 8 bits."""
        images = self.resize(self.compare(frames, reference), image_size=image_size)
        if not self.beside:
            return images
        # joined when they are small: torch resizes six channels ten times as slowly as twice three
        untouched = self.resize(reference[None], image_size=image_size)
        return torch.cat([images, untouched.expand_as(images)], dim=1)

    def normalise(self, images: UInt8[Tensor, "batch colours size size"]) -> Float[Tensor, "batch colours size size"]:
        """Scale to [0, 1]: by each image's own maximum, as the thesis does, or by 255; an all-black image stays black.

        Polak, section 4 ("max normalization").
        """
        if not self.own_maximum:
            return images.float() / 255
        largest = images.amax(dim=(-3, -2, -1), keepdim=True).clamp(min=1)
        return images.float() / largest

    def encode(
        self, frames: Frames, reference: Reference | None, *, image_size: int
    ) -> Float[Tensor, "batch colours size size"]:
        """Encode frames against their reference frame; None for frames that are compared already, or need not be."""
        if reference is not None:
            return self.normalise(self.compare_small(frames, reference, image_size=image_size))
        if self.beside:
            raise InputError(
                f"a network on {self.name} images sees the untouched sensor beside the frame; name its image with "
                "--reference IMAGE, or a frame of it with --reference-frame N"
            )
        return self.normalise(self.resize(frames, image_size=image_size))


ENCODINGS = {
    # the first two are divided by their own maximum, as in the thesis
    "difference": Encoding(name="difference", formula="|T_n - T_0|", compare=absolute_difference, empty_is_black=True),
    "raw": Encoding(name="raw", formula="T_n"),
    "rgb": Encoding(name="rgb", formula="T_n", own_maximum=False),
    "signed": Encoding(
        name="signed", formula="(T_n - T_0) / 2 + 128", compare=signed_difference, own_maximum=False, neutral=128 / 255
    ),
    "amplitude": Encoding(
        name="amplitude", formula="|T_n - T_0|", compare=absolute_difference, empty_is_black=True, own_maximum=False
    ),
    "pair": Encoding(name="pair", formula="T_n, then T_0", own_maximum=False, beside=True),
}
