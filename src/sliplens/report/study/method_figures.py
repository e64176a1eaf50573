"""Figures of saliency: methods beside each other, and one method from full stick to full slip."""

import numpy as np

from sliplens.report.records import Explained
from sliplens.report.study.grids import Cell, draw_grid, show_map
from sliplens.report.study.plates import Plate
from sliplens.report.study.shown import THESIS_LEVEL, ShownFrame, bright_pictures, explained_of, shown_frames
from sliplens.report.style import (
    CONTROLS,
    input_name,
    inputs_in_order,
    listed,
    method_name,
    methods_in_order,
    percent,
    short_input_name,
    signed,
)
from sliplens.report.workspace import Results

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
