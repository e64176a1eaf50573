"""What the network should have looked at beside what it did, which only a simulation tells."""

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.colors import to_rgb

from sliplens.report.records import Explained
from sliplens.report.study.believing import rank_methods
from sliplens.report.study.grids import Cell, draw_grid, show_map
from sliplens.report.study.localised import Truth
from sliplens.report.study.plates import Plate
from sliplens.report.study.shown import bright_pictures, explained_of
from sliplens.report.style import (
    CONTROLS,
    ORANGE,
    SKY,
    input_name,
    listed,
    method_name,
    methods_in_order,
    percent,
    signed,
)
from sliplens.report.workspace import Results

_FRAMES = 3
_METHODS = 3
_DIM = 0.55


def plate_truth(results: Results, name: str) -> Plate | None:
    """Draw frames, effects of each marker on answer and margin, and the best methods' maps; None without the truth."""
    truth, explained = results.study.truth.get(name), explained_of(results, name)
    if truth is None or explained is None:
        return None
    places = {frame.id: index for index, frame in enumerate(explained.frames)}
    chosen = _spread_out([one for one in truth.frame_ids if one in places], explained, places)
    if not chosen:
        return None
    methods = _best_methods(results, name, explained)
    pictures, called = bright_pictures(explained, [places[one] for one in chosen])
    rows = []
    for frame_id in chosen:
        index, row = places[frame_id], truth.frame_ids.index(frame_id)
        picture, own = pictures[index], explained.frames[index]
        rows.append(
            (
                f"Γ {percent(own.safety_margin)}\nread {percent(own.prediction)}",
                [
                    Cell(picture=picture),
                    Cell(
                        picture=paint_effects(picture, truth.network_maps[row]),
                        words=f"up to {_points(truth.network_maps[row])} points",
                    ),
                    Cell(
                        picture=paint_effects(picture, truth.margin_maps[row]),
                        words=f"up to {_points(truth.margin_maps[row])} points",
                    ),
                    *(Cell(picture=show_map(picture, explained.saliency[method][index])) for method in methods),
                ],
            )
        )
    heads = [called, "What moves the\nanswer", "What moves the\nmargin", *(method_name(one) for one in methods)]
    return Plate(
        name=f"truth-{name}",
        figure=draw_grid(rows, heads=heads, bar=True).figure,
        alt=f"{input_name(name)}: effect of each marker on the answer and on the best reading of the margin beside the "
        f"maps of {listed([method_name(one) for one in methods])}",
        caption=f"{input_name(name)}: what each marker does to the network's answer and to the best reading of the "
        "margin, in percentage points (value less value with that marker put back where it rested; orange lowers, blue "
        "raises, full colour at the largest of each picture), beside the best methods' maps. "
        f"{_tell_match(truth, methods)}",
        numbers={
            "frame_id": truth.effects.frame_id,
            "marker": truth.effects.marker,
            "x_px": truth.effects.x_px,
            "y_px": truth.effects.y_px,
            "network_effect": truth.effects.network,
            "margin_effect": truth.effects.margin,
            "state": truth.effects.state,
        },
        pixels=True,
    )


def paint_effects(
    picture: UInt8[np.ndarray, "height width 3"], effects: Float[np.ndarray, "rows columns"]
) -> UInt8[np.ndarray, "height width 3"]:
    """Lay signed effects over a picture in dimmed grey: orange below zero, blue above, the stronger the less grey.

    Parameters
    ----------
    picture
        What the network saw, as RGB.
    effects
        Signed, of the picture's height and width or of another: cells are then repeated.
    """
    high, wide = picture.shape[:2]
    rows = np.arange(high) * effects.shape[0] // high
    columns = np.arange(wide) * effects.shape[1] // wide
    fitted = effects[rows][:, columns].astype(np.float64)
    size = np.abs(fitted).max()
    value = fitted / size if size > 0 else fitted
    # Rec. 601 weights, as in `overlay_saliency`
    grey = _DIM * (picture @ np.array([0.299, 0.587, 0.114]) / 255)[..., None]
    alpha = np.abs(value)[..., None]
    # bright on dark, and told apart under every common colour blindness
    colour = np.where(value[..., None] < 0, to_rgb(ORANGE), to_rgb(SKY))
    mixed = (1 - alpha) * grey + alpha * colour
    return np.round(255 * mixed).astype(np.uint8)


def _spread_out(ids: list[str], explained: Explained, places: dict[str, int]) -> list[str]:
    """Pick a few frames from high to low margin, by their labels."""
    known = [one for one in ids if explained.frames[places[one]].safety_margin is not None]
    ranked = sorted(known, key=lambda one: -(explained.frames[places[one]].safety_margin or 0.0))
    if len(ranked) <= _FRAMES:
        return ranked
    return [ranked[place] for place in np.linspace(0, len(ranked) - 1, _FRAMES).round().astype(int)]


def _best_methods(results: Results, name: str, explained: Explained) -> list[str]:
    faithful = results.study.faithfulness.get(name)
    ranked = [] if faithful is None else [one.method for one in rank_methods(faithful)]
    known = methods_in_order(set(explained.saliency) - set(CONTROLS))
    return [*(one for one in ranked if one in known), *(one for one in known if one not in ranked)][:_METHODS]


def _points(effects: np.ndarray) -> str:
    return f"{100 * float(np.abs(effects).max()):.1f}"


def _tell_match(truth: Truth, methods: list[str]) -> str:
    parts = [
        f"{method_name(one)} {signed(value, 2)}"
        for one in methods
        if one in truth.methods and (value := truth.methods[one].spearman_network) is not None
    ]
    told = f"Spearman's correlation with what moves the answer: {', '.join(parts)}." if parts else ""
    gap = truth.network_against_margin
    if gap is not None:
        told += (
            f" What moves the answer and what moves the margin correlate by {signed(gap.estimate, 2)} "
            f"({signed(gap.low, 2)} to {signed(gap.high, 2)})."
        )
    return told.strip()
