"""Page of a grip: an episode tick by tick, what the network looked at, and what became of all episodes."""

from collections.abc import Iterable

import numpy as np

from sliplens.plots.margins import plot_grip
from sliplens.plots.saliency import overlay_relevance
from sliplens.plots.style import drawing_style, percent
from sliplens.progress import number_of
from sliplens.report.charts import make_charts
from sliplens.report.plates import Cell, Plate, draw_grid, named_columns, rows_of
from sliplens.report.tables import Table, make_table
from sliplens.results.grip import Grip


def show_grip(grip: Grip) -> Iterable[Table | Plate]:
    """Plates and table of a grip, those left out whose pictures are not there."""
    yield plate_trace(grip)
    if len(grip.maps):
        yield plate_moments(grip)
    yield table_episodes(grip)


def plate_trace(grip: Grip) -> Plate:
    """Draw force, margin and slip of the first episode."""
    figure, axes = make_charts(3, each=(3.9, 3.0))
    with drawing_style():
        plot_grip(grip.trace, axes=axes)
    names = ("time_s", "force_n", "least_force_n", "true_margin", "margin", "low", "high", "slip_m")
    first = grip.episodes.where(np.arange(1))
    fate = "fell" if first.dropped[0] else "was held"
    told = f"{float(first.mean_force_n[0]):.2f} N, {percent(float(first.force_excess[0]))} over the least that holds"
    setup = grip.setup
    how = "filmed and read by the network" if setup.rendered else "looked up in the network's measured errors"
    how = f"{how}, in order" if setup.sequence else how
    friction = "" if setup.friction is None else f" The coefficient of friction was taken for {setup.friction}."
    return Plate(
        name="grip-episode",
        figure=figure,
        alt=f"Force, margin and slip over time: the object {fate}, mean force {told}",
        caption=f"A {setup.object}, {setup.condition}, held by the controller {setup.controller}: it {fate}, with a "
        f"mean force of {told}. Readings were {how}, and answered after {1e3 * setup.latency_s:.0f} ms and the "
        f"actuator's lag. The margin read is the mean of both fingers, the true one that of the finger with less."
        + friction,
        numbers=named_columns(names, rows_of(*(getattr(grip.trace, name) for name in names))),
    )


def plate_moments(grip: Grip) -> Plate:
    """Show frames of the first finger over the maps of what moved the network's answer."""
    limit = float(np.percentile(np.abs(grip.maps), 99.5)) or 1.0
    heads = [f"{time_s:g} s" for time_s in grip.moments_s]
    frames = [Cell(picture=picture) for picture in grip.pictures]
    maps = [
        Cell(picture=overlay_relevance(picture, relevance / limit))
        for picture, relevance in zip(grip.pictures, grip.maps, strict=True)
    ]
    return Plate(
        name="grip-moments",
        figure=draw_grid([("camera", frames), ("why", maps)], heads=heads).figure,
        alt=f"Camera frames and maps at {', '.join(heads)}",
        caption="What the first finger's camera saw, and what moved the answer: orange lowers the margin against the "
        "untouched sensor, blue raises it. How far such maps can be believed is for `sliplens study` to say.",
        numbers=named_columns(
            ("time_s", "relevance"), rows_of(np.array(grip.moments_s), grip.maps.sum(axis=(1, 2)).astype(np.float64))
        ),
        pixels=True,
    )


def table_episodes(grip: Grip) -> Table:
    """Sum up all episodes, a row a grasp."""
    table, setup = grip.episodes, grip.setup
    kept = " What a slip taught of the friction counts in the grasps that follow." if setup.same_object else ""
    return make_table(
        f"What became of {number_of(len(table), 'episode')}: {setup.object}, {setup.condition}, controller "
        f"{setup.controller}.{kept}",
        ("Grasp", "Episodes", "Friction known", "Dropped", "Crushed", "Slip, median", "Mean force",
         "Over the least (quartiles)", "Under 20 %"),
        [
            (
                f"{grasp}", f"{len(own):,}", f"{int((own.known_friction > 0).sum()):,}",
                *(percent(float(share.mean()), digits=1) for share in (own.dropped, own.crushed)),
                f"{1e3 * float(np.median(own.slip_m)):.1f} mm", f"{float(own.mean_force_n.mean()):.2f} N",
                " / ".join(percent(float(one)) for one in np.quantile(own.force_excess, (0.25, 0.5, 0.75))),
                f"{float(own.under_20_s.mean()):.2f} s",
            )
            for grasp in range(1, setup.grasps + 1)
            for own in [table.where(table.grasp == grasp)]
        ],
    )  # fmt: skip
