"""Figures of deletion: what is removed at a few steps, and what the answer does."""

from textwrap import fill as wrap
from typing import Any

import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sliplens.plots.errors import MARGIN_LABEL
from sliplens.plots.layout import place_axes
from sliplens.plots.style import (
    BLACK,
    BLUE,
    CONTROLS,
    GREY,
    METHOD_COLOURS,
    METHOD_LINES,
    PURPLE,
    VERMILLION,
    drawing_style,
    fill_name,
    input_name,
    inputs_in_order,
    listed,
    method_name,
    methods_in_order,
    percent,
    short_input_name,
    signed,
)
from sliplens.report.believing import controls, settings
from sliplens.report.plates import (
    CELL_IN,
    Cell,
    Plate,
    bright_pictures,
    draw_grid,
    explained_of,
    gone,
    show_map,
    told_frame,
)
from sliplens.report.workspace import Results
from sliplens.results.explanation import Explained
from sliplens.results.faithfulness import DeletionCurve, DeletionScores, RemovalCurve, RemovalScores

SHARES = (0.01, 0.05, 0.1, 0.2, 0.5, 1.0)
"""Of the image, that are gone in the columns of a figure."""
_TOLD_METHOD = "poly-cam"
_TOLD = (0.05, 0.2, 1.0)
_HALF = "stop-at-half"
_LEVELS = {"grey": 128, "black": 0, "white": 255}
_FIGURES = {
    "grad-cam": "fig-19-removal-grad-cam",
    "integrated-gradients": "fig-20-removal-integrated-gradients",
    "poly-cam": "fig-21-removal-poly-cam",
    "poly-cam-thesis": "fig-21-removal-poly-cam-thesis",
}


def plate_deletion(results: Results) -> Plate | None:
    """Illustrate deletion on one frame, with the score below (thesis, Fig. 5); None without a scored map."""
    for name in inputs_in_order(results.study.inputs)[::-1]:
        found = _material(results, name)
        if found is None:
            continue
        explained, scored, index = found
        methods = [one for one in methods_in_order(scored.curves) if one in explained.saliency]
        if methods:
            method = _TOLD_METHOD if _TOLD_METHOD in methods else methods[-1]
            return _illustrate(explained, scored, method, index)
    return None


def plate_removal(results: Results, method: str) -> Plate | None:
    """Draw what one method has removed, with y and D at each step, a row an input (thesis, Figs. 19 to 21)."""
    rows, numbers, told = [], _columns(), []
    for name in inputs_in_order(results.study.inputs)[::-1]:
        found = _material(results, name)
        if found is None or method not in found[0].saliency or method not in found[1].curves:
            continue
        explained, scored, index = found
        steps = _steps(scored.curves[method], explained, index)
        rows.append((short_input_name(name), _removed(explained, method, index, steps, fill=scored.fill)))
        _note(numbers, explained, method, index, steps)
        told.append(f"{input_name(name)}: {_tell_fall(explained, index, steps)}")
    if not rows:
        return None
    heads = ["Saliency", *(f"{percent(share)} gone" for share in SHARES)]
    return Plate(
        name=_FIGURES.get(method, f"removal-{method}"),
        figure=draw_grid(rows, heads=heads, bar=True, cell_in=1.3).figure,
        alt=f"What {method_name(method)} calls most important is removed step by step. {'. '.join(told)}",
        caption=f"{method_name(method)}: what is gone, the answer y and the score D at each step of the thesis's "
        f"deletion ({_fills(results)} fill). {'. '.join(told)}.",
        numbers=numbers,
        pixels=True,
    )


def plate_highlighted(results: Results) -> Plate | None:
    """Draw the frame without all that has a saliency above 0.5, a row an input (thesis, Fig. 10)."""
    rows, numbers, told, methods = [], _columns(), [], _all_methods(results)
    for name in inputs_in_order(results.study.inputs)[::-1]:
        found, remedies = _material(results, name), results.study.remedies.get(name)
        variant = None if remedies is None else remedies.variants.get(_HALF)
        if found is None or remedies is None or variant is None:
            continue
        explained, _, index = found
        own = explained.frames[index]
        picture = explained.pictures[index]
        cells, own_told = [Cell(picture=picture, words=f"y {percent(own.prediction)}")], []
        for method in methods:
            curve = remedies.curves.get((_HALF, method), {}).get(own.id)
            if curve is None or method not in explained.saliency:
                cells.append(Cell(picture=None))
                continue
            step = (int(curve.pixels_removed[-1]), float(curve.predictions[0, -1]), float(curve.scores[0, -1]))
            mask = gone(explained.saliency[method][index], step[0])
            words = f"{percent(mask.mean())} gone, y {percent(step[1])}, D {step[2]:.2f}"
            cells.append(Cell(picture=_without(picture, mask, variant.fill), words=words))
            _note(numbers, explained, method, index, [step])
            own_told.append(f"{method_name(method)} {words}")
        told += [f"{input_name(name)}: whole y {percent(own.prediction)}; {'; '.join(own_told)}"] if own_told else []
        rows.append((short_input_name(name), cells))
    if not told:
        return None
    heads = ["Whole", *(method_name(method) for method in methods)]
    return Plate(
        name="fig-10-highlighted",
        figure=draw_grid(rows, heads=heads, cell_in=1.25 * CELL_IN).figure,
        alt=f"One frame without what each method highlights. {'. '.join(told)}",
        caption=f"All pixels with a saliency above 0.5 removed, the answer y and the score D then. {'. '.join(told)}.",
        numbers=numbers,
        pixels=True,
    )


def removal_methods(results: Results) -> list[str]:
    """Methods that the figures of removal can show."""
    return _all_methods(results)


def _illustrate(explained: Explained, scored: DeletionScores, method: str, index: int) -> Plate:
    curve, own = scored.curves[method], explained.frames[index]
    steps = _steps(curve, explained, index)
    cells = [
        Cell(picture=explained.pictures[index], words=f"y {percent(own.prediction)}"),
        *_removed(explained, method, index, steps, fill=scored.fill),
    ]
    heads = ["Input", "Saliency", *(f"{percent(share)} gone" for share in SHARES)]
    grid = draw_grid([(short_input_name(explained.input), cells)], heads=heads, below_in=2.2, cell_in=1.2)
    row = curve.frame_ids.index(own.id)
    share = 100 * curve.pixels_removed / explained.image_size**2
    with drawing_style():
        wide = grid.figure.get_size_inches()[0]
        ax = place_axes(grid.figure, 1.25, grid.bottom_in + 0.25, wide - 2.6, 1.45)
        ax.plot(share, curve.scores[row], color=BLUE, label="score D")
        ax.set(xlabel="Pixels removed (%)", ylabel="D (no unit)", xlim=(0, 100), ylim=(0, 1.03))
        answer = ax.twinx()
        answer.plot(share, 100 * curve.predictions[row], color=VERMILLION, linestyle="--", label="answer y")
        answer.axhline(100 * own.prediction, color=GREY, linewidth=0.8, linestyle=":")
        answer.set(ylabel=MARGIN_LABEL)
        answer.grid(visible=False)
        lines = [*ax.lines, answer.lines[0]]
        ax.legend(handles=lines, loc="lower right", bbox_to_anchor=(1, 0.98), ncols=2, borderaxespad=0)
    mean = float(curve.scores[row].mean())
    return Plate(
        name="fig-05-deletion",
        figure=grid.figure,
        alt=f"Deletion on frame {own.id}: {_tell_fall(explained, index, steps)}",
        caption=f"How the score of the thesis comes about: {method_name(method)} on frame {own.id} "
        f"({input_name(explained.input).lower()}, true Γ {percent(own.safety_margin)}). The most salient pixels become "
        f"{scored.fill} first; D = (1 \N{MINUS SIGN} |y \N{MINUS SIGN} y whole|)², mean over all steps {mean:.3f}. "
        f"Answers: {_tell_fall(explained, index, steps)}.",
        numbers={
            "pixels_removed": curve.pixels_removed,
            "share_removed": share / 100,
            "prediction": curve.predictions[row],
            "score": curve.scores[row],
        },
        pixels=True,
    )


def _material(results: Results, name: str) -> tuple[Explained, DeletionScores, int] | None:
    explained = explained_of(results, name)
    scored = results.scores.get((name, results.study.source))
    if explained is None or scored is None:
        return None
    index = told_frame(explained, {method: one for method, one in scored.curves.items() if method not in CONTROLS})
    return None if index is None else (explained, scored, index)


def _steps(curve: DeletionCurve, explained: Explained, index: int) -> list[tuple[int, float, float]]:
    """Pixels gone, answer and score at the steps nearest to `SHARES`."""
    row = curve.frame_ids.index(explained.frames[index].id)
    share = curve.pixels_removed / explained.image_size**2
    places = [int(np.abs(share - one).argmin()) for one in SHARES]
    return [
        (int(curve.pixels_removed[at]), float(curve.predictions[row, at]), float(curve.scores[row, at]))
        for at in places
    ]


def _removed(
    explained: Explained, method: str, index: int, steps: list[tuple[int, float, float]], *, fill: str
) -> list[Cell]:
    saliency = explained.saliency[method][index]
    # as the network saw it: made brighter, a difference would no longer compare with the fill
    picture, own = explained.pictures[index], explained.frames[index]
    first = Cell(
        picture=show_map(bright_pictures(explained, [index])[0][index], saliency),
        words=f"y {percent(own.prediction)}, D 1.00",
    )
    return [
        first,
        *(
            Cell(
                picture=_without(picture, gone(saliency, pixels), fill),
                words=f"y {percent(answer)}, D {score:.2f}",
            )
            for pixels, answer, score in steps
        ),
    ]


def _without(
    picture: UInt8[np.ndarray, "height width 3"], mask: np.ndarray, fill: str
) -> UInt8[np.ndarray, "height width 3"]:
    # a fill that is no even grey is drawn as one: what is gone is what the picture tells
    return np.where(mask[..., None], np.uint8(_LEVELS.get(fill, 128)), picture)


def _columns() -> dict[str, list]:
    return {
        name: [] for name in ("input", "method", "frame_id", "pixels_removed", "share_removed", "prediction", "score")
    }


def _note(
    numbers: dict[str, list], explained: Explained, method: str, index: int, steps: list[tuple[int, float, float]]
) -> None:
    own = explained.frames[index]
    for pixels, answer, score in [(0, own.prediction, 1.0), *steps]:
        values = (explained.input, method, own.id, pixels, pixels / explained.image_size**2, answer, score)
        for name, value in zip(numbers, values, strict=True):
            numbers[name].append(value)


def _tell_fall(explained: Explained, index: int, steps: list[tuple[int, float, float]]) -> str:
    parts = [
        f"{percent(share)} gone y {percent(one[1])}, D {one[2]:.2f}"
        for share, one in zip(SHARES, steps, strict=True)
        if share in _TOLD
    ]
    return "; ".join([f"whole y {percent(explained.frames[index].prediction)}", *parts])


def _fills(results: Results) -> str:
    return " or ".join(sorted({one.fill for one in results.scores.values()}))


def _all_methods(results: Results) -> list[str]:
    found = {method for one in results.explanations.values() for method in one.saliency}
    return methods_in_order(found - set(CONTROLS))


_LETTERS = 20
"""Of a line beside a chart."""


def plate_removal_curves(faithful: RemovalScores) -> Plate | None:
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


def _tell_gains(faithful: RemovalScores, methods: list[str]) -> str:
    fill, unit = settings(faithful)[0]
    gains = {
        method: float(faithful.curves[fill, unit, method].srg.mean())
        for method in methods
        if (fill, unit, method) in faithful.curves
    }
    ranked = sorted(gains, key=lambda one: -gains[one])
    told = ", ".join(f"{method_name(one)} {signed(gains[one], 3)}" for one in ranked)
    return f"Under {fill_name(fill, unit)} it is {told}."


def _removal_numbers(faithful: RemovalScores) -> dict[str, list]:
    kinds = ("most_first", "least_first", "random")
    columns: dict[str, list] = {name: [] for name in ("fill", "unit", "method", "area", *kinds)}
    for (fill, unit, method), curve in faithful.curves.items():
        steps = len(curve.areas)
        means = [getattr(curve, kind).mean(axis=0).tolist() for kind in kinds]
        values = ([fill] * steps, [unit] * steps, [method] * steps, curve.areas.tolist(), *means)
        for column, more in zip(columns.values(), values, strict=True):
            column.extend(more)
    return columns
