"""Pictures that a page holds inside itself."""

import base64
import io
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from sliplens.errors import InputError
from sliplens.plots.style import GREY, drawing_style

# no dates: the same trials, the same file
_METADATA: dict[str, dict[str, Any]] = {".png": {}, ".pdf": {"CreationDate": None}, ".svg": {"Date": None}}


def require_picture_path(path: Path, *, example: str) -> None:
    """Check that a file is named as a picture that can be saved."""
    if path.suffix.lower() not in _METADATA:
        raise InputError(f"{path} does not end in {', '.join(_METADATA)}; name a picture, such as {example}")


def save_page(figure: Figure, path: Path) -> None:
    """Save a page as .png, .pdf or .svg; it appears when complete."""
    suffix = path.suffix.lower()
    with written_whole(path) as part, drawing_style():
        # 150 dots an inch show frames of 224 pixels about pixel for pixel
        figure.savefig(part, format=suffix[1:], dpi=150, metadata=_METADATA[suffix])


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Give a file beside the target to write to; it takes the target's name when all went well, else it is gone."""
    part = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield part
        part.replace(path)
    except OSError as error:
        raise InputError(f"cannot write {path} ({error.strerror}); choose another file") from None
    finally:
        with suppress(OSError):  # it has its name by now, or could not be made
            part.unlink()


def place_axes(figure: Figure, left: float, top: float, width: float, height: float) -> Axes:
    """Add axes whose left upper corner and size are given in inches from the left upper corner of the page."""
    across, down = figure.get_size_inches()
    return figure.add_axes((left / across, 1 - (top + height) / down, width / across, height / down))


def place_text(figure: Figure, left: float, top: float, text: str, **settings: Any) -> None:
    """Write words there, their upper edge on that line unless told otherwise."""
    across, down = figure.get_size_inches()
    figure.text(left / across, 1 - top / down, text, **{"va": "top", **settings})


def write_over(ax: Axes, words: str, **settings: Any) -> None:
    """Write in the middle of axes, grey, why there is nothing in them."""
    ax.text(0.5, 0.5, words, transform=ax.transAxes, ha="center", va="center", color=GREY, **settings)


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


def figure_picture(figure: Figure, *, alt: str, pixels: bool = False) -> Picture:
    """Hold a figure as SVG, or as PNG: smaller where it is made of photographs."""
    buffer = io.BytesIO()
    with drawing_style():
        if pixels:
            # as bare pixels: a PNG made only to be read again takes as long as the drawing
            figure.savefig(buffer, format="rgba", dpi=_DOTS_PER_INCH)
            width, height = (int(side * _DOTS_PER_INCH) for side in figure.get_size_inches())
            buffer = _fewer_colours(Image.frombytes("RGBA", (width, height), buffer.getvalue()))
        else:
            # no date: the same results make the same page
            figure.savefig(buffer, format="svg", dpi=200, metadata={"Date": None, "Creator": None})
    width, height = (round(side * _CSS_PIXELS_PER_INCH) for side in figure.get_size_inches())
    uri = f"data:image/{'png' if pixels else 'svg+xml'};base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"
    return Picture(uri=uri, alt=alt, width=width, height=height)


def _fewer_colours(image: Image.Image) -> io.BytesIO:
    """Same picture in 256 colours, a fourth of the size: the PDF beside the page holds all of them."""
    smaller = io.BytesIO()
    # by octree: evenly spread colours, where the median cut would give most of them to the noise of a map
    reduced = image.convert("RGB").quantize(_COLOURS, method=Image.Quantize.FASTOCTREE)
    # each colour is the mean of its like: paper would be not quite white
    reduced.putpalette([_WHITE if level > _NEARLY_WHITE else level for level in reduced.getpalette() or []])
    reduced.save(smaller, "png")
    return smaller
