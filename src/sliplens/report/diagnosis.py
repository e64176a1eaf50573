"""Page of a diagnosis: slices of the error, other frictions, and kinds of explanations."""

from collections.abc import Iterable
from dataclasses import fields

import numpy as np

from sliplens.plots.contact_sheet import brighten
from sliplens.plots.saliency import SIGN_COLOURS, full_colour, overlay_relevance
from sliplens.plots.style import (
    BLACK,
    CONDITION_COLOURS,
    GREY,
    decimals,
    drawing_style,
    input_name,
    percent,
    place_axes,
    signed,
    tell_ends,
)
from sliplens.progress import number_of
from sliplens.report.charts import make_charts
from sliplens.report.plates import Cell, Plate, draw_grid, named_columns, picture_brightness, rows_of
from sliplens.report.tables import Table, make_table
from sliplens.results.evaluation import Diagnosis, FrictionTable


def show_diagnosis(diagnosis: Diagnosis) -> Iterable[Table | Plate]:
    """Table and plates of a diagnosis, those left out whose numbers are not there."""
    yield table_slices(diagnosis)
    if len(diagnosis.frictions):
        yield plate_frictions(diagnosis)
    yield plate_kinds(diagnosis)


def table_slices(diagnosis: Diagnosis) -> Table:
    """Slices with their error on held-out trials, and whether it is larger than elsewhere."""
    return make_table(
        f"Where the error is, {input_name(diagnosis.input).lower()}, in percentage points of Γ: slices that a tree "
        "found on half of the trials, tested on the other half. Larger: beyond the 95 % interval, on five trials.",
        ("Slice", "Frames", "Trials", "Mean |error|", "Mean error", "Less elsewhere (95 %)"),
        [
            (
                part.name.replace(", ", ",\n"), f"{part.frames:,}", str(part.trials), f"{100 * part.error:.1f}",
                _points(part.bias),
                f"{_points(part.excess.estimate)} ({tell_ends(part.excess, _points)})"
                f"{', larger' if part.holds else ''}",
            )
            for part in diagnosis.slices
        ],
    )  # fmt: skip


def _points(margin: float) -> str:
    return signed(100 * margin, 1)


def plate_frictions(diagnosis: Diagnosis) -> Plate:
    """Draw the answer against the true margin as friction alone changes, a line a frame."""
    names, groups = [field.name for field in fields(FrictionTable)], diagnosis.frictions.groups("condition")
    figure, axes = make_charts(len(groups), each=(4.2, 3.6))
    text = {
        slope.condition: f"slope {decimals(slope.network.estimate, 2)}, best {decimals(slope.reading.estimate, 2)}"
        for slope in diagnosis.slopes
    }
    with drawing_style():
        for ax, ((condition,), group) in zip(axes, groups.items(), strict=True):
            ax.plot([0, 100], [0, 100], color=BLACK, linestyle="--", linewidth=1)
            for rows in group.groups("frame_id").values():
                line = {
                    "color": CONDITION_COLOURS.get(condition, GREY),
                    "alpha": 0.7,
                    "linewidth": 1.2,
                    "markersize": 3,
                }
                ax.plot(100 * rows.safety_margin, 100 * rows.prediction, marker="o", **line)
            ax.set_title(f"{condition.capitalize()}: {text.get(condition, 'no slope')}", parse_math=False)
            ax.set(xlabel="True Γ with that friction (%)", ylabel="Predicted Γ (%)", xlim=(-3, 103))
    return Plate(
        name=f"diagnosis-frictions-{diagnosis.input}",
        figure=figure,
        alt=f"Answer against true margin as friction alone changes: {text}",
        caption="The same press and pull filmed anew with other frictions, the forces kept, a line a frame: a network "
        "that reads friction from what it sees rises as the dashed line does, one that answers by habit stays level. "
        "Best: the slope of the best reading of the markers, which knows how far frictions and loads range: far below "
        "1 where the picture hardly shows the friction.",
        numbers=named_columns(names, rows_of(*(getattr(diagnosis.frictions, name) for name in names))),
    )


def plate_kinds(diagnosis: Diagnosis) -> Plate:
    """Show the frames most like each kind of explanation beside their maps, in one scale of colours."""
    table, maps = diagnosis.explained, diagnosis.maps
    factor, name = picture_brightness(diagnosis.input, diagnosis.pictures)
    pictures, top = brighten(diagnosis.pictures, factor), full_colour(maps)
    rows, chosen, columns = [], [], ("kind", "frames", "trials", "error", "bias", "safety_margin", "friction")
    for kind in np.unique(table.cluster).tolist():
        frames = table.where(table.cluster == kind)
        means = [
            float(values.mean())
            for values in (np.abs(frames.error), frames.error, frames.safety_margin, frames.friction)
        ]
        rows.append((kind + 1, len(frames), len(np.unique(frames.trial)), *means))
        cells = []
        for example in np.sort(frames.example[frames.example >= 0]).tolist():
            record = frames.where(frames.example == example)
            ((margin, answer, condition),) = rows_of(record.safety_margin, record.prediction, record.condition)
            words = f"Γ {percent(margin)}, read {percent(answer)}"
            picture = pictures[example]
            painted = overlay_relevance(picture, maps[example] / top)
            cells += [Cell(picture=picture, words=words), Cell(picture=painted, words=condition)]
        chosen.append(
            (f"Kind {kind + 1}: {number_of(len(frames), 'frame')}, off by {100 * means[0]:.1f} points", cells)
        )
    heads = [name, "parts"] * (max(len(cells) for _, cells in chosen) // 2)
    grid = draw_grid(chosen, heads=heads, below_in=0.6)
    with drawing_style():
        bar = place_axes(grid.figure, 1.25, grid.bottom_in + 0.12, 4.2, 0.14)
        ends = (-100 * top, 100 * top, 0, 1)
        bar.imshow(np.linspace(-1, 1, 256)[None], cmap=SIGN_COLOURS, extent=ends, aspect="auto")
        bar.set(yticks=[], xlabel="Part in the answer (percentage points of Γ): lowers it, raises it")
    return Plate(
        name=f"diagnosis-kinds-{diagnosis.input}",
        figure=grid.figure,
        alt=f"Examples of each kind of explanation: {'; '.join(words for words, _ in chosen)}",
        caption=f"Kinds of explanations, that of the largest error first (k-means on {diagnosis.method}, each frame's "
        "divided by the sum of their sizes), and the frames nearest to the middle of each.",
        numbers=named_columns(columns, rows),
        pixels=True,
    )
