"""Signed maps over what the network saw."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize, to_rgb
from matplotlib.figure import Figure

from sliplens.images import write_png
from sliplens.plots.style import ORANGE, SKY, drawing_style, method_name, percent, place_axes, place_text, reading_words
from sliplens.results.explanation import BASELINES, Explanation, full_colour

FrameU8: TypeAlias = UInt8[np.ndarray, "height width 3"]
"""A picture, RGB."""
DIM = 0.55  # of the picture's lightness: leaves the bright end of the colours to the relevance
LOWERS, RAISES = ORANGE, SKY
"""Colours of what lowers an answer and of what raises it: bright on dark, and told apart by everyone."""
SIGN_COLOURS = LinearSegmentedColormap.from_list("sign", [LOWERS, (DIM / 2,) * 3, RAISES])
"""Both over a mid-grey picture, from -1 to 1."""


def overlay_relevance(picture: FrameU8, share: Float[np.ndarray, "rows columns"]) -> FrameU8:
    """Picture in dimmed grey under a signed map in [-1, 1]: orange lowers, blue raises, the stronger the less grey.

    A map of another height and width than the picture's is repeated.
    """
    places = [np.arange(side) * count // side for side, count in zip(picture.shape, share.shape, strict=False)]
    value = np.clip(share[np.ix_(*places)].astype(np.float64), -1, 1)[..., None]
    colour = np.where(value < 0, to_rgb(LOWERS), to_rgb(RAISES))
    lightness = picture @ np.array([0.299, 0.587, 0.114]) / 255  # luma by ITU-R BT.601
    mixed = (1 - np.abs(value)) * DIM * lightness[..., None] + np.abs(value) * colour
    return np.round(255 * mixed).astype(np.uint8)


POINTS = "points of margin per 1 % of the image"
"""Unit of maps in figures."""
_BAR_WORDS = f"orange lowers the prediction, blue raises it\n(full colour beside each row, in {POINTS})"
_CELL_IN, _SIDE_IN, _HEAD_IN = 1.5, 1.35, 0.45
_BAR_IN = 4.0  # as wide as the label of the colour bar
_SHARP_PX = 256
_WIDEST = 12
"""Frames of a panel at most, which can still be seen on a screen."""
_LEAST = 0.2
"""Least full colour, in points of margin per 1 % of the image: 2 points, which is nothing to explain, on a tenth."""


def full_points(relevance: Float[np.ndarray, "frames height width"], *, scale: float = 1.0) -> float:
    """Return the relevance that gets the full colour in all frames, in points of margin per 1 % of the image."""
    return max(full_colour(relevance * relevance[0].size), _LEAST * scale)


def overlay_points(
    pictures: Iterable[FrameU8], relevance: Float[np.ndarray, "frames height width"], *, scale: float = 1.0
) -> list[FrameU8]:
    """Overlay pictures with signed maps on one scale (`full_points`)."""
    limit = full_points(relevance, scale=scale)
    return [
        overlay_relevance(picture, values * values.size / limit)
        for picture, values in zip(pictures, relevance, strict=True)
    ]


def draw_explanation(explanation: Explanation, folder: Path) -> None:
    """Write an overlay of every map (`overlays/METHOD/FRAME.png`), and up to 12 frames side by side (`panel.png`)."""
    count = len(explanation.frames)
    columns = np.linspace(0, count - 1, min(count, _WIDEST)).round().astype(int).tolist()
    per = 1 if explanation.unit == "margin" else 100
    rows = [PictureRow(name="Network input", pictures=[explanation.pictures[column] for column in columns])]
    for method, relevance in explanation.relevance.items():
        (overlays := folder / "overlays" / method).mkdir(parents=True, exist_ok=True)
        pictures = overlay_points(explanation.pictures, relevance, scale=explanation.scale)
        for frame, picture in zip(explanation.frames, pictures, strict=True):
            write_png(overlays / f"{frame.id}.png", picture)
        shown = [pictures[column] for column in columns]
        rows.append(
            PictureRow(
                name=method_name(method), pictures=shown, full=full_points(relevance, scale=explanation.scale) / per
            )
        )
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
    rows: Sequence[PictureRow],
    *,
    heads: Sequence[str],
    bar: bool = False,
    words: str = _BAR_WORDS,
    title: str | None = None,
) -> Figure:
    """Draw rows of pictures under heads, and the bar of their colours with words below."""
    step = _CELL_IN + 0.06
    bottoms = np.cumsum([step + (0.2 if any(row.words) else 0) for row in rows]) + _HEAD_IN
    small: Any = {"fontsize": 7.5, "ha": "center", "parse_math": False}
    aside: Any = {"fontsize": 8.5, "ha": "right", "va": "center", "parse_math": False}
    with drawing_style():
        # placed by hand: laying out a hundred axes takes seconds
        figure = Figure(figsize=(_SIDE_IN + max(step * len(heads), _BAR_IN), bottoms[-1] + (0.8 if bar else 0.1)))
        place_text(figure, 0.1, 0.05, title or "", fontsize=11, fontweight="bold", parse_math=False)
        for row, top in zip(rows, [_HEAD_IN, *bottoms], strict=False):
            name = row.name if row.full is None else f"{row.name}\nfull colour: {row.full:.2g}"
            place_text(figure, _SIDE_IN - 0.1, top + _CELL_IN / 2, fill(name, 20, replace_whitespace=False), **aside)
            for column, picture in enumerate(row.pictures):
                ax = place_axes(figure, _SIDE_IN + column * step, top, _CELL_IN, _CELL_IN)
                # large pictures are smoothed, so that thin outlines do not break
                ax.imshow(picture, interpolation="none" if len(picture) <= _SHARP_PX else "antialiased")
                ax.set_axis_off()
            for column, text in enumerate(row.words):
                place_text(figure, _SIDE_IN + column * step + _CELL_IN / 2, top + _CELL_IN + 0.03, text, **small)
        for column, text in enumerate(heads):
            place_text(figure, _SIDE_IN + column * step + _CELL_IN / 2, _HEAD_IN - 0.05, text, va="bottom", **small)
        if bar:
            place = place_axes(figure, _SIDE_IN, bottoms[-1] + 0.1, _BAR_IN, 0.12)
            colours = ScalarMappable(Normalize(-1, 1), SIGN_COLOURS)
            colour_bar = figure.colorbar(colours, cax=place, orientation="horizontal", ticks=[-1, 0, 1])
            colour_bar.ax.set_xticklabels(["\N{MINUS SIGN}full colour", "0", "+full colour"], fontsize=7)
            colour_bar.ax.set_xlabel(words, fontsize=8)
    return figure
