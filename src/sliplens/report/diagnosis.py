"""Page of a diagnosis: slices of the error, and other frictions."""

from collections.abc import Iterable
from dataclasses import fields

from sliplens.plots.style import (
    BLACK,
    CONDITION_COLOURS,
    GREY,
    decimals,
    drawing_style,
    input_name,
    signed,
    tell_ends,
)
from sliplens.report.charts import make_charts
from sliplens.report.plates import Plate, named_columns, rows_of
from sliplens.report.tables import Table, make_table
from sliplens.results.evaluation import Diagnosis, FrictionTable


def show_diagnosis(diagnosis: Diagnosis) -> Iterable[Table | Plate]:
    """Table and plates of a diagnosis, those left out whose numbers are not there."""
    yield table_slices(diagnosis)
    if len(diagnosis.frictions):
        yield plate_frictions(diagnosis)


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
