"""Plates made of pictures: maps beside each other, and what deletion removes."""

from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from sliplens.plots.margins import draw_strip
from sliplens.plots.saliency import FULL_COLOUR_PERCENTILE, full_colour, overlay_relevance
from sliplens.plots.style import (
    input_name,
    listed,
    method_name,
    methods_in_order,
    percent,
    reading_words,
    signed,
    source_name,
)
from sliplens.report.comparisons import tell_interval
from sliplens.report.plates import (
    Cell,
    Plate,
    ShownFrame,
    bright_pictures,
    draw_grid,
    explained_of,
    named_columns,
    show_map,
    shown_frames,
)
from sliplens.report.results import Results
from sliplens.results.explanation import Explanation, Strip
from sliplens.results.faithfulness import is_control
from sliplens.results.study import Truth

_SALIENCY_COLUMNS = (
    "input", "method", "frame_id", "level", "safety_margin", "prediction", "share_above_half", "centre_x_px",
    "centre_y_px",
)  # fmt: skip
_TRUTH_FRAMES = _TRUTH_METHODS = 3
_EFFECT_COLUMNS = {name: name for name in ("frame_id", "marker", "x_px", "y_px")}
_EFFECT_COLUMNS |= {"shapley_value": "shapley", "shapley_error": "shapley_error", "network_effect": "network"}
_EFFECT_COLUMNS |= {"margin_effect": "margin", "state": "state"}
_STATE_FIGURES = {"difference": "fig-15-methods-difference", "raw": "fig-16-methods-raw"}


def plate_states(results: Results, explained: Explanation) -> Plate | None:
    """Draw every method across the states of one trial (thesis, Figs. 15 and 16); None without frames to show."""
    frames = shown_frames(results, explained)
    if not frames:
        return None
    methods = methods_in_order(name for name in explained.saliency if not is_control(name))
    real = explained.source == "real"
    name = f"real-{explained.input}" if real else _STATE_FIGURES.get(explained.input, f"methods-{explained.input}")
    what = f"Methods across the contact states, {input_name(explained.input).lower()}, {source_name(explained.source)}"
    pictures, called = bright_pictures(explained, [frame.index for frame in frames])
    answers = [explained.frames[frame.index] for frame in frames]
    words = [
        f"true {percent(frame.safety_margin)}, {reading_words(frame.prediction, frame.withheld)}" for frame in answers
    ]
    cells = [Cell(picture=pictures[frame.index], words=text) for frame, text in zip(frames, words, strict=True)]
    rows = [(called, cells)] + [
        (
            method_name(method),
            [
                Cell(picture=show_map(pictures[frame.index], explained.saliency[method][frame.index]))
                for frame in frames
            ],
        )
        for method in methods
    ]
    levels = [f"Γ {percent(frame.level)}" for frame in frames]
    errors = [abs(answer.prediction - answer.safety_margin) for answer in answers if answer.safety_margin is not None]
    off = f" The network is off by at most {100 * max(errors):.1f} percentage points on these frames." if errors else ""
    trials = {answer.trial for answer in answers}
    return Plate(
        name=name,
        figure=draw_grid(rows, heads=levels, bar=True).figure,
        alt=f"{what}: {listed([method_name(method) for method in methods])} at {', '.join(levels)}",
        caption=f"{what}: {'one trial' if len(trials) == 1 else 'frames'} from full stick to full slip.{off} "
        "Colours are relative to each map's own saliency, so brightness does not compare between maps; a map without "
        "colour supports nothing of the prediction.",
        numbers=named_columns(
            _SALIENCY_COLUMNS, [_measured(explained, method, frame) for method in methods for frame in frames]
        ),
        pixels=True,
    )


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


def _measured(explained: Explanation, method: str, frame: ShownFrame) -> tuple[Any, ...]:
    """Numbers of a map drawn: where its weight lies, and on how much of the image."""
    shown_frame = explained.frames[frame.index]
    saliency = explained.saliency[method][frame.index].astype(np.float64)
    total, (y, x) = saliency.sum(), np.indices(saliency.shape)
    right, down = (float((saliency * axis).sum() / total) if total > 0 else float("nan") for axis in (x, y))
    label = float("nan") if shown_frame.safety_margin is None else shown_frame.safety_margin
    above = float((saliency > 0.5).mean())
    return explained.input, method, shown_frame.id, frame.level, label, shown_frame.prediction, above, right, down


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
