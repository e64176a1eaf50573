"""Figures of the sound tests: curves of removal by fill, and maps of networks whose weights were drawn anew."""

from textwrap import fill as wrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sliplens.report.study.evidence import controls, settings
from sliplens.report.study.plates import Plate
from sliplens.report.study.scored import Faithful, RemovalCurve
from sliplens.report.style import (
    BLACK,
    CONTROLS,
    METHOD_COLOURS,
    METHOD_LINES,
    PURPLE,
    drawing_style,
    fill_name,
    input_name,
    inputs_in_order,
    listed,
    method_name,
    methods_in_order,
    short_input_name,
    signed,
)
from sliplens.report.workspace import Results

_LETTERS = 20
"""Of a line beside a chart."""


def plate_removal_curves(faithful: Faithful) -> Plate | None:
    """Draw change against area, most and least influential first and at random, by method and fill; None without."""
    known = controls(faithful)
    methods = methods_in_order({method for _, _, method in faithful.curves} - known - set(CONTROLS))
    fills = settings(faithful)
    if not methods or not fills:
        return None
    shown = [curve for key, curve in faithful.curves.items() if key[2] in methods]
    top = max(float(curve.most_first.mean(axis=0).max()) for curve in shown)
    # below zero where more speaks for the answer than before
    bottom = min(float(line.mean(axis=0).min()) for one in shown for line in (one.most_first, one.least_first))
    with drawing_style():
        figure = Figure(figsize=(1.75 * len(fills) + 0.9, 1.55 * len(methods) + 0.9), layout="constrained")
        axes = figure.subplots(len(methods), len(fills), squeeze=False, sharex=True, sharey=True)
        for line, method in zip(axes, methods, strict=True):
            for ax, (fill, unit) in zip(line, fills, strict=True):
                curve = faithful.curves.get((fill, unit, method))
                if curve is None:
                    ax.set_axis_off()
                    continue
                _plot_removal(curve, method, ax=ax)
            line[0].set_ylabel(wrap(method_name(method), _LETTERS), fontsize=8.5)
        for ax, (fill, unit) in zip(axes[0], fills, strict=True):
            ax.set_title(fill_name(fill, unit).capitalize().replace(" (", "\n("), fontsize=8.5)
        axes[0, 0].set(ylim=(1.15 * min(bottom, 0.0), 1.15 * max(top, 1e-3)), xlim=(0, 100), xticks=[0, 50, 100])
        kinds: dict[str, Any] = {"most supporting first": "-", "least supporting first": "--", "random orders": ":"}
        handles = [Line2D([], [], color=BLACK, linestyle=line, label=label) for label, line in kinds.items()]
        figure.legend(handles=handles, loc="outside upper left", ncols=3)
        figure.supxlabel("Removed (% of the image)", fontsize=9)
        figure.supylabel("Evidence lost (margin units)", fontsize=9)
    return Plate(
        name=f"sound-curves-{faithful.input}",
        figure=figure,
        alt=f"Evidence lost against the area removed, {input_name(faithful.input).lower()}, for "
        f"{listed([method_name(one) for one in methods])}",
        caption=f"{input_name(faithful.input)}: how much of the answer's change from the untouched sensor is lost "
        "while parts go, most supporting first, "
        f"least supporting first, and in {faithful.random_orders} random orders; the band holds the middle half of "
        f"{faithful.frames} frames. The area between the first two is the symmetric gain. "
        f"{_tell_gains(faithful, methods)}",
        numbers=_removal_numbers(faithful),
    )


def _plot_removal(curve: RemovalCurve, method: str, *, ax: Axes) -> None:
    share, colour = 100 * curve.areas, METHOD_COLOURS.get(method, PURPLE)
    low, high = np.quantile(curve.most_first, [0.25, 0.75], axis=0)
    ax.fill_between(share, low, high, color=colour, alpha=0.15, linewidth=0)
    ax.plot(share, curve.most_first.mean(axis=0), color=colour, linewidth=1.6)
    ax.plot(
        share,
        curve.least_first.mean(axis=0),
        color=colour,
        linestyle="--",
        linewidth=1.3,
    )
    ax.plot(share, curve.random.mean(axis=0), color=BLACK, linestyle=":", linewidth=1.3)
    ax.tick_params(labelsize=7.5)


def plate_randomisation(results: Results) -> Plate | None:
    """Draw how alike maps stay as layers get new weights, a chart an input; None where that was not tested."""
    found = results.study.randomisation
    names = inputs_in_order(found)[::-1]
    if not names:
        return None
    rows, told = [], []
    with drawing_style():
        figure = Figure(figsize=(4.6 * len(names), 3.5), layout="constrained")
        for ax, name in zip(figure.subplots(1, len(names), squeeze=False, sharey=True)[0], names, strict=True):
            for method in methods_in_order(found[name].methods):
                one = found[name].methods[method]
                values = [np.nan if value is None else value for value in one.similarity]
                ax.plot(
                    one.layers,
                    values,
                    color=METHOD_COLOURS.get(method, PURPLE),
                    linestyle=METHOD_LINES.get(method, "-"),
                    marker="o",
                    markersize=3.5,
                    label=method_name(method),
                )
                rows += [(name, method, layer, value) for layer, value in zip(one.layers, one.similarity, strict=True)]
                if one.similarity and one.similarity[-1] is not None:
                    told.append(
                        f"{method_name(method)} {signed(one.similarity[-1], 2)} ({short_input_name(name).lower()})"
                    )
            ax.axhline(0, color=BLACK, linewidth=0.8, linestyle=":")
            ax.set(xlabel="Layers with new weights, from the output", ylabel="Similarity of the map (no unit)")
            ax.set_title(input_name(name))
        lines = {line.get_label(): line for ax in figure.axes for line in ax.get_lines() if line.get_marker() == "o"}
        figure.legend(handles=list(lines.values()), loc="outside upper left", ncols=3)
    columns = ("input", "method", "layers", "similarity")
    return Plate(
        name="randomisation",
        figure=figure,
        alt=f"Similarity of maps while layers get new weights; with all new: {', '.join(told)}",
        caption="Similarity of each method's map to that of the trained network while layers get new weights: a map "
        "that stays alike does not show what was learned. With the last layer tested new: "
        f"{', '.join(told) or 'not defined'}.",
        numbers={name: [row[place] for row in rows] for place, name in enumerate(columns)},
    )


def _tell_gains(faithful: Faithful, methods: list[str]) -> str:
    fill, unit = settings(faithful)[0]
    gains = {
        method: float(faithful.curves[fill, unit, method].srg.mean())
        for method in methods
        if (fill, unit, method) in faithful.curves
    }
    ranked = sorted(gains, key=lambda one: -gains[one])
    told = ", ".join(f"{method_name(one)} {signed(gains[one], 3)}" for one in ranked)
    return f"Under {fill_name(fill, unit)} it is {told}."


def _removal_numbers(faithful: Faithful) -> dict[str, list]:
    kinds = ("most_first", "least_first", "random")
    columns: dict[str, list] = {name: [] for name in ("fill", "unit", "method", "area", *kinds)}
    for (fill, unit, method), curve in faithful.curves.items():
        steps = len(curve.areas)
        means = [getattr(curve, kind).mean(axis=0).tolist() for kind in kinds]
        values = ([fill] * steps, [unit] * steps, [method] * steps, curve.areas.tolist(), *means)
        for column, more in zip(columns.values(), values, strict=True):
            column.extend(more)
    return columns
