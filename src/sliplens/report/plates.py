"""Figures of a study: each on the page, as a PDF and as a table of its numbers."""

import csv
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from textwrap import fill
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sliplens.plots.contact_sheet import TIMES, brighten, brightening
from sliplens.plots.saliency import choose_columns, overlay_saliency, plot_colour_bar, stretch_saliency
from sliplens.plots.style import (
    Picture,
    drawing_style,
    figure_picture,
    place_axes,
    place_text,
    save_page,
    write_over,
    written_whole,
)
from sliplens.report.results import Results
from sliplens.results.explanation import Explanation

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
) -> Grid:
    """Draw pictures in rows."""
    columns = max(len(cells) for _, cells in rows)
    worded = [any(cell.words for cell in cells) for _, cells in rows]
    shape = next((cell.picture.shape for _, cells in rows for cell in cells if cell.picture is not None), (1, 1, 3))
    high = cell_in * shape[0] / shape[1]
    head = _HEAD_IN if heads else _EDGE_IN
    rest = len(rows) * (high + _GAP_IN) + sum(worded) * _WORDS_IN
    width = _LEFT_IN + columns * (cell_in + _GAP_IN) + _EDGE_IN
    height = head + rest + below_in + (_BAR_IN if bar else 0) + _EDGE_IN
    with drawing_style():
        figure = Figure(figsize=(width, height))
        axes, top = [], head
        for (name, cells), has_words in zip(rows, worded, strict=True):
            aside = {"ha": "right", "va": "center", "fontsize": 9, "wrap": True, "parse_math": False}
            place_text(figure, _LEFT_IN - 0.1, top + high / 2, name, **aside)
            axes.append([])
            for column, cell in enumerate(cells):
                left_in = _LEFT_IN + column * (cell_in + _GAP_IN)
                ax = place_axes(figure, left_in, top, cell_in, high)
                _show(cell.picture, ax=ax)
                axes[-1].append(ax)
                if cell.words:
                    below = {"ha": "center", "fontsize": 7.5, "parse_math": False}
                    place_text(figure, left_in + cell_in / 2, top + high + 0.03, cell.words, **below)
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
        write_over(ax, "no frame", fontsize=8)
    else:
        ax.imshow(picture, interpolation="none")


FOLDER = "figures"
"""Beside the page."""

Numbers = Mapping[str, Sequence[Any] | np.ndarray]
"""Columns of equal length, by name."""


@dataclass(frozen=True, kw_only=True)
class Plate:
    """A figure with all that goes with it."""

    layout: ClassVar[str] = "plate"

    name: str
    """Name of its files, without suffix."""
    figure: Figure
    alt: str
    """Description in words."""
    caption: str
    numbers: Numbers
    pixels: bool = False
    """True where it is made of photographs."""

    @cached_property
    def picture(self) -> Picture:
        """Figure as the page holds it."""
        picture = figure_picture(self.figure, alt=self.alt, pixels=self.pixels)
        # what was laid out stays: doing so again for the PDF takes longer than drawing
        self.figure.set_layout_engine("none")
        return picture

    @property
    def files(self) -> str:
        """Where its files are found."""
        records = re.match(r"fig-(\d+)-", self.name)
        text = f"Fig. {int(records[1])} of the thesis, for this data;" if records else "Also"
        return f"{text} {FOLDER}/{self.name}.pdf, numbers in {self.name}.csv."


def named_columns(names: Sequence[str], rows: Sequence[Sequence[Any]]) -> dict[str, list]:
    """Turn rows into named columns."""
    return {name: [row[place] for row in rows] for place, name in enumerate(names)}


def rows_of(*arrays: np.ndarray) -> list[tuple[Any, ...]]:
    """Turn columns of equal length into rows of Python's own values."""
    return list(zip(*(array.tolist() for array in arrays), strict=True))


def write_plates(plates: Sequence[Plate], folder: Path) -> tuple[Path, ...]:
    """Write each plate as PDF and CSV; every file appears when complete."""
    written = []
    for plate in plates:
        page, table = folder / f"{plate.name}.pdf", folder / f"{plate.name}.csv"
        save_page(plate.figure, page)
        with written_whole(table) as part, part.open("w", encoding="utf-8", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(plate.numbers)
            writer.writerows(zip(*(_cells(column) for column in plate.numbers.values()), strict=True))
        written += [page, table]
    return tuple(written)


def _cells(column: Sequence[Any] | np.ndarray) -> list[Any]:
    values = column.tolist() if isinstance(column, np.ndarray) else list(column)
    # nine digits: more would be noise of the arithmetic, and differ between machines
    return [f"{value:.9g}" if isinstance(value, float) else value for value in values]


@dataclass(frozen=True, kw_only=True)
class ShownFrame:
    """Frame of a plate: the margin it stands for (None if unknown), and its place among the explained frames."""

    level: float | None
    index: int


def explained_of(results: Results, name: str) -> Explanation | None:
    """Find the explained frames of the study's source."""
    return results.explanations.get((name, results.study.source))


def shown_frames(results: Results, explained: Explanation) -> list[ShownFrame]:
    """Frames of one trial from full stick to full slip; without a choice, those a panel would show."""
    places = {frame.id: index for index, frame in enumerate(explained.frames)}
    choice = results.study.choice
    rows = [frame for frame in choice.frames if frame.shown and frame.id in places] if choice else []
    if rows:
        first = rows[0].trial
        ranked = sorted((row for row in rows if row.trial == first), key=lambda row: -row.level)
        return [ShownFrame(level=row.level, index=places[row.id]) for row in ranked]
    _, chosen = choose_columns(explained.frames)
    return [ShownFrame(level=level, index=index) for level, index in chosen if index is not None]


def bright_pictures(
    explained: Explanation, indices: Sequence[int]
) -> tuple[dict[int, UInt8[np.ndarray, "height width 3"]], str]:
    """Pictures of some frames, and what to call them; differences are made brighter all alike, to be seen."""
    factor, name = picture_brightness(explained.input, [explained.pictures[index] for index in indices])
    return {index: brighten(explained.pictures[index], factor) for index in indices}, name


def picture_brightness(name: str, pictures: Iterable[UInt8[np.ndarray, "height width 3"]]) -> tuple[float, str]:
    """By how much to brighten pictures of an input, all alike, and what to call them then."""
    # where no change is black; elsewhere the ground would turn white
    factor = brightening([picture[None] for picture in pictures]) if name in {"difference", "amplitude"} else 1.0
    return factor, "Input" if factor == 1 else f"Input {TIMES}\N{NO-BREAK SPACE}{factor:g}"
