"""Figures of the thesis that are charts: errors by margin, and its faithfulness curves."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sliplens.plots.errors import plot_bins, plot_faithfulness
from sliplens.plots.style import (
    BLACK,
    CONTROLS,
    METHOD_COLOURS,
    PURPLE,
    conditions_in_order,
    drawing_style,
    input_name,
    inputs_in_order,
    listed,
    method_name,
    methods_in_order,
    percent,
    short_input_name,
    signed,
)
from sliplens.report.plates import (
    THESIS_LEVEL,
    Cell,
    Plate,
    ShownFrame,
    bright_pictures,
    draw_grid,
    explained_of,
    show_map,
    shown_frames,
)
from sliplens.report.workspace import Results
from sliplens.results.explanation import Explained
from sliplens.results.faithfulness import DeletionCurve, DeletionScores

_STATE_FIGURES = {"difference": "fig-15-methods-difference", "raw": "fig-16-methods-raw"}


def plate_methods(results: Results) -> Plate | None:
    """Draw the methods beside each other at one margin, a row an input (thesis, Fig. 8); None without maps."""
    rows, numbers, told = [], _Saliencies(), []
    for name in inputs_in_order(results.study.inputs)[::-1]:
        explained = explained_of(results, name)
        frames = [] if explained is None else shown_frames(results, explained)
        if explained is None or not frames:
            continue
        frame = min(frames, key=lambda one: abs(one.level - THESIS_LEVEL))
        own = explained.frames[frame.index]
        pictures, called = bright_pictures(explained, [frame.index])
        cells = [Cell(picture=pictures[frame.index], words=_answer(explained, frame.index))]
        for method in _methods(results):
            saliency = explained.saliency.get(method)
            if saliency is None:
                cells.append(Cell(picture=None))
                continue
            cells.append(Cell(picture=show_map(pictures[frame.index], saliency[frame.index])))
            numbers.add(explained, method, frame)
        rows.append((f"{short_input_name(name)}\n({called.lower()})", cells))
        answer = f"true Γ {percent(own.safety_margin)}, read {percent(own.prediction)}"
        told.append(f"{short_input_name(name).lower()} {own.id}, {answer}")
    if not rows:
        return None
    heads = ["Input", *(method_name(method) for method in _methods(results))]
    return Plate(
        name="fig-08-methods",
        figure=draw_grid(rows, heads=heads, bar=True).figure,
        alt=f"Saliency maps of {listed(heads[1:])} side by side; {'; '.join(told)}",
        caption=f"Methods beside each other on one frame near Γ {percent(THESIS_LEVEL)} ({'; '.join(told)}). Colours "
        f"are relative to each map's own saliency. {numbers.tell_spread()}",
        numbers=numbers.columns(),
        pixels=True,
    )


def plate_states(results: Results, name: str) -> Plate | None:
    """Draw every method across the states of one trial (thesis, Figs. 15 and 16); None without maps."""
    explained = explained_of(results, name)
    frames = [] if explained is None else shown_frames(results, explained)
    if explained is None or not frames:
        return None
    methods = [method for method in _methods(results) if method in explained.saliency]
    return _plate(
        explained,
        frames,
        methods,
        name=_STATE_FIGURES.get(name, f"methods-{name}"),
        what=f"Methods across the contact states, {input_name(name).lower()}",
    )


def plate_poly_cam(results: Results) -> Plate | None:
    """Draw Poly-CAM across the states on difference images (thesis, Fig. 11); None without its maps."""
    explained = explained_of(results, "difference")
    if explained is None or "poly-cam" not in explained.saliency or not (frames := shown_frames(results, explained)):
        return None
    return _plate(
        explained,
        frames,
        ["poly-cam"],
        name="fig-11-poly-cam-difference",
        what="Poly-CAM across the contact states, difference images",
    )


def _plate(explained: Explained, frames: list[ShownFrame], methods: list[str], *, name: str, what: str) -> Plate:
    numbers = _Saliencies()
    pictures, called = bright_pictures(explained, [one.index for one in frames])
    rows = [(called, [Cell(picture=pictures[one.index], words=_answer(explained, one.index)) for one in frames])]
    for method in methods:
        maps = explained.saliency[method]
        cells = [Cell(picture=show_map(pictures[one.index], maps[one.index])) for one in frames]
        rows.append((method_name(method), cells))
        for one in frames:
            numbers.add(explained, method, one)
    answers = [explained.frames[one.index] for one in frames]
    errors = [abs(one.prediction - one.safety_margin) for one in answers if one.safety_margin is not None]
    off = f" The network is off by at most {100 * max(errors):.1f} percentage points on these frames." if errors else ""
    return Plate(
        name=name,
        figure=draw_grid(rows, heads=[f"Γ {percent(one.level)}" for one in frames], bar=True).figure,
        alt=f"{what}: {listed([method_name(one) for one in methods])} at Γ "
        f"{', '.join(percent(one.level) for one in frames)}",
        caption=f"{what}: one trial from full stick to full slip.{off} Colours are relative to each map's own "
        f"saliency, so brightness does not compare between maps. {numbers.tell_travel(methods)}",
        numbers=numbers.columns(),
        pixels=True,
    )


class _Saliencies:
    """Numbers of each map drawn: where its weight lies, and on how much of the image."""

    def __init__(self) -> None:
        self._rows: list[tuple[str, str, str, float, float, float, float, float, float]] = []

    def add(self, explained: Explained, method: str, frame: ShownFrame) -> None:
        own = explained.frames[frame.index]
        saliency = explained.saliency[method][frame.index].astype(np.float64)
        high, wide = saliency.shape
        total = saliency.sum()
        y, x = np.mgrid[:high, :wide]
        right, down = (float((saliency * axis).sum() / total) if total > 0 else float("nan") for axis in (x, y))
        label = float("nan") if own.safety_margin is None else own.safety_margin
        above = float((saliency > 0.5).mean())
        row = (explained.input, method, own.id, frame.level, label, own.prediction, above, right, down)
        self._rows.append(row)

    def columns(self) -> dict[str, list]:
        names = (
            "input", "method", "frame_id", "level", "safety_margin", "prediction", "share_above_half", "centre_x_px",
            "centre_y_px",
        )  # fmt: skip
        return {name: [row[place] for row in self._rows] for place, name in enumerate(names)}

    def tell_spread(self) -> str:
        parts = [f"{method_name(row[1])} {percent(row[6])} ({short_input_name(row[0]).lower()})" for row in self._rows]
        return f"Share of the image with a saliency above 0.5: {', '.join(parts)}."

    def tell_travel(self, methods: list[str]) -> str:
        parts = []
        for method in methods:
            rows = [row for row in self._rows if row[1] == method and np.isfinite(row[8])]
            if len(rows) > 1:
                parts.append(f"{method_name(method)} {signed(rows[-1][8] - rows[0][8], 0)}")
        told = ", ".join(parts)
        return (
            f"From the first to the last frame the centre of the saliency moves down by, in pixels: {told}."
            if told
            else ""
        )


def _answer(explained: Explained, index: int) -> str:
    frame = explained.frames[index]
    return f"true {percent(frame.safety_margin)}, read {percent(frame.prediction)}"


def _methods(results: Results) -> list[str]:
    found = {method for one in results.explanations.values() for method in one.saliency}
    return methods_in_order(found - set(CONTROLS))


_EACH_FIGURES = {"difference": "fig-17-faithfulness-difference", "raw": "fig-18-faithfulness-raw"}
_FEW = 4
"""Charts in a row."""


def plate_bins(results: Results) -> Plate | None:
    """Draw the MSE by bins of the margin, a chart a condition (thesis, Fig. 7); None without an evaluation."""
    evaluations = results.evaluations
    conditions = conditions_in_order(name for one in evaluations.values() for name in one.conditions)
    if not conditions:
        return None
    names = inputs_in_order(evaluations)
    rows = [
        (condition, name, row.low, row.high, row.frames, row.mse)
        for condition in conditions
        for name in names
        if condition in evaluations[name].conditions
        for row in evaluations[name].conditions[condition].bins
    ]
    top = 1.15 * max((row[5] for row in rows if row[5] is not None), default=1.0)
    with drawing_style():
        figure = Figure(figsize=(4.4 * len(conditions), 3.2), layout="constrained")
        for ax, condition in zip(figure.subplots(1, len(conditions), squeeze=False)[0], conditions, strict=True):
            bins = {
                name: evaluations[name].conditions[condition].bins
                for name in names
                if condition in evaluations[name].conditions
            }
            plot_bins(bins, ax=ax).set(ylim=(0, top))
            ax.set_title(f"{condition.capitalize()} objects", parse_math=False)
    told = []
    for condition in conditions:
        known = [row for row in rows if row[0] == condition and row[5] is not None]
        if known:
            worst = max(known, key=lambda row: row[5] or 0.0)
            place = f"{percent(worst[2])} to {percent(worst[3])}, {input_name(worst[1]).lower()}"
            told.append(f"{condition}: {place}, MSE {worst[5]:.4f}")
    columns = ("condition", "input", "low", "high", "frames", "mse")
    return Plate(
        name="fig-07-mse-by-bin",
        figure=figure,
        alt=f"Bars of the mean squared error in bins of Γ; largest, {'; '.join(told)}",
        caption=f"Mean squared error by bins of the true safety margin. Largest error, {'; '.join(told)}. A bin "
        "without bars holds no test frame.",
        numbers={name: [row[place] for row in rows] for place, name in enumerate(columns)},
    )


def plate_faithfulness(results: Results) -> Plate | None:
    """Draw the mean deletion score while pixels go, a chart an input (thesis, Fig. 9); None without scores."""
    scored = _scored(results)
    if not scored:
        return None
    with drawing_style():
        figure = Figure(figsize=(4.6 * len(scored), 3.5), layout="constrained")
        for ax, (name, one) in zip(figure.subplots(1, len(scored), squeeze=False)[0], scored.items(), strict=True):
            plot_faithfulness(one.curves, pixels=_pixels(one), ax=ax).set_title(input_name(name))
    told = [f"{input_name(name).lower()}: {_tell_order(one)}" for name, one in scored.items()]
    return Plate(
        name="fig-09-faithfulness",
        figure=figure,
        alt=f"Deletion score D against pixels removed. Mean over all steps, {'; '.join(told)}",
        caption="Deletion score D of the thesis while pixels go, most salient first; the line is the mean over frames, "
        f"the band holds the middle half of them. Mean over all steps, lowest first, {'; '.join(told)}.",
        numbers=_thesis_numbers(scored),
    )


def plate_each_frame(results: Results, name: str) -> Plate | None:
    """Draw the thesis's curve of every frame, a chart a method (thesis, Figs. 17 and 18); None without scores."""
    scored = _scored(results).get(name)
    if scored is None:
        return None
    methods = methods_in_order(scored.curves)
    figure, charts = _charts(len(methods), each=(2.9, 2.5))
    told = []
    with drawing_style():
        for ax, method in zip(charts, methods, strict=True):
            curve, colour = scored.curves[method], METHOD_COLOURS.get(method, PURPLE)
            share = 100 * curve.pixels_removed / _pixels(scored)
            # dozens of curves as vectors would swell the page
            ax.plot(share, curve.scores.T, color=colour, alpha=0.3, linewidth=0.7, rasterized=True)
            ax.plot(share, curve.scores.mean(axis=0), color=BLACK, linewidth=2)
            ax.set(xlim=(0, 100), ylim=(0, 1.03), xlabel="Pixels removed (%)", ylabel="D (no unit)")
            ax.set_title(method_name(method), fontsize=9.5)
            means = curve.scores.mean(axis=1)
            told.append(f"{method_name(method)} {means.mean():.3f} (standard deviation {means.std():.3f})")
    frames = max(len(curve.frame_ids) for curve in scored.curves.values())
    return Plate(
        name=_EACH_FIGURES.get(name, f"faithfulness-{name}"),
        figure=figure,
        alt=f"Deletion score D of every frame, {input_name(name).lower()}: {'; '.join(told)}",
        caption=f"Deletion score D of each of {frames} frames ({input_name(name).lower()}), in black their mean. "
        f"Score: {'; '.join(told)}.",
        numbers=_thesis_numbers({name: scored}),
    )


def _charts(count: int, *, each: tuple[float, float]) -> tuple[Figure, list[Axes]]:
    columns = min(count, _FEW)
    rows = -(-count // columns)
    with drawing_style():
        figure = Figure(figsize=(each[0] * columns, each[1] * rows), layout="constrained")
        axes = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for ax in axes[count:]:
        ax.set_axis_off()
    return figure, axes[:count]


def _scored(results: Results) -> dict[str, DeletionScores]:
    found = {name: one for (name, source), one in results.scores.items() if source == results.study.source}
    return {name: found[name] for name in inputs_in_order(found)[::-1]}


def _pixels(scored: DeletionScores) -> int:
    return max(int(curve.pixels_removed.max()) for curve in scored.curves.values())


def _tell_order(scored: DeletionScores) -> str:
    means = {method: float(curve.scores.mean()) for method, curve in scored.curves.items()}
    return ", ".join(f"{method_name(one)} {means[one]:.3f}" for one in sorted(means, key=lambda one: means[one]))


def _thesis_numbers(scored: dict[str, DeletionScores]) -> dict[str, list]:
    columns: dict[str, list] = {
        name: []
        for name in (
            "input",
            "method",
            "pixels_removed",
            "share_removed",
            "mean",
            "quartile_low",
            "quartile_high",
            "sd",
        )
    }
    for name, one in scored.items():
        for method in methods_in_order(one.curves):
            curve: DeletionCurve = one.curves[method]
            steps = len(curve.pixels_removed)
            low, high = np.quantile(curve.scores, [0.25, 0.75], axis=0)
            spread = curve.scores.std(axis=0)
            values = ([name] * steps, [method] * steps, curve.pixels_removed.tolist())
            values += ((curve.pixels_removed / _pixels(one)).tolist(), curve.scores.mean(axis=0).tolist())
            values += (low.tolist(), high.tolist(), spread.tolist())
            for column, more in zip(columns.values(), values, strict=True):
                column.extend(more)
    return columns
