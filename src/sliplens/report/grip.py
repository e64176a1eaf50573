"""Page of a grip: an episode tick by tick, maps of its frames, and a table of all episodes."""

from collections.abc import Iterable

import numpy as np

from sliplens.grip.records import Grip
from sliplens.plots.margins import plot_grip
from sliplens.plots.saliency import overlay_relevance
from sliplens.plots.style import drawing_style, percent
from sliplens.progress import number_of
from sliplens.report.charts import make_charts
from sliplens.report.plates import Cell, Plate, draw_grid, named_columns, rows_of
from sliplens.report.tables import Table, make_table


def show_grip(grip: Grip) -> Iterable[Table | Plate]:
    """Return the plates and the table of a grip; without rendered frames there are no maps."""
    yield plate_trace(grip)
    if len(grip.maps):
        yield plate_moments(grip)
    yield table_episodes(grip)


def plate_trace(grip: Grip) -> Plate:
    """Draw force, margin and slip of the first episode."""
    figure, axes = make_charts(3, each=(3.9, 3.0))
    with drawing_style():
        plot_grip(grip.trace.table(), axes=axes)
    names = ("time_s", "force_n", "least_force_n", "true_margin", "margin", "low", "high", "slip_m")
    first = grip.episodes.where(np.arange(1))
    fate = "fell" if first.dropped[0] else "was held"
    force = f"{float(first.mean_force_n[0]):.2f} N, {percent(float(first.force_excess[0]))} over the least that holds"
    setup = grip.setup
    how = "those of drawn frames" if setup.rendered else "looked up in the network's measured errors"
    friction = "" if setup.friction is None else f" Predictions used the coefficient of friction {setup.friction}."
    return Plate(
        name="grip-episode",
        figure=figure,
        alt=f"Force, margin and slip over time: the object {fate}, mean force {force}",
        caption=f"A {setup.object}, {setup.condition}, held by the controller {setup.controller}: it {fate}, with a "
        f"mean force of {force}. Predictions were {how}, with a latency of {1e3 * setup.latency_s:.0f} ms and the "
        f"actuator's lag. The predicted margin is the mean of both fingers, the true one that of the finger with less."
        + friction,
        numbers=named_columns(names, rows_of(*(getattr(grip.trace, name) for name in names))),
    )


def plate_moments(grip: Grip) -> Plate:
    """Show frames of the first finger, and the maps that explain their predictions."""
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
        caption="Frames of the first finger, and their relevance: orange lowers the margin against the untouched "
        "sensor, blue raises it. How far to trust such maps: run `sliplens study`.",
        numbers=named_columns(
            ("time_s", "relevance"), rows_of(np.array(grip.moments_s), grip.maps.sum(axis=(1, 2)).astype(np.float64))
        ),
        pixels=True,
    )


def table_episodes(grip: Grip) -> Table:
    """Summarise all episodes."""
    rows, setup = grip.episodes, grip.setup
    what = f"{setup.object}, {setup.condition}, controller {setup.controller}"
    return make_table(
        f"{number_of(len(rows), 'episode')}: {what}.",
        ("Episodes", "Friction known", "Dropped", "Crushed", "Slip, median", "Mean force",
         "Over the least (quartiles)", "Under 20 %"),
        [
            (
                f"{len(rows):,}", f"{int((rows.known_friction > 0).sum()):,}",
                *(percent(float(flags.mean()), digits=1) for flags in (rows.dropped, rows.crushed)),
                f"{1e3 * float(np.median(rows.slip_m)):.1f} mm", f"{float(rows.mean_force_n.mean()):.2f} N",
                " / ".join(percent(float(excess)) for excess in np.quantile(rows.force_excess, (0.25, 0.5, 0.75))),
                f"{float(rows.under_20_s.mean()):.2f} s",
            )
        ],
    )  # fmt: skip
