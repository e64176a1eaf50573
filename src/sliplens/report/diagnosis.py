"""Page of a diagnosis: slices of the error."""

from sliplens.plots.style import input_name, signed, tell_ends
from sliplens.report.tables import Table, make_table
from sliplens.results.evaluation import Diagnosis


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
