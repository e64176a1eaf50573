"""Saliency laid over the picture it explains, pixel on pixel."""

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib import colormaps
from matplotlib.axes import Axes

from sliplens.arrays import require_saliency

# perceptually uniform, rises in lightness, and read alike under every common colour blindness
COLORMAP = "inferno"
_DIM = 0.55  # of the picture's lightness: leaves the bright end of the colours to the saliency
_OPAQUE_FROM = 0.4  # saliency from which the picture no longer shines through
FULL_COLOUR_PERCENTILE = 99.5
"""Percentile of a map that gets the brightest colour: a few outlying pixels would leave the rest of the map black."""


def overlay_saliency(
    picture: UInt8[np.ndarray, "height width 3"], saliency: Float[np.ndarray, "rows columns"]
) -> UInt8[np.ndarray, "height width 3"]:
    """Picture in dimmed grey with the saliency in colour on top.

    The picture loses its own colours, so that every colour seen is saliency; where the saliency is low the picture
    shows through.

    Parameters
    ----------
    picture
        What the network saw, as RGB.
    saliency
        Importance of each pixel in [0, 1], of the picture's height and width.

    Raises
    ------
    SaliencyError
        If the map has another size than the picture, or is not finite.
    """
    value = np.clip(require_saliency(saliency, picture.shape[:2]), 0, 1)
    return np.round(255 * _blend(_DIM * _lightness(picture), value)).astype(np.uint8)


def stretch_saliency(saliency: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows columns"]:
    """Stretch a map for viewing, so that its 99.5th percentile and all above are 1; a zero map stays zero."""
    top = np.percentile(saliency, FULL_COLOUR_PERCENTILE) or saliency.max()
    return np.clip(saliency / top, 0, 1) if top > 0 else saliency


def plot_overlay(
    picture: UInt8[np.ndarray, "height width 3"], saliency: Float[np.ndarray, "rows columns"], *, ax: Axes
) -> Axes:
    """Draw a picture with its saliency; both fill the same extent, since they are one image."""
    ax.imshow(overlay_saliency(picture, saliency))
    ax.set_axis_off()
    return ax


def plot_colour_bar(*, ax: Axes) -> Axes:
    """Draw the colours of `overlay_saliency` from least to most important, over a mid-grey picture."""
    value = np.linspace(0, 1, 256)[None]
    ax.imshow(_blend(np.full_like(value, _DIM / 2), value), extent=(0, 1, 0, 1), aspect="auto")
    ax.set(xlabel="Saliency (share of its own picture's 99.5th percentile)", yticks=[], xticks=[0, 0.25, 0.5, 0.75, 1])
    ax.grid(visible=False)
    return ax


def _lightness(picture: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width"]:
    return picture @ np.array([0.299, 0.587, 0.114]) / 255  # luma weights of ITU-R BT.601


def _blend(
    grey: Float[np.ndarray, "height width"], saliency: Float[np.ndarray, "height width"]
) -> Float[np.ndarray, "height width 3"]:
    alpha = np.clip(saliency / _OPAQUE_FROM, 0, 1)[..., None]
    return (1 - alpha) * grey[..., None] + alpha * colormaps[COLORMAP](saliency)[..., :3]
