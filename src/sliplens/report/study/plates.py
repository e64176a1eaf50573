"""Figures of a study: each on the page, as a PDF and as a table of its numbers."""

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sliplens.report.drawing import Chart, figure_picture
from sliplens.report.pages import save_page, written_whole

FOLDER = "figures"
"""Beside the page."""

_THESIS_FIGURE = re.compile(r"fig-(\d+)-")

Numbers = Mapping[str, Sequence[Any] | np.ndarray]
"""Columns of equal length, by name."""


@dataclass(frozen=True, kw_only=True)
class Plate:
    """A figure with all that goes with it.

    Attributes
    ----------
    name
        Of its files, without suffix.
    alt
        What it shows, in words.
    caption
        Written from the numbers.
    numbers
        What is drawn.
    pixels
        Whether it is made of photographs.
    """

    name: str
    figure: Figure
    alt: str
    caption: str
    numbers: Numbers
    pixels: bool = False


def show_plate(plate: Plate) -> Chart:
    """Hold a plate for the page."""
    picture = figure_picture(plate.figure, alt=plate.alt, pixels=plate.pixels)
    # what was laid out stays: doing so again for the PDF takes longer than drawing
    plate.figure.set_layout_engine("none")
    return Chart(
        pictures=(picture,),
        caption=plate.caption,
        columns=1,
        files=f"{_tell_thesis(plate.name)} {FOLDER}/{plate.name}.pdf, numbers in {plate.name}.csv.",
    )


def _tell_thesis(name: str) -> str:
    found = _THESIS_FIGURE.match(name)
    return f"Fig. {int(found[1])} of the thesis, for this data;" if found else "Also"


def write_plates(plates: Sequence[Plate], folder: Path) -> tuple[Path, ...]:
    """Write each plate as PDF and CSV; every file appears when complete.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
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
