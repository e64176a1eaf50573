"""Pictures that a page holds inside itself."""

import base64
import io
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from sliplens.images.files import encode_png
from sliplens.report.style import drawing_style

_CSS_PIXELS_PER_INCH = 96
_COLOURS, _WHITE, _NEARLY_WHITE = 256, 255, 250
_DOTS_PER_INCH = 144  # photographs of 224 pixels shown 1.5 inches wide, about pixel for pixel


@dataclass(frozen=True, kw_only=True)
class Picture:
    """An image as a data URI, its text for those who cannot see it, and its size in CSS pixels."""

    uri: str
    alt: str
    width: int
    height: int


@dataclass(frozen=True, kw_only=True)
class Chart:
    """Pictures that share one caption; `columns` of them stand side by side where the page is wide.

    Attributes
    ----------
    files
        Where the same is written too, as a reader finds it beside the page.
    """

    layout: ClassVar[str] = "chart"

    pictures: tuple[Picture, ...]
    caption: str
    columns: int = 2
    files: str = ""


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
    with drawing_style():
        figure = Figure(figsize=size_in, layout="constrained")
        plot(figure.subplots())
    return figure_picture(figure, alt=alt)


def figure_picture(figure: Figure, *, alt: str, pixels: bool = False) -> Picture:
    """Hold a figure.

    Parameters
    ----------
    figure
        What is shown.
    alt
        The same in words.
    pixels
        Hold it as PNG: smaller where it is made of photographs. As SVG otherwise.
    """
    buffer = io.BytesIO()
    with drawing_style():
        if pixels:
            figure.savefig(buffer, format="png", dpi=_DOTS_PER_INCH)
            buffer = _fewer_colours(buffer)
        else:
            # no date: the same results make the same page
            figure.savefig(buffer, format="svg", dpi=200, metadata={"Date": None, "Creator": None})
    width, height = (round(side * _CSS_PIXELS_PER_INCH) for side in figure.get_size_inches())
    return Picture(
        uri=_data_uri("png" if pixels else "svg+xml", buffer.getvalue()), alt=alt, width=width, height=height
    )


def _fewer_colours(png: io.BytesIO) -> io.BytesIO:
    """Same picture in 256 colours, a fourth of the size: the PDF beside the page holds all of them."""
    smaller = io.BytesIO()
    with Image.open(png) as image:
        # by octree: evenly spread colours, where the median cut would give most of them to the noise of a map
        reduced = image.convert("RGB").quantize(_COLOURS, method=Image.Quantize.FASTOCTREE)
    # each colour is the mean of its like: paper would be not quite white
    reduced.putpalette([_WHITE if level > _NEARLY_WHITE else level for level in reduced.getpalette() or []])
    reduced.save(smaller, "png", optimize=True)
    return smaller


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
