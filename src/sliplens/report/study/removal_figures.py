"""Figures of deletion: what is removed at a few steps, and what the answer does."""

import numpy as np
from jaxtyping import UInt8

from sliplens.report.figures import MARGIN_LABEL
from sliplens.report.pages import place_axes
from sliplens.report.records import DeletionCurve, Explained, Scored
from sliplens.report.study.grids import CELL_IN, Cell, draw_grid, show_map
from sliplens.report.study.plates import Plate
from sliplens.report.study.shown import bright_pictures, explained_of, gone, told_frame
from sliplens.report.style import (
    BLUE,
    CONTROLS,
    GREY,
    VERMILLION,
    drawing_style,
    input_name,
    inputs_in_order,
    method_name,
    methods_in_order,
    percent,
    short_input_name,
)
from sliplens.report.workspace import Results

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
        found, remedies = _material(results, name), results.study.deletion.get(name)
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


def _illustrate(explained: Explained, scored: Scored, method: str, index: int) -> Plate:
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


def _material(results: Results, name: str) -> tuple[Explained, Scored, int] | None:
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
