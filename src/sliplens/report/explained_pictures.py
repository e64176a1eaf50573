"""Maps laid out for people to look at: the thesis's colours, and a panel of frames and methods."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib import colormaps
from matplotlib.figure import Figure

_CELL_IN = 1.6


def overlay_jet(
    picture: UInt8[np.ndarray, "height width 3"], saliency: Float[np.ndarray, "height width"]
) -> UInt8[np.ndarray, "height width 3"]:
    """Picture under half of the saliency in Jet, divided by the brightest value, as the thesis's figures have it.

    Jet has bright bands where nothing changes and is not read alike by everyone; use it to compare with those figures.

    Parameters
    ----------
    picture
        What the network saw, as RGB.
    saliency
        Importance of each pixel in [0, 1].

    References
    ----------
    `show_cam_on_image` of the public pytorch-grad-cam, which the thesis's code calls.
    """
    mixed = 0.5 * colormaps["jet"](np.clip(saliency, 0, 1))[..., :3] + 0.5 * picture / 255
    return np.round(255 * mixed / max(mixed.max(), 1e-12)).astype(np.uint8)


def draw_panel(
    rows: Mapping[str, Sequence[UInt8[np.ndarray, "height width 3"] | None]], *, titles: Sequence[str]
) -> Figure:
    """Draw a table of pictures.

    Parameters
    ----------
    rows
        Pictures by the name of their row; None leaves a cell empty.
    titles
        Of the columns.
    """
    figure = Figure(figsize=(_CELL_IN * len(titles) + 0.4, _CELL_IN * len(rows) + 0.5), dpi=120, layout="constrained")
    axes = figure.subplots(len(rows), len(titles), squeeze=False)
    for line, (name, pictures) in zip(axes, rows.items(), strict=True):
        line[0].set_ylabel(name, fontsize=8)
        for ax, picture in zip(line, pictures, strict=True):
            ax.set(xticks=[], yticks=[])
            ax.spines[:].set_visible(False)
            if picture is not None:
                ax.imshow(picture, interpolation="nearest")
    for ax, title in zip(axes[0], titles, strict=True):
        ax.set_title(title, fontsize=8)
    return figure
