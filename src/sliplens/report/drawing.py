"""Pictures that a page holds inside itself."""

import base64
import io
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sliplens.images.files import encode_png
from sliplens.report.style import drawing_style

_CSS_PIXELS_PER_INCH = 96


@dataclass(frozen=True, kw_only=True)
class Picture:
    """An image as a data URI, its text for those who cannot see it, and its size in CSS pixels."""

    uri: str
    alt: str
    width: int
    height: int


@dataclass(frozen=True, kw_only=True)
class Chart:
    """Pictures that share one caption; `columns` of them stand side by side where the page is wide."""

    pictures: tuple[Picture, ...]
    caption: str
    columns: int = 2


def draw_picture(plot: Callable[[Axes], object], *, alt: str, size_in: tuple[float, float] = (4.2, 3.1)) -> Picture:
    """Draw one axes as SVG, in the style of the report and without touching matplotlib's settings.

    Parameters
    ----------
    plot
        Draws on the axes it is given.
    alt
        What the picture shows, in words.
    size_in
        Width and height in inches.
    """
    buffer = io.BytesIO()
    with drawing_style():
        figure = Figure(figsize=size_in, layout="constrained")
        plot(figure.subplots())
        # no date: the same results make the same page
        figure.savefig(buffer, format="svg", dpi=200, metadata={"Date": None, "Creator": None})
    width, height = (round(side * _CSS_PIXELS_PER_INCH) for side in size_in)
    return Picture(uri=_data_uri("svg+xml", buffer.getvalue()), alt=alt, width=width, height=height)


def png_picture(pixels: UInt8[np.ndarray, "height width 3"], *, alt: str) -> Picture:
    """Hold an image losslessly, at its own size."""
    return Picture(
        uri=_data_uri("png", encode_png(pixels, compress_level=9)),
        alt=alt,
        width=pixels.shape[1],
        height=pixels.shape[0],
    )


def _data_uri(kind: str, data: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
