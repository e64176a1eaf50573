"""Figures of a page; those of the thesis also as a PDF and as a table of their numbers."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sliplens.plots import charts, style
from sliplens.plots.saliency import FrameU8, PictureRow, draw_pictures
from sliplens.plots.sheets import TIMES, brighten, brightening
from sliplens.plots.style import percent, reading_words
from sliplens.report.verdict import ThesisRecord, scores_by_condition
from sliplens.results.explanation import BASELINES, Explanation, MovedMarkers, Strip, full_points, overlay_points
from sliplens.results.faithfulness import DeletionScores, is_control
from sliplens.results.study import Study

FOLDER = "figures"
"""Beside the page."""
_MOST_FRAMES = 6
_THESIS_NUMBERS = {"difference": 15, "raw": 16}


@dataclass(frozen=True, kw_only=True)
class Plate:
    """A figure with its caption, its description in words, and for figures of the thesis its numbers."""

    figure: Figure
    alt: str
    caption: str
    name: str = ""
    """Name of its files, `fig-09-...` for figure 9 of the thesis; empty for other figures, which have none."""
    columns: Sequence[str] = ()
    rows: Sequence[Sequence[Any]] = ()
    """Numbers of the figure."""
    pixels: bool = False
    """True where it is made of photographs."""

    @cached_property
    def uri(self) -> str:
        """Figure as the page holds it."""
        uri = style.figure_uri(self.figure, pixels=self.pixels)
        # what was laid out stays: doing so again for the PDF takes longer than drawing
        self.figure.set_layout_engine("none")
        return uri

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height in CSS pixels, 96 an inch."""
        width, height = (round(96 * side) for side in self.figure.get_size_inches())
        return width, height

    @property
    def files(self) -> str:
        """Where its files are found; empty without files."""
        number, path = self.name[4:6].lstrip("0"), f"{FOLDER}/{self.name}.pdf, numbers in {self.name}.csv"
        return self.name and f"Fig. {number} of the thesis, for this data; {path}."


def write_plates(plates: Sequence[Plate], folder: Path) -> tuple[Path, ...]:
    """Write each figure of the thesis as PDF and CSV; every file appears when complete."""
    written = []
    for plate in (plate for plate in plates if plate.name):
        page, table = folder / f"{plate.name}.pdf", folder / f"{plate.name}.csv"
        style.save_page(plate.figure, page)
        with style.written_whole(table) as part, part.open("w", encoding="utf-8", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(plate.columns)
            # nine digits: more would be noise of the arithmetic, and differ between machines
            writer.writerows([f"{cell:.9g}" if isinstance(cell, float) else cell for cell in row] for row in plate.rows)
        written += [page, table]
    return tuple(written)


def _make_charts(count: int, *, each: tuple[float, float]) -> tuple[Figure, list[Axes]]:
    """Make a figure of some charts, at most four in a row."""
    wide = min(count, 4)
    high = -(-count // wide)
    with style.drawing_style():
        figure = Figure(figsize=(each[0] * wide, each[1] * high), layout="constrained")
        axes = list(figure.subplots(high, wide, squeeze=False).ravel())
    for ax in axes[count:]:
        ax.set_axis_off()
    return figure, axes[:count]


def plate_strip(strip: Strip) -> Plate:
    """Draw one trial from stick to slip, its true and predicted margin, and the maps of a few frames."""
    readings = strip.readings
    ends = [reading_words(float(readings.prediction[at]), readings.withheld[at]) for at in strip.shown]
    return Plate(
        figure=charts.draw_strip(strip),
        alt=f"Camera frames of a {strip.condition} grip from stick to slip under the maps of a network, and below them "
        f"the true and the predicted safety margin over time: {ends[0]} at first and {ends[-1]} at last.",
        caption=f"One grip of {strip.source} touch from stick to slip: the first {strip.condition} trial that tests, "
        "chosen by its place alone. Above: the camera's frames under the map of "
        f"{style.method_name(strip.method)}, against {BASELINES[strip.baseline]}, one scale for all. Below: the true "
        "margin, the predicted margin, and the interval that should hold 90 % of the labels.",
        pixels=True,
    )


def plate_moved(strip: Strip, moved: MovedMarkers) -> Plate:
    """Draw a frame, and the same drawn again with the markers that a map ranks first moved back to stick."""
    few, all_, random = (style.signed(-100 * gap, 0) for gap in (moved.change, moved.change_all, moved.change_random))
    count = len(moved.from_px)
    figure = draw_pictures(
        [PictureRow(name="camera", pictures=[strip.pictures[-1], strip.redrawn[0]])],
        heads=[f"predicted {percent(moved.prediction)}", f"drawn again:\n{percent(moved.prediction - moved.change)}"],
    )
    ring = {"markersize": 5, "fillstyle": "none", "color": "white", "markeredgewidth": 0.8}
    for ax in figure.axes:
        ax.plot(*zip(*moved.from_px, strict=True), "o", **ring)
    return Plate(
        figure=figure,
        alt=f"A frame with {count} of {moved.markers} markers circled, and the frame drawn again with these moved back",
        caption=f"Moving just these {count} of {moved.markers} markers back to where they stuck changes the prediction "
        f"by {few} points; moving all of them, by {all_}; {count} random ones, by {random} (mean of "
        f"{moved.random_sets} draws). The simulator drew the second picture, and the network predicted it. The "
        "circled markers are the fewest that hold half of the evidence in the map of "
        f"{style.method_name(strip.method)}.",
        pixels=True,
    )


def plate_bins(results: Study) -> Plate:
    """Draw the MSE by bins of the margin, a chart a condition (thesis, Fig. 7)."""
    bins = {
        condition: {name: score.bins for name, score in scores.items()}
        for condition, scores in scores_by_condition(results).items()
    }
    rows = [
        (condition, name, score.low, score.high, score.frames, score.mse)
        for condition, by_input in bins.items()
        for name, scores in by_input.items()
        for score in scores
    ]
    # one scale for all conditions, or the eye compares bars that do not compare
    top = 1.15 * max((row[5] for row in rows if row[5] is not None), default=1.0)
    figure, axes = _make_charts(len(bins), each=(4.4, 3.2))
    with style.drawing_style():
        for ax, (condition, by_input) in zip(axes, bins.items(), strict=True):
            charts.plot_bins(by_input, ax=ax).set(ylim=(0, top))
            ax.set_title(f"{condition.capitalize()} objects", parse_math=False)
    return Plate(
        name="fig-07-mse-by-bin",
        figure=figure,
        alt=f"Bars of the mean squared error in bins of the safety margin: {style.listed(list(bins))}",
        caption="Mean squared error by bins of the true safety margin. A bin without bars holds no test frame.",
        columns=("condition", "input", "low", "high", "frames", "mse"),
        rows=rows,
    )


def plate_shift(record: ThesisRecord) -> Plate:
    """Draw R2 of the shipped networks against a shift of the camera."""
    figure, (ax,) = _make_charts(1, each=(5.6, 3.2))
    first, last = record.shift[0], record.shift[-1]
    with style.drawing_style():
        for name in first.r2:
            values, low, high = np.array([point.r2[name] for point in record.shift]).T
            shifts, colour = [point.shift_px for point in record.shift], style.INPUT_COLOURS[name]
            ax.plot(shifts, values, "o-", color=colour, label=style.short_input_name(name))
            ax.fill_between(shifts, low, high, color=colour, alpha=0.15, linewidth=0)
        ax.axhline(0, color=style.BLACK, linewidth=0.8)
        ax.set(xlabel="Camera shift (px)", ylabel="R² on dry test trials", ylim=(min(-0.1, ax.get_ylim()[0]), 1))
        ax.legend()
    text = "; ".join(
        f"{style.input_name(name).lower()} {first.r2[name][0]:.2f} unmoved, {last.r2[name][0]:.2f} at the end"
        for name in first.r2
    )
    return Plate(
        figure=figure,
        alt=f"R² against the shift of the camera: {text}",
        caption="What a moved camera does to each network: R² on test trials, all frames and the reference frame "
        f"shifted alike; bands are 95 % intervals over trials ({record.shift_frames}). {text[:1].upper()}{text[1:]}.",
    )


def plate_deletion(scores: Mapping[str, DeletionScores]) -> Plate:
    """Draw the mean deletion score while pixels go, a chart an input, all of one source (thesis, Fig. 9)."""
    figure, axes = _make_charts(len(scores), each=(4.6, 3.5))
    names, rows = style.inputs_in_order(scores)[::-1], []
    with style.drawing_style():
        for ax, name in zip(axes, names, strict=True):
            scored = scores[name]
            charts.plot_faithfulness(scored.curves, ax=ax).set_title(style.input_name(name))
            for method in style.methods_in_order(scored.curves):
                curve = scored.curves[method]
                ends = np.quantile(curve.scores, [0.25, 0.75], axis=0)
                values = np.stack([curve.pixels_removed, curve.scores.mean(axis=0), *ends], axis=1)
                rows += [(name, method, int(pixels), *row) for pixels, *row in values.tolist()]
    source, fill = (
        " or ".join(sorted({getattr(score, key) for score in scores.values()})) for key in ("source", "fill")
    )
    return Plate(
        name="fig-09-faithfulness",
        figure=figure,
        alt=f"Deletion score D against pixels removed: {style.listed([style.input_name(name) for name in names])}",
        caption=f"Deletion score D of the thesis on {source} touch while pixels become {fill}, most "
        "salient first; the line is the mean over frames, the band holds the middle half of them. A curve that falls "
        "early names pixels the network relies on; at the right end every pixel is filled.",
        columns=("input", "method", "pixels_removed", "mean", "quartile_low", "quartile_high"),
        rows=rows,
    )


def plate_states(results: Study, explained: Explanation) -> Plate:
    """Draw every method across the states of one trial (thesis, Figs. 15 and 16)."""
    rows = frames_by_margin(results, explained)
    frames = [explained.frames[row] for row in rows]
    methods = style.methods_in_order(name for name in explained.relevance if not is_control(name))
    what = f"Methods across the contact states, {style.input_name(explained.input).lower()}, {explained.source} touch"
    pictures, title = bright_pictures(explained, rows)
    heads = [f"Γ {percent(frame.safety_margin)}\n{reading_words(frame.prediction, frame.withheld)}" for frame in frames]
    lines = [PictureRow(name=title, pictures=pictures)]
    for method in methods:
        relevance = explained.relevance[method][rows]
        maps = overlay_points(pictures, relevance)
        lines.append(PictureRow(name=style.method_name(method), pictures=maps, full=full_points(relevance)))
    number = _THESIS_NUMBERS.get(explained.input)
    off = [abs(frame.prediction - frame.safety_margin) for frame in frames if frame.safety_margin is not None]
    errors = f" The network is off by at most {100 * max(off):.1f} percentage points on these frames." if off else ""
    return Plate(
        name=f"fig-{number}-methods-{explained.input}" if number and explained.source != "real" else "",
        figure=draw_pictures(lines, heads=heads, bar=True),
        alt=f"{what}: {style.listed([style.method_name(method) for method in methods])} from stick to slip",
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


def frames_by_margin(results: Study, explained: Explanation) -> list[int]:
    """Numbers of the frames to show: those of the study's choice, else a few of one condition; the margin falls."""
    places = {frame.id: index for index, frame in enumerate(explained.frames)}
    choice = results.choice
    chosen = [frame for frame in choice.frames if frame.pictured and frame.id in places] if choice else []
    if chosen:
        return [places[frame.id] for frame in sorted(chosen, key=lambda frame: -frame.level)]
    conditions = [frame.condition for frame in explained.frames]
    most = max(sorted(set(conditions)), key=conditions.count)
    rows = [row for row, condition in enumerate(conditions) if condition == most]
    # evenly from high to low margin; predictions play no part
    labels = {row: margin for row in rows if (margin := explained.frames[row].safety_margin) is not None}
    ranked = sorted(labels, key=lambda row: -labels[row]) or rows[:_MOST_FRAMES]
    spread = np.linspace(0, len(ranked) - 1, min(_MOST_FRAMES, len(ranked))).round().astype(int)
    return [ranked[place] for place in spread]


def bright_pictures(explained: Explanation, rows: Sequence[int]) -> tuple[list[FrameU8], str]:
    """Pictures of some frames, and their title; differences, which are dark, are brightened by one factor."""
    pictures = [explained.pictures[row] for row in rows]
    # where no change is black; elsewhere the ground would turn white
    dark = explained.input in {"difference", "amplitude"}
    factor = brightening([picture[None] for picture in pictures]) if dark else 1.0
    title = "Input" if factor == 1 else f"Input {TIMES}\N{NO-BREAK SPACE}{factor:g}"
    return [brighten(picture, factor) for picture in pictures], title
