"""Grids of pictures with words around them, laid out in inches."""

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import fill

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sliplens.report.overlay import overlay_saliency, plot_colour_bar, stretch_saliency
from sliplens.report.pages import place_axes, place_text
from sliplens.report.style import GREY, drawing_style

CELL_IN = 1.5
_GAP_IN, _LEFT_IN, _HEAD_IN, _WORDS_IN, _BAR_IN = 0.06, 1.25, 0.42, 0.2, 0.75
_EDGE_IN = 0.1
_HEAD_LETTERS = 20


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A picture, and words below it."""

    picture: UInt8[np.ndarray, "height width 3"] | None
    words: str = ""


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A figure of pictures, its axes by row and column, and where the next thing below may begin."""

    figure: Figure
    axes: list[list[Axes]]
    bottom_in: float


def draw_grid(
    rows: Sequence[tuple[str, Sequence[Cell]]],
    *,
    heads: Sequence[str] = (),
    below_in: float = 0.0,
    bar: bool = False,
    cell_in: float = CELL_IN,
    least_width_in: float = 0.0,
) -> Grid:
    """Draw pictures in rows.

    Parameters
    ----------
    rows
        Name and cells of each.
    heads
        Of the columns, of up to two lines.
    below_in
        Inches to leave free below.
    bar
        Add the colours of saliency at the bottom.
    cell_in
        Width of a picture.
    least_width_in
        Of the figure.
    """
    columns = max(len(cells) for _, cells in rows)
    worded = [any(cell.words for cell in cells) for _, cells in rows]
    shape = next((cell.picture.shape for _, cells in rows for cell in cells if cell.picture is not None), (1, 1, 3))
    high = cell_in * shape[0] / shape[1]
    head = _HEAD_IN if heads else _EDGE_IN
    rest = len(rows) * (high + _GAP_IN) + sum(worded) * _WORDS_IN
    width = max(least_width_in, _LEFT_IN + columns * (cell_in + _GAP_IN) + _EDGE_IN)
    height = head + rest + below_in + (_BAR_IN if bar else 0) + _EDGE_IN
    with drawing_style():
        figure = Figure(figsize=(width, height))
        axes, top = [], head
        for (name, cells), has_words in zip(rows, worded, strict=True):
            place_text(
                figure, _LEFT_IN - 0.1, top + high / 2, name, ha="right", va="center", fontsize=9, wrap=True,
                parse_math=False,
            )  # fmt: skip
            axes.append([])
            for column, cell in enumerate(cells):
                left = _LEFT_IN + column * (cell_in + _GAP_IN)
                ax = place_axes(figure, left, top, cell_in, high)
                _show(cell.picture, ax=ax)
                axes[-1].append(ax)
                if cell.words:
                    place_text(
                        figure, left + cell_in / 2, top + high + 0.03, cell.words, ha="center", fontsize=7.5,
                        parse_math=False,
                    )  # fmt: skip
            top += high + _GAP_IN + (_WORDS_IN if has_words else 0)
        for column, words in enumerate(heads):
            place = _LEFT_IN + column * (cell_in + _GAP_IN) + cell_in / 2
            lines = words if "\n" in words else fill(words, _HEAD_LETTERS)
            place_text(figure, place, head - 0.06, lines, ha="center", va="bottom", fontsize=9, parse_math=False)
        if bar:
            plot_colour_bar(ax=place_axes(figure, _LEFT_IN, top + 0.14, min(4.2, width - _LEFT_IN - _EDGE_IN), 0.14))
    return Grid(figure=figure, axes=axes, bottom_in=top)


def show_map(
    picture: UInt8[np.ndarray, "height width 3"], saliency: Float[np.ndarray, "height width"]
) -> UInt8[np.ndarray, "height width 3"]:
    """Lay a map over its picture, stretched for viewing."""
    return overlay_saliency(picture, stretch_saliency(saliency))


def _show(picture: UInt8[np.ndarray, "height width 3"] | None, *, ax: Axes) -> None:
    ax.set(xticks=[], yticks=[])
    ax.grid(visible=False)
    ax.spines[:].set_visible(False)
    if picture is None:
        ax.text(0.5, 0.5, "no frame", transform=ax.transAxes, ha="center", va="center", fontsize=8, color=GREY)
    else:
        ax.imshow(picture, interpolation="none")
