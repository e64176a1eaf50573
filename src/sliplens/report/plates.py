"""Figures of a page: each on the page, as a PDF and as a table of its numbers."""

import csv
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from matplotlib.figure import Figure

from sliplens.plots.contact_sheet import TIMES, brighten, brightening
from sliplens.plots.margins import draw_strip
from sliplens.plots.saliency import (
    FrameU8,
    PictureRow,
    draw_pictures,
    full_points,
    overlay_points,
)
from sliplens.plots.style import (
    Picture,
    figure_picture,
    input_name,
    listed,
    method_name,
    methods_in_order,
    percent,
    reading_words,
    save_page,
    source_name,
    written_whole,
)
from sliplens.report.results import Results
from sliplens.results.explanation import BASELINES, Explanation, MovedMarkers, Strip
from sliplens.results.faithfulness import is_control

FOLDER = "figures"
"""Beside the page."""
_MOST_FRAMES = 6
_THESIS_NUMBERS = {"difference": 15, "raw": 16}


@dataclass(frozen=True, kw_only=True)
class Plate:
    """A figure with its caption, its description in words and its numbers."""

    layout: ClassVar[str] = "plate"

    name: str
    """Name of its files, without suffix; `fig-09-...` is figure 9 of the thesis."""
    figure: Figure
    alt: str
    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    """Numbers of the figure."""
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
        number = re.match(r"fig-(\d+)-", self.name)
        text = f"Fig. {int(number[1])} of the thesis, for this data;" if number else "Also"
        return f"{text} {FOLDER}/{self.name}.pdf, numbers in {self.name}.csv."


def write_plates(plates: Sequence[Plate], folder: Path) -> tuple[Path, ...]:
    """Write each plate as PDF and CSV; every file appears when complete."""
    written = []
    for plate in plates:
        page, table = folder / f"{plate.name}.pdf", folder / f"{plate.name}.csv"
        save_page(plate.figure, page)
        with written_whole(table) as part, part.open("w", encoding="utf-8", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(plate.columns)
            # nine digits: more would be noise of the arithmetic, and differ between machines
            writer.writerows([f"{cell:.9g}" if isinstance(cell, float) else cell for cell in row] for row in plate.rows)
        written += [page, table]
    return tuple(written)


def rows_of(*columns: Iterable[Any]) -> list[tuple[Any, ...]]:
    """Turn columns of equal length into rows of Python's own values."""
    return list(
        zip(*(column.tolist() if isinstance(column, np.ndarray) else column for column in columns), strict=True)
    )


def plate_strip(strip: Strip) -> Plate:
    """Draw one trial from stick to slip, its true and predicted margin, and the maps of a few frames."""
    readings = strip.readings
    ends = [reading_words(float(readings.prediction[at]), readings.withheld[at]) for at in strip.shown]
    return Plate(
        name="strip",
        figure=draw_strip(strip),
        alt=f"Camera frames of a {strip.condition} grip from stick to slip under the maps of a network, and below them "
        f"the true and the predicted safety margin over time: {ends[0]} at first and {ends[-1]} at last.",
        caption=f"One grip of {source_name(strip.source)} from stick to slip: the first {strip.condition} trial that "
        f"tests, chosen by its place alone. Above: the camera's frames under the map of {method_name(strip.method)}, "
        f"against {BASELINES[strip.baseline]}, one scale for all. Below: the true margin, the predicted margin, and "
        "the interval that should hold 90 % of the labels.",
        columns=list(vars(readings)),
        rows=rows_of(*vars(readings).values()),
        pixels=True,
    )


def plate_moved(strip: Strip, moved: MovedMarkers) -> Plate:
    """Draw a frame, and the same drawn anew with the markers that a map ranks first moved back to stick."""
    count = len(moved.from_px)
    few = f"{count} of {moved.markers} markers"
    figure = draw_pictures(
        [PictureRow(name="camera", pictures=[strip.pictures[-1], strip.redrawn[0]])],
        heads=[f"predicted {percent(moved.prediction)}", f"drawn anew:\n{percent(moved.prediction - moved.change)}"],
    )
    for ax in figure.axes:
        ax.plot(
            *zip(*moved.from_px, strict=True), "o", markersize=5, fillstyle="none", color="white", markeredgewidth=0.8
        )
    return Plate(
        name="moved-markers",
        figure=figure,
        alt=f"A frame with {few} circled, and the frame drawn anew with these moved back",
        caption=f"Moving just these {few} back to where they stuck changes the prediction by {_opposite(moved.change)} "
        f"points; moving all of them, by {_opposite(moved.change_all)}; {count} random ones, by "
        f"{_opposite(moved.change_random)} (mean of {moved.random_sets} draws). The simulator drew the second picture "
        "anew, and the network predicted it. The circled markers are the fewest that hold half of the evidence in the "
        f"map of {method_name(strip.method)}.",
        columns=("from_x_px", "from_y_px", "to_x_px", "to_y_px"),
        rows=[(*now, *then) for now, then in zip(moved.from_px, moved.to_px, strict=True)],
        pixels=True,
    )


def _opposite(change: float) -> str:
    return f"{-100 * change:+.0f}".replace("-", "\N{MINUS SIGN}")


def plate_states(results: Results, explained: Explanation) -> Plate:
    """Draw every method across the states of one trial (thesis, Figs. 15 and 16)."""
    rows = frames_by_margin(results, explained)
    frames = [explained.frames[row] for row in rows]
    methods = methods_in_order(name for name in explained.relevance if not is_control(name))
    what = f"Methods across the contact states, {input_name(explained.input).lower()}, {source_name(explained.source)}"
    pictures, title = bright_pictures(explained, rows)
    heads = [f"Γ {percent(frame.safety_margin)}\n{reading_words(frame.prediction, frame.withheld)}" for frame in frames]
    lines = [PictureRow(name=title, pictures=pictures)]
    for method in methods:
        relevance = explained.relevance[method][rows]
        maps = overlay_points(pictures, relevance)
        lines.append(PictureRow(name=method_name(method), pictures=maps, full=full_points(relevance)))
    number = _THESIS_NUMBERS.get(explained.input)
    name = f"fig-{number}-methods-{explained.input}" if number else f"methods-{explained.input}"
    off = [abs(frame.prediction - frame.safety_margin) for frame in frames if frame.safety_margin is not None]
    errors = f" The network is off by at most {100 * max(off):.1f} percentage points on these frames." if off else ""
    return Plate(
        name=f"real-{explained.input}" if explained.source == "real" else name,
        figure=draw_pictures(lines, heads=heads, bar=True),
        alt=f"{what}: {listed([method_name(method) for method in methods])} from stick to slip",
        caption=f"{what}, from full stick to full slip.{errors} Orange lowers the margin against that of "
        f"{BASELINES[explained.baseline]}, blue raises it; one scale a method, so that its frames compare and methods "
        "do not.",
        columns=("input", "method", "frame_id", "safety_margin", "prediction", "relevance"),
        rows=[
            (explained.input, method, frame.id, frame.safety_margin, frame.prediction, float(relevance.sum()))
            for method in methods
            for frame, relevance in zip(frames, explained.relevance[method][rows], strict=True)
        ],
        pixels=True,
    )


def frames_by_margin(results: Results, explained: Explanation) -> list[int]:
    """Numbers of the frames to show: those of the study's choice, else a few of one condition; the margin falls."""
    places = {frame.id: index for index, frame in enumerate(explained.frames)}
    choice = results.choice
    chosen = [frame for frame in choice.frames if frame.pictured and frame.id in places] if choice else []
    if chosen:
        chosen = [frame for frame in chosen if frame.trial == chosen[0].trial]
        return [places[frame.id] for frame in sorted(chosen, key=lambda frame: -frame.level)]
    conditions = [frame.condition for frame in explained.frames]
    most = max(sorted(set(conditions)), key=conditions.count)
    rows = [row for row, condition in enumerate(conditions) if condition == most]
    return spread_frames(explained, rows, _MOST_FRAMES) or rows[:_MOST_FRAMES]


def spread_frames(explained: Explanation, rows: Iterable[int], count: int) -> list[int]:
    """Choose a few of the labelled frames, evenly from high to low margin; predictions play no part."""
    labels = {row: margin for row in rows if (margin := explained.frames[row].safety_margin) is not None}
    ranked = sorted(labels, key=lambda row: -labels[row])
    places = np.linspace(0, len(ranked) - 1, min(count, len(ranked))).round().astype(int)
    return [ranked[place] for place in places]


def bright_pictures(explained: Explanation, rows: Sequence[int]) -> tuple[list[FrameU8], str]:
    """Pictures of some frames, and their title; differences, which are dark, are brightened by one factor."""
    pictures = [explained.pictures[row] for row in rows]
    # where no change is black; elsewhere the ground would turn white
    dark = explained.input in {"difference", "amplitude"}
    factor = brightening([picture[None] for picture in pictures]) if dark else 1.0
    title = "Input" if factor == 1 else f"Input {TIMES}\N{NO-BREAK SPACE}{factor:g}"
    return [brighten(picture, factor) for picture in pictures], title
