"""Signed maps over what the network saw."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure

from sliplens.plots.style import ORANGE, SKY, drawing_style, method_name, percent, reading_words
from sliplens.results.explanation import BASELINES, DIM, Explanation, FrameU8, full_points, write_overlays

SIGN_COLOURS = LinearSegmentedColormap.from_list("sign", [ORANGE, (DIM / 2,) * 3, SKY])
"""Colours of what lowers a prediction and of what raises it over a mid-grey picture, from -1 to 1."""
POINTS = "points of margin per 1 % of the image"
"""Unit of maps in figures."""
_BAR_WORDS = f"orange lowers the prediction, blue raises it\n(full colour beside each row, in {POINTS})"
_CELL_IN, _SIDE_IN, _HEAD_IN = 1.5, 1.35, 0.45
_BAR_IN = 4.0  # as wide as the label of the colour bar
_SHARP_PX = 256
_WIDEST = 12
"""Frames of a panel at most, which can still be seen on a screen."""


def draw_explanation(explanation: Explanation, folder: Path) -> None:
    """Write an overlay of every map (`overlays/METHOD/FRAME.png`), and up to 12 frames side by side (`panel.png`)."""
    count = len(explanation.frames)
    columns = np.linspace(0, count - 1, min(count, _WIDEST)).round().astype(int).tolist()
    per = 1 if explanation.unit == "margin" else 100
    rows = [PictureRow(name="Network input", pictures=[explanation.pictures[column] for column in columns])]
    for method, relevance in explanation.relevance.items():
        overlays, names = folder / "overlays" / method, [frame.id for frame in explanation.frames]
        pictures = write_overlays(overlays, names, explanation.pictures, relevance, scale=explanation.scale)
        full = full_points(relevance, scale=explanation.scale) / per
        rows.append(PictureRow(name=method_name(method), pictures=[pictures[at] for at in columns], full=full))
    titles = []
    for frame in (explanation.frames[column] for column in columns):
        name = frame.id if len(frame.id) <= 22 else f"\N{HORIZONTAL ELLIPSIS}{frame.id[-21:]}"
        true = "" if frame.safety_margin is None else f", true {percent(frame.safety_margin)}"
        titles.append(f"{name}\n{reading_words(frame.prediction, frame.withheld, explanation.unit)}{true}")
    words = _BAR_WORDS if per == 1 else _BAR_WORDS.replace(POINTS, f"{explanation.unit_words} per 1 % of the image")
    words = f"{words}\nagainst {BASELINES[explanation.baseline]}"
    if len(columns) < count:
        words += f"\n{len(columns)} of {count} frames, evenly spread; overlays/ has them all"
    figure = draw_pictures(rows, heads=titles, bar=True, words=words)
    with drawing_style():
        figure.savefig(folder / "panel.png", dpi=120, bbox_inches="tight")


@dataclass(frozen=True, kw_only=True)
class PictureRow:
    """Pictures beside each other, with the name of the row and words below each."""

    name: str
    pictures: Sequence[FrameU8]
    words: Sequence[str] = ()
    full: float | None = None
    """Relevance of the full colour, in `POINTS`; None for pictures without a map."""


def draw_pictures(
    rows: Sequence[PictureRow], *, heads: Sequence[str], bar: bool = False, words: str = _BAR_WORDS
) -> Figure:
    """Draw rows of pictures under heads, and the bar of their colours with words below."""
    gap, foot = 0.25 if any(row.words for row in rows) else 0.06, 0.8 if bar else 0.1
    across, down = len(heads) * (_CELL_IN + 0.06), len(rows) * (_CELL_IN + gap)
    width, height = _SIDE_IN + max(across, _BAR_IN), _HEAD_IN + down + foot
    small: Any = {"fontsize": 7.5, "parse_math": False}
    with drawing_style():
        figure = Figure(figsize=(width, height))
        # a fixed grid: laying out a hundred axes takes seconds
        grid = figure.add_gridspec(
            len(rows), len(heads), wspace=0.06 / _CELL_IN, hspace=gap / _CELL_IN,
            left=_SIDE_IN / width, right=(_SIDE_IN + across - 0.06) / width,
            top=1 - _HEAD_IN / height, bottom=(foot + gap) / height,
        )  # fmt: skip
        for line, row in enumerate(rows):
            name = row.name if row.full is None else f"{row.name}\nfull colour: {row.full:.2g}"
            for column, picture in enumerate(row.pictures):
                ax = figure.add_subplot(grid[line, column], xticks=[], yticks=[])
                # large pictures are smoothed, so that thin outlines do not break
                ax.imshow(picture, interpolation="none" if len(picture) <= _SHARP_PX else "antialiased")
                ax.spines[:].set_visible(False)
                if not line:
                    ax.set_title(heads[column], loc="center", fontweight="normal", pad=4, **small)
                if row.words:
                    ax.set_xlabel(row.words[column], labelpad=2, **small)
                if not column:
                    aside = fill(name, 20, replace_whitespace=False)
                    ax.set_ylabel(aside, rotation=0, ha="right", va="center", fontsize=8.5, parse_math=False)
        if bar:
            place = figure.add_axes((_SIDE_IN / width, (foot - 0.22) / height, _BAR_IN / width, 0.12 / height))
            colours = ScalarMappable(Normalize(-1, 1), SIGN_COLOURS)
            colour_bar = figure.colorbar(colours, cax=place, orientation="horizontal", ticks=[-1, 0, 1])
            colour_bar.ax.set_xticklabels(["\N{MINUS SIGN}full colour", "0", "+full colour"], fontsize=7)
            colour_bar.ax.set_xlabel(words, fontsize=8)
    return figure
