"""Layout of a trial in the Rerun viewer: pictures at the left, what was measured in the middle, words at the right."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from sliplens.report.style import BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILLION
from sliplens.report.trial_charts import TIMES
from sliplens.report.viewer_process import require_rerun

if TYPE_CHECKING:
    from rerun.blueprint import Blueprint, TimeSeriesView

# colours that are read on a dark ground and on a light one: the viewer has both, so nothing is black
LINES = {
    "force/normal": ("F_n (N)", BLUE),
    "force/tangential": ("F_t (N)", VERMILLION),
    "force/limit": ("μ F_n (N)", GREY),
    "ratio/tangential_to_normal": ("F_t / F_n", BLUE),
    "ratio/static_friction": ("μ_s", GREEN),
    "ratio/friction": ("μ, sticking or slipping", GREEN),
    "margin/gamma": ("Γ (%)", SKY),
    "margin/band/high": ("Γ + \N{GREEK SMALL LETTER SIGMA} (%)", PURPLE),
    "margin/band/low": ("Γ \N{MINUS SIGN} \N{GREEK SMALL LETTER SIGMA} (%)", PURPLE),
    "margin/stick_ratio": ("stick ratio (%)", ORANGE),
}
"""Entity, name and colour of each number of a frame."""
SAMPLE_LINES = {"x (N), as recorded": VERMILLION, "y (N), as recorded": GREEN, "z (N), as recorded": BLUE}
"""The same of each axis of the force sensor."""


@dataclass(frozen=True, kw_only=True)
class Shown:
    """What of a trial there is to lay out."""

    size: tuple[int, int]
    """Height and width of a frame, in pixels."""
    factor: float
    """Of the differences' brightness."""
    highest_ratio: float
    """Of F_t / F_n that is worth seeing."""
    truth: bool
    """Whether contact and markers are known."""
    sensor: bool
    """Whether samples of the force sensor are kept."""


def lay_out(shown: Shown) -> "Blueprint":
    """Lay out a trial: what is seen at first sight, before anything is moved."""
    rrb = require_rerun().blueprint
    height, width = shown.size
    bounds = rrb.VisualBounds2D(x_range=(0, width), y_range=(0, height))
    truth = ": contact, stick zone, markers" if shown.truth else ""
    pictures = (
        ("camera", f"camera T_n{truth}"),
        ("difference", f"difference |T_n \N{MINUS SIGN} T_0| {TIMES} {shown.factor:g}"),
        ("reference", "reference T_0"),
    )
    camera, difference, reference = (
        rrb.Spatial2DView(origin=origin, name=name, visual_bounds=bounds) for origin, name in pictures
    )
    states = rrb.StateTimelineView(origin="state", name="contact state")
    charts = [
        _chart("margin", "safety margin Γ and stick ratio (%)", "LeftBottom", (-5.0, 105.0)),
        _chart("force", "forces (N)", "RightBottom"),
        _chart("ratio", "F_t / F_n in contact, beside friction", "RightBottom", (0.0, shown.highest_ratio)),
        *([_chart("sensor", "force sensor, as recorded (N)", "RightBottom")] if shown.sensor else []),
    ]
    about = rrb.TextDocumentView(origin="about", name="about this trial")
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(camera, difference),
            rrb.Vertical(states, *charts, row_shares=[0.6, *(1 for _ in charts)]),
            rrb.Vertical(about, reference, row_shares=[2, 1]),
            column_shares=[2, 3, 1.4],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        # the fingertip untouched tells nothing, so it plays
        rrb.TimePanel(state="collapsed", timeline="time", play_state="playing", loop_mode="off"),
        auto_views=False,
    )


def _chart(origin: str, name: str, legend: str, span: tuple[float, float] | None = None) -> "TimeSeriesView":
    rrb = require_rerun().blueprint
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        axis_x=rrb.TimeAxis(link="LinkToGlobal"),
        axis_y=rrb.ScalarAxis(range=span) if span else None,
        plot_legend=rrb.PlotLegend(corner=legend),
    )
