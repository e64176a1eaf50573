"""Plates made of pictures: maps beside each other, and what deletion removes."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from PIL import Image

from sliplens.errors import InputError
from sliplens.markers import DisplacementField, interpolate_field
from sliplens.plots.contact_sheet import TIMES, brighten, brightening
from sliplens.plots.errors import MARGIN_LABEL
from sliplens.plots.margins import draw_strip
from sliplens.plots.markers import (
    ARROWS,
    STILL_PX,
    SURE,
    MarkedFrame,
    draw_fields_beside_saliency,
    plot_arrows,
    plot_field,
)
from sliplens.plots.saliency import FULL_COLOUR_PERCENTILE, full_colour, overlay_relevance
from sliplens.plots.style import (
    BLUE,
    GREY,
    VERMILLION,
    drawing_style,
    input_name,
    inputs_in_order,
    listed,
    method_name,
    methods_in_order,
    percent,
    place_axes,
    reading_words,
    short_input_name,
    signed,
    source_name,
)
from sliplens.report.claims import POLY_CAM
from sliplens.report.comparisons import tell_interval
from sliplens.report.plates import (
    CELL_IN,
    THESIS_LEVEL,
    Cell,
    Plate,
    ShownFrame,
    bright_pictures,
    draw_grid,
    explained_of,
    gone,
    named_columns,
    show_map,
    shown_frames,
    told_frame,
)
from sliplens.report.results import Results
from sliplens.results.explanation import ExplainedFrame, Explanation, Strip
from sliplens.results.faithfulness import DeletionCurve, DeletionScores, is_control
from sliplens.results.study import StateFrame, States, Truth

SHARES = (0.01, 0.05, 0.1, 0.2, 0.5, 1.0)
"""Of the image, that are gone in the columns of a figure."""
_TOLD = (0.05, 0.2, 1.0)
_HALF = "stop-at-half"
_STEP_COLUMNS = ("input", "method", "frame_id", "pixels_removed", "share_removed", "prediction", "score")
_LEVELS = {"grey": 128, "black": 0, "white": 255}
_FIGURES = {
    "grad-cam": "fig-19-removal-grad-cam",
    "integrated-gradients": "fig-20-removal-integrated-gradients",
    "poly-cam": "fig-21-removal-poly-cam",
    "poly-cam-thesis": "fig-21-removal-poly-cam-thesis",
}
_SALIENCY_COLUMNS = (
    "input", "method", "frame_id", "level", "safety_margin", "prediction", "share_above_half", "centre_x_px",
    "centre_y_px",
)  # fmt: skip
_TRUTH_FRAMES = _TRUTH_METHODS = 3
_EFFECT_COLUMNS = {name: name for name in ("frame_id", "marker", "x_px", "y_px")}
_EFFECT_COLUMNS |= {"shapley_value": "shapley", "shapley_error": "shapley_error", "network_effect": "network"}
_EFFECT_COLUMNS |= {"margin_effect": "margin", "state": "state"}
_STATE_FIGURES = {"difference": "fig-15-methods-difference", "raw": "fig-16-methods-raw"}


def plate_methods(results: Results) -> Plate | None:
    """Draw the methods beside each other at one margin, a row an input (thesis, Fig. 8); None without maps."""
    rows, numbers, text, methods = [], [], [], shown_methods(results)
    for name in inputs_in_order(results.inputs)[::-1]:
        explained = explained_of(results, name)
        frames = [] if explained is None else shown_frames(results, explained)
        if explained is None or not frames:
            continue
        frame = min(frames, key=lambda one: abs(one.level - THESIS_LEVEL) if one.level is not None else 1.0)
        shown_frame = explained.frames[frame.index]
        pictures, called = bright_pictures(explained, [frame.index])
        picture = pictures[frame.index]
        cells = [Cell(picture=picture, words=_answer(shown_frame))]
        for method in methods:
            saliency = explained.saliency.get(method)
            cells.append(Cell(picture=saliency if saliency is None else show_map(picture, saliency[frame.index])))
            numbers += [] if saliency is None else [_measured(explained, method, frame)]
        rows.append((f"{short_input_name(name)}\n({called.lower()})", cells))
        answer = _answer(shown_frame).replace("true", "true Γ")
        text.append(f"{short_input_name(name).lower()} {shown_frame.id}, {answer}")
    if not rows:
        return None
    heads = ["Input", *(method_name(method) for method in methods)]
    spread = [f"{method_name(row[1])} {percent(row[6])} ({short_input_name(row[0]).lower()})" for row in numbers]
    return Plate(
        name="fig-08-methods",
        figure=draw_grid(rows, heads=heads, bar=True).figure,
        alt=f"Saliency maps of {listed(heads[1:])} side by side; {'; '.join(text)}",
        caption=f"Methods beside each other on one frame near Γ {percent(THESIS_LEVEL)} ({'; '.join(text)}). Colours "
        f"are relative to each map's own saliency. Share of the image with a saliency above 0.5: {', '.join(spread)}.",
        numbers=named_columns(_SALIENCY_COLUMNS, numbers),
        pixels=True,
    )


def plate_states(results: Results, explained: Explanation) -> Plate | None:
    """Draw every method across the states of one trial (thesis, Figs. 15 and 16); None without frames to show."""
    methods = [method for method in shown_methods(results) if method in explained.saliency]
    real = explained.source == "real"
    name = f"real-{explained.input}" if real else _STATE_FIGURES.get(explained.input, f"methods-{explained.input}")
    of = f"{input_name(explained.input).lower()}, {source_name(explained.source)}"
    what = f"Methods across the contact states, {of}"
    return _plate(explained, shown_frames(results, explained), methods, name=name, what=what)


def plate_strip(strip: Strip) -> Plate:
    """Draw one trial from stick to slip, its true and read margin, and the maps of a few frames."""
    readings = strip.readings
    ends = (strip.shown[place] for place in (0, -1))
    first, last = ("nothing" if readings.withheld[at] else percent(float(readings.prediction[at])) for at in ends)
    return Plate(
        name="strip",
        figure=draw_strip(strip),
        alt=f"Camera frames of a {strip.condition} grip from stick to slip under the maps of a network, and below them "
        f"the true and the read safety margin over time; the network reads {first} at first and {last} at last.",
        caption=f"One grip of {source_name(strip.source)} from stick to slip: the first {strip.condition} trial that "
        f"tests, chosen by its place alone. Above: the camera's frames under the map of {method_name(strip.method)}, "
        "one scale for all. Below: the margin that was true, the one that was read, and the interval that should hold "
        "90 % of the labels.",
        numbers=vars(readings),
        pixels=True,
    )


def _poly_cam(explained: Explanation | None) -> str | None:
    """Poly-CAM of ours where it was run, else as the thesis ran it; None without a map of either."""
    maps = () if explained is None else explained.saliency
    return next((method for method in ("poly-cam", POLY_CAM) if method in maps), None)


def plate_poly_cam(results: Results) -> Plate | None:
    """Draw Poly-CAM across the states on difference images (thesis, Fig. 11); None without its maps."""
    explained = explained_of(results, "difference")
    method = _poly_cam(explained)
    if explained is None or method is None:
        return None
    name, what = "fig-11-poly-cam-difference", "Poly-CAM across the contact states, difference images"
    return _plate(explained, shown_frames(results, explained), [method], name=name, what=what)


def _plate(
    explained: Explanation, frames: list[ShownFrame], methods: list[str], *, name: str, what: str
) -> Plate | None:
    if not frames:
        return None
    trials = {explained.frames[frame.index].trial for frame in frames}
    pictures, called = bright_pictures(explained, [frame.index for frame in frames])
    rows = [
        (
            called,
            [Cell(picture=pictures[frame.index], words=_answer(explained.frames[frame.index])) for frame in frames],
        )
    ]
    for method in methods:
        maps = explained.saliency[method]
        cells = [Cell(picture=show_map(pictures[frame.index], maps[frame.index])) for frame in frames]
        rows.append((method_name(method), cells))
    numbers = {method: [_measured(explained, method, frame) for frame in frames] for method in methods}
    moves = ""
    for method, measured in numbers.items():
        valid = [row[8] for row in measured if np.isfinite(row[8])]
        moves += f", {method_name(method)} {signed(valid[-1] - valid[0], 0)}" if len(valid) > 1 else ""
    if moves:
        moves = f"From the first to the last frame the centre of the saliency moves down by, in pixels: {moves[2:]}."
    answers = [explained.frames[frame.index] for frame in frames]
    errors = [abs(answer.prediction - answer.safety_margin) for answer in answers if answer.safety_margin is not None]
    off = f" The network is off by at most {100 * max(errors):.1f} percentage points on these frames." if errors else ""
    return Plate(
        name=name,
        figure=draw_grid(rows, heads=[f"Γ {percent(frame.level)}" for frame in frames], bar=True).figure,
        alt=f"{what}: {listed([method_name(method) for method in methods])} at Γ "
        f"{', '.join(percent(frame.level) for frame in frames)}",
        caption=f"{what}: {'one trial' if len(trials) == 1 else 'frames'} from full stick to full slip.{off} "
        "Colours are relative to each map's own saliency, so brightness does not compare between maps. "
        f"{moves}{_tell_blank(explained, frames, methods)}",
        numbers=named_columns(_SALIENCY_COLUMNS, [row for measured in numbers.values() for row in measured]),
        pixels=True,
    )


def _tell_blank(explained: Explanation, frames: list[ShownFrame], methods: list[str]) -> str:
    blank = sum(not explained.saliency[method][frame.index].any() for method in methods for frame in frames)
    if not blank:
        return ""
    maps = "1 map has" if blank == 1 else f"{blank} maps have"
    return f" {maps} no colour: there the method finds nothing that speaks for the answer."


def _measured(explained: Explanation, method: str, frame: ShownFrame) -> tuple[Any, ...]:
    """Numbers of a map drawn: where its weight lies, and on how much of the image."""
    shown_frame = explained.frames[frame.index]
    saliency = explained.saliency[method][frame.index].astype(np.float64)
    total, (y, x) = saliency.sum(), np.indices(saliency.shape)
    right, down = (float((saliency * axis).sum() / total) if total > 0 else float("nan") for axis in (x, y))
    label = float("nan") if shown_frame.safety_margin is None else shown_frame.safety_margin
    above = float((saliency > 0.5).mean())
    return explained.input, method, shown_frame.id, frame.level, label, shown_frame.prediction, above, right, down


def _answer(frame: ExplainedFrame) -> str:
    return f"true {percent(frame.safety_margin)}, {reading_words(frame.prediction, frame.withheld)}"


def shown_methods(results: Results) -> list[str]:
    """Methods that have maps, the controls left out."""
    records = {method for explanation in results.explanations.values() for method in explanation.saliency}
    return methods_in_order(name for name in records if not is_control(name))


def plate_deletion(results: Results) -> Plate | None:
    """Illustrate deletion on one frame, with the score below (thesis, Fig. 5); None without a scored map."""
    for explained, scored, index in _materials(results):
        methods = [method for method in methods_in_order(scored.curves) if method in explained.saliency]
        if methods:
            return _illustrate(explained, scored, "poly-cam" if "poly-cam" in methods else methods[-1], index)
    return None


def plate_removal(results: Results, method: str) -> Plate | None:
    """Draw what one method has removed, with y and D at each step, a row an input (thesis, Figs. 19 to 21)."""
    rows, numbers, text = [], [], []
    for explained, scored, index in _materials(results):
        if method not in explained.saliency or method not in scored.curves:
            continue
        steps = _steps(scored.curves[method], explained, index)
        rows.append((short_input_name(explained.input), _removed(explained, method, index, steps, fill=scored.fill)))
        numbers += _steps_told(explained, method, index, steps)
        text.append(f"{input_name(explained.input)}: {_tell_fall(explained, index, steps)}")
    if not rows:
        return None
    fill = " or ".join(sorted({score.fill for score in results.scores.values()}))
    heads = ["Saliency", *(f"{percent(share)} gone" for share in SHARES)]
    return Plate(
        name=_FIGURES.get(method, f"removal-{method}"),
        figure=draw_grid(rows, heads=heads, bar=True, cell_in=1.3).figure,
        alt=f"What {method_name(method)} calls most important is removed step by step. {'. '.join(text)}",
        caption=f"{method_name(method)}: what is gone, the answer y and the score D at each step of the thesis's "
        f"deletion ({fill} fill). {'. '.join(text)}.",
        numbers=named_columns(_STEP_COLUMNS, numbers),
        pixels=True,
    )


def plate_highlighted(results: Results) -> Plate | None:
    """Draw the frame without all that has a saliency above 0.5, a row an input (thesis, Fig. 10)."""
    rows, numbers, text, methods = [], [], [], shown_methods(results)
    for explained, _, index in _materials(results):
        name, frames, picture = explained.input, explained.frames[index], explained.pictures[index]
        remedies = results.study.remedies.get(name)
        variant = None if remedies is None else remedies.variants.get(_HALF)
        if remedies is None or variant is None:
            continue
        cells, own_told = [Cell(picture=picture, words=f"y {percent(frames.prediction)}")], []
        for method in methods:
            curve = remedies.curves.get((_HALF, method), {}).get(frames.id)
            if curve is None or method not in explained.saliency:
                cells.append(Cell(picture=None))
                continue
            step = (int(curve.pixels_removed[-1]), float(curve.predictions[0, -1]), float(curve.scores[0, -1]))
            mask = gone(explained.saliency[method][index], step[0])
            words = f"{percent(mask.mean())} gone, y {percent(step[1])}, D {step[2]:.2f}"
            cells.append(Cell(picture=_without(picture, mask, variant.fill), words=words))
            numbers += _steps_told(explained, method, index, [step])
            own_told.append(f"{method_name(method)} {words}")
        text += [f"{input_name(name)}: whole y {percent(frames.prediction)}; {'; '.join(own_told)}"] if own_told else []
        rows.append((short_input_name(name), cells))
    if not text:
        return None
    heads = ["Whole", *(method_name(method) for method in methods)]
    return Plate(
        name="fig-10-highlighted",
        figure=draw_grid(rows, heads=heads, cell_in=1.25 * CELL_IN).figure,
        alt=f"One frame without what each method highlights. {'. '.join(text)}",
        caption=f"All pixels with a saliency above 0.5 removed, the answer y and the score D then. {'. '.join(text)}.",
        numbers=named_columns(_STEP_COLUMNS, numbers),
        pixels=True,
    )


def _illustrate(explained: Explanation, scored: DeletionScores, method: str, index: int) -> Plate:
    curve, frame = scored.curves[method], explained.frames[index]
    steps = _steps(curve, explained, index)
    cells = [
        Cell(picture=explained.pictures[index], words=f"y {percent(frame.prediction)}"),
        *_removed(explained, method, index, steps, fill=scored.fill),
    ]
    heads = ["Input", "Saliency", *(f"{percent(share)} gone" for share in SHARES)]
    grid = draw_grid([(short_input_name(explained.input), cells)], heads=heads, below_in=2.2, cell_in=1.2)
    row = curve.frame_ids.index(frame.id)
    share = 100 * curve.pixels_removed / explained.image_size**2
    with drawing_style():
        wide = grid.figure.get_size_inches()[0]
        ax = place_axes(grid.figure, 1.25, grid.bottom_in + 0.25, wide - 2.6, 1.45)
        ax.plot(share, curve.scores[row], color=BLUE, label="score D")
        ax.set(xlabel="Pixels removed (%)", ylabel="D (no unit)", xlim=(0, 100), ylim=(0, 1.03))
        answer = ax.twinx()
        answer.plot(share, 100 * curve.predictions[row], color=VERMILLION, linestyle="--", label="answer y")
        answer.axhline(100 * frame.prediction, color=GREY, linewidth=0.8, linestyle=":")
        answer.set(ylabel=MARGIN_LABEL)
        answer.grid(visible=False)
        lines = [*ax.lines, answer.lines[0]]
        ax.legend(handles=lines, loc="lower right", bbox_to_anchor=(1, 0.98), ncols=2, borderaxespad=0)
    mean, columns = curve.scores[row].mean(), {"prediction": curve.predictions[row], "score": curve.scores[row]}
    return Plate(
        name="fig-05-deletion",
        figure=grid.figure,
        alt=f"Deletion on frame {frame.id}: {_tell_fall(explained, index, steps)}",
        caption=f"How the score of the thesis comes about: {method_name(method)} on frame {frame.id} "
        f"({input_name(explained.input).lower()}, true Γ {percent(frame.safety_margin)}). The most salient pixels "
        f"become {scored.fill} first; D = (1 \N{MINUS SIGN} |y \N{MINUS SIGN} y whole|)², mean over all steps "
        f"{mean:.3f}. Answers: {_tell_fall(explained, index, steps)}.",
        numbers={"pixels_removed": curve.pixels_removed, "share_removed": share / 100, **columns},
        pixels=True,
    )


def _materials(results: Results) -> Iterator[tuple[Explanation, DeletionScores, int]]:
    """Maps, scores and the frame to show of each input that has all three, raw images last."""
    for name in inputs_in_order(results.inputs)[::-1]:
        explained, scored = explained_of(results, name), results.scores.get((name, results.study.source))
        if explained is None or scored is None:
            continue
        index = told_frame(
            explained, {method: curve for method, curve in scored.curves.items() if not is_control(method)}
        )
        if index is not None:
            yield explained, scored, index


def _steps(curve: DeletionCurve, explained: Explanation, index: int) -> list[tuple[int, float, float]]:
    """Pixels gone, answer and score at the steps nearest to `SHARES`."""
    row = curve.frame_ids.index(explained.frames[index].id)
    share = curve.pixels_removed / explained.image_size**2
    return [
        (int(curve.pixels_removed[at]), float(curve.predictions[row, at]), float(curve.scores[row, at]))
        for at in (np.abs(share - record).argmin() for record in SHARES)
    ]


def _removed(
    explained: Explanation, method: str, index: int, steps: list[tuple[int, float, float]], *, fill: str
) -> list[Cell]:
    saliency, rows = explained.saliency[method][index], explained.frames[index]
    # as the network saw it: made brighter, a difference would no longer compare with the fill
    picture = explained.pictures[index]
    chosen = [show_map(bright_pictures(explained, [index])[0][index], saliency)]
    chosen += [_without(picture, gone(saliency, pixels), fill) for pixels, _, _ in steps]
    answers = [(rows.prediction, 1.0), *((answer, score) for _, answer, score in steps)]
    return [
        Cell(picture=record, words=f"y {percent(answer)}, D {score:.2f}")
        for record, (answer, score) in zip(chosen, answers, strict=True)
    ]


def _without(
    picture: UInt8[np.ndarray, "height width 3"], mask: np.ndarray, fill: str
) -> UInt8[np.ndarray, "height width 3"]:
    # a fill that is no even grey is drawn as one: what is gone is what the picture tells
    return np.where(mask[..., None], np.uint8(_LEVELS.get(fill, 128)), picture)


def _steps_told(
    explained: Explanation, method: str, index: int, steps: list[tuple[int, float, float]]
) -> list[tuple[Any, ...]]:
    shown_frame = explained.frames[index]
    return [
        (explained.input, method, shown_frame.id, pixels, pixels / explained.image_size**2, answer, score)
        for pixels, answer, score in [(0, shown_frame.prediction, 1.0), *steps]
    ]


def _tell_fall(explained: Explanation, index: int, steps: list[tuple[int, float, float]]) -> str:
    parts = [
        f"{percent(share)} gone y {percent(step[1])}, D {step[2]:.2f}"
        for share, step in zip(SHARES, steps, strict=True)
        if share in _TOLD
    ]
    return "; ".join([f"whole y {percent(explained.frames[index].prediction)}", *parts])


def plate_contact_states(states: States) -> Plate | None:
    """Draw frame with arrows, field, and difference image, a column a contact state (thesis, Fig. 4).

    None where no frame has markers enough for a field.
    """
    chosen = _one_a_state(states)
    fields = {frame.id: _field(frame) for frame in chosen}
    lengths = [_longest(field) for field in fields.values() if field is not None]
    if not lengths:
        return None
    factor = brightening([frame.difference[None] for frame in chosen])
    size = chosen[0].raw.shape[:2]
    rows = [
        (f"Camera, arrows\n{TIMES}\N{NO-BREAK SPACE}{ARROWS:g}", [Cell(picture=frame.raw) for frame in chosen]),
        ("Field of the\nmarkers", [Cell(picture=None if fields[frame.id] is None else frame.raw) for frame in chosen]),
        (
            "Difference" if factor == 1 else f"Difference\n{TIMES}\N{NO-BREAK SPACE}{factor:g}",
            [Cell(picture=brighten(frame.difference, factor)) for frame in chosen],
        ),
    ]
    heads = [f"{frame.contact_state.capitalize()}\nΓ {percent(frame.safety_margin)}" for frame in chosen]
    grid = draw_grid(rows, heads=heads, below_in=0.55, cell_in=1.3 * CELL_IN)
    top = max(*lengths, STILL_PX)
    mappable = None
    with drawing_style():
        for column, frame in enumerate(chosen):
            _bare(plot_arrows(frame.raw, frame.rest_px, frame.now_px - frame.rest_px, ax=grid.axes[0][column]))
            field = fields[frame.id]
            if field is not None:
                grid.axes[1][column].clear()
                mappable = plot_field(field, size=size, ax=grid.axes[1][column], longest_px=top)
                _bare(grid.axes[1][column])
        assert mappable is not None  # there is a field
        bar = place_axes(grid.figure, 1.25, grid.bottom_in + 0.05, 2.6, 0.12)
        grid.figure.colorbar(mappable, cax=bar, orientation="horizontal", label="Displacement (px)")
    moves = ["unknown" if field is None else f"{_longest(field):.1f} px" for field in fields.values()]
    text = "; ".join(
        f"{move} at {frame.contact_state}, Γ {percent(frame.safety_margin)}"
        for move, frame in zip(moves, chosen, strict=True)
    )
    return Plate(
        name="fig-04-states",
        figure=grid.figure,
        alt=f"Camera image, displacement field and difference image at {listed(heads).replace(chr(10), ', ')}",
        caption=f"What a touch looks like, trial {states.trial}: camera image with the markers' displacement (from "
        f"{states.markers_from}), the field between them, and the difference image. Largest displacement: {text}.",
        numbers=_marker_numbers(chosen),
        pixels=True,
    )


def plate_fields_beside_saliency(results: Results) -> Plate | None:
    """Draw frame, field and Poly-CAM side by side, a row a state (thesis, Fig. 12); None without all three.

    The network is one that sees the camera's frames: alone, or where none does, beside the untouched sensor.
    """
    states, explained = results.study.states, explained_of(results, "raw") or explained_of(results, "pair")
    method = _poly_cam(explained)
    if states is None or explained is None or method is None:
        return None
    valid = {explained.frames[frame.index].id: frame for frame in shown_frames(results, explained)}
    marked, rows = [], []
    for frame in states.frames:
        field = _field(frame)
        if frame.id not in valid or field is None:
            continue
        fitted = _resized(explained.saliency[method][valid[frame.id].index], frame.raw.shape[:2])
        title = f"Γ {percent(frame.safety_margin)}"
        marked.append(MarkedFrame(title=title, frame=frame.raw, field=field, saliency=fitted))
        rows.append((frame.id, frame.safety_margin, _longest(field), _share_on_moving(fitted, field)))
    if not marked:
        return None
    shares = ", ".join(f"{percent(share)} at Γ {percent(margin)}" for _, margin, _, share in rows)
    return Plate(
        name="fig-12-poly-cam-raw" if explained.input == "raw" else f"poly-cam-{explained.input}",
        figure=draw_fields_beside_saliency(marked),
        alt="Camera frame, displacement field and Poly-CAM side by side at "
        f"{listed([frame.title for frame in marked])}",
        caption=f"{method_name(method)} on {input_name(explained.input).lower()} beside the displacement of the "
        "markers. Share of the saliency that lies where the "
        f"skin moves by more than half of that frame's largest displacement: {shares}.",
        numbers=named_columns(("frame_id", "safety_margin", "moves_px", "saliency_moves_share"), rows),
        pixels=True,
    )


def _one_a_state(states: States) -> list[StateFrame]:
    by_state: dict[str, list[StateFrame]] = {}
    for frame in sorted(states.frames, key=lambda one: -one.level):
        by_state.setdefault(frame.contact_state, []).append(frame)
    return [frames[len(frames) // 2] for frames in by_state.values()]


def _field(frame: StateFrame) -> DisplacementField | None:
    try:
        return interpolate_field(frame.rest_px, frame.now_px - frame.rest_px, size=frame.raw.shape[:2])
    except InputError:
        return None  # too few markers were followed into this frame


def _longest(field: DisplacementField) -> float:
    length = np.linalg.norm(field.displacement_px, axis=-1)[field.confidence > SURE]
    return float(length.max()) if len(length) else 0.0


def _share_on_moving(saliency: np.ndarray, field: DisplacementField) -> float:
    length = np.linalg.norm(field.displacement_px, axis=-1) * (field.confidence > SURE)
    high, wide = saliency.shape
    rows = np.abs(np.arange(high)[:, None] - field.y_px).argmin(axis=1)
    columns = np.abs(np.arange(wide)[:, None] - field.x_px).argmin(axis=1)
    moving = (length > length.max() / 2)[rows][:, columns]
    total = float(saliency.sum())
    return float(saliency[moving].sum() / total) if total > 0 else float("nan")


def _resized(saliency: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Network pixels to camera pixels."""
    return np.clip(np.asarray(Image.fromarray(saliency).resize((size[1], size[0]), Image.Resampling.BILINEAR)), 0, 1)


def _marker_numbers(frames: list[StateFrame]) -> dict[str, np.ndarray]:
    counts = [len(frame.rest_px) for frame in frames]
    rest, now = (np.concatenate([getattr(frame, name) for frame in frames]) for name in ("rest_px", "now_px"))
    names = {"frame_id": "id", "contact_state": "contact_state", "safety_margin": "safety_margin"}
    text = {name: np.repeat([getattr(frame, rows) for frame in frames], counts) for name, rows in names.items()}
    return text | dict(zip(("rest_x_px", "rest_y_px", "x_px", "y_px"), (*rest.T, *now.T), strict=True))


def _bare(ax: Axes) -> None:
    ax.set(xticks=[], yticks=[], xlabel="", ylabel="")
    ax.grid(visible=False)


def plate_truth(results: Results, name: str) -> Plate | None:
    """Draw frames, effects of each marker on answer and margin, and the maps nearest to these; None without truth."""
    truth, explained = results.study.truth.get(name), explained_of(results, name)
    if truth is None or explained is None:
        return None
    places = {frame.id: index for index, frame in enumerate(explained.frames)}
    chosen = _spread_out([frame_id for frame_id in truth.frame_ids if frame_id in places], explained, places)
    if not chosen:
        return None
    methods = _best_methods(truth, explained)
    pictures, called = bright_pictures(explained, [places[record] for record in chosen])
    rows = []
    for frame_id in chosen:
        index, row = places[frame_id], truth.frame_ids.index(frame_id)
        picture, frames = pictures[index], explained.frames[index]
        effects = (truth.shapley_maps[row], truth.network_maps[row], truth.margin_maps[row])
        cells = [Cell(picture=picture)]
        cells += [
            Cell(
                picture=_painted(picture, effect, percentile=100.0),
                words=f"up to {100 * np.abs(effect).max():.1f} points",
            )
            for effect in effects
        ]
        maps = [explained.relevance[method][index] for method in methods]
        cells += [Cell(picture=_painted(picture, record, percentile=FULL_COLOUR_PERCENTILE)) for record in maps]
        rows.append((f"Γ {percent(frames.safety_margin)}\n{reading_words(frames.prediction, frames.withheld)}", cells))
    truths = ("Shapley values\nin the answer", "Put back alone:\nthe answer", "Put back alone:\nthe margin")
    heads = [called, *truths, *(method_name(method) for method in methods)]
    return Plate(
        name=f"truth-{name}",
        figure=draw_grid(rows, heads=heads).figure,
        alt=f"{input_name(name)}: Shapley value and single effect of each marker in the answer, and its effect on the "
        f"best reading of the margin, beside the maps of {listed([method_name(method) for method in methods])}",
        caption=f"{input_name(name)}: what each marker does to the network's answer, in whatever company of markers "
        "(Shapley value) and alone, and to the best reading of the margin, in percentage points (value less value with "
        "that marker put back where it rested), beside the maps nearest to the first. Orange lowers, blue raises; full "
        f"colour at the largest effect of each picture, and at a map's {FULL_COLOUR_PERCENTILE:g}th percentile. "
        f"{_tell_match(truth, methods)}",
        numbers={name: getattr(truth.effects, rows) for name, rows in _EFFECT_COLUMNS.items()},
        pixels=True,
    )


def _painted(
    picture: UInt8[np.ndarray, "height width 3"], values: Float[np.ndarray, "rows columns"], *, percentile: float
) -> UInt8[np.ndarray, "height width 3"]:
    return overlay_relevance(picture, values / full_colour(values, percentile=percentile))


def _spread_out(ids: list[str], explained: Explanation, places: dict[str, int]) -> list[str]:
    """Pick a few frames from high to low margin, by their labels."""
    valid = [record for record in ids if explained.frames[places[record]].safety_margin is not None]
    ranked = sorted(valid, key=lambda one: -(explained.frames[places[one]].safety_margin or 0.0))
    if len(ranked) <= _TRUTH_FRAMES:
        return ranked
    return [ranked[place] for place in np.linspace(0, len(ranked) - 1, _TRUTH_FRAMES).round().astype(int)]


def _best_methods(truth: Truth, explained: Explanation) -> list[str]:
    """Methods whose maps correlate best with the Shapley values, as the verdict has it."""
    valid = {name: records.shapley for name in explained.relevance if (records := truth.methods.get(name)) is not None}
    likeness = {name: gap.estimate for name, gap in valid.items() if gap is not None and not is_control(name)}
    return sorted(methods_in_order(likeness), key=lambda name: -likeness[name])[:_TRUTH_METHODS]


def _tell_match(truth: Truth, methods: list[str]) -> str:
    parts = [
        f"{method_name(method)} {signed(records.estimate, 2)}"
        for method in methods
        if method in truth.methods and (records := truth.methods[method].shapley) is not None
    ]
    text = f"Spearman's correlation with the Shapley values: {', '.join(parts)}." if parts else ""
    gap = truth.shapley_against_margin
    if gap is not None:
        text += f" These and what moves the margin correlate by {tell_interval(gap, digits=2)}."
    return text.strip()
