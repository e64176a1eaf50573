"""Figures of the contact states: frame, field and difference; and fields beside saliency."""

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.colors import to_rgb
from PIL import Image

from sliplens.errors import InputError
from sliplens.markers import DisplacementField, interpolate_field
from sliplens.plots.contact_sheet import TIMES, brighten, brightening
from sliplens.plots.layout import place_axes
from sliplens.plots.markers import ARROWS, MarkedFrame, draw_fields_beside_saliency, plot_arrows, plot_field
from sliplens.plots.saliency import DIM, lightness
from sliplens.plots.style import (
    CONTROLS,
    ORANGE,
    SKY,
    drawing_style,
    input_name,
    listed,
    method_name,
    methods_in_order,
    percent,
    signed,
)
from sliplens.report.plates import (
    CELL_IN,
    Cell,
    Plate,
    bright_pictures,
    draw_grid,
    explained_of,
    named_columns,
    show_map,
    shown_frames,
)
from sliplens.report.results import Results
from sliplens.report.verdict import rank_methods
from sliplens.results.explanation import Explained
from sliplens.results.study import StateFrame, States, Truth

_SURE = 0.2  # confidence of a field below which it is a guess, as `plot_field` draws it
_METHOD = "poly-cam"
_FEWEST_STILL_PX = 0.3


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
    top = max(*lengths, _FEWEST_STILL_PX) if len(lengths) > 1 else max(lengths[0], _FEWEST_STILL_PX)
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
    told = "; ".join(_tell_motion(frame, fields[frame.id]) for frame in chosen)
    return Plate(
        name="fig-04-states",
        figure=grid.figure,
        alt=f"Camera image, displacement field and difference image at {listed(heads).replace(chr(10), ', ')}",
        caption=f"What a touch looks like, trial {states.trial}: camera image with the markers' displacement (from "
        f"{states.markers_from}), the field between them, and the difference image. Largest displacement: {told}.",
        numbers=_marker_numbers(chosen),
        pixels=True,
    )


def plate_fields_beside_saliency(results: Results) -> Plate | None:
    """Draw raw frame, field and Poly-CAM side by side, a row a state (thesis, Fig. 12); None without all three."""
    states, explained = results.study.states, explained_of(results, "raw")
    if states is None or explained is None or _METHOD not in explained.saliency:
        return None
    known = {explained.frames[one.index].id: one for one in shown_frames(results, explained)}
    marked, rows = [], []
    for frame in states.frames:
        field = _field(frame)
        if frame.id not in known or field is None:
            continue
        fitted = _resized(explained.saliency[_METHOD][known[frame.id].index], frame.raw.shape[:2])
        title = f"Γ {percent(frame.safety_margin)}"
        marked.append(MarkedFrame(title=title, frame=frame.raw, field=field, saliency=fitted))
        rows.append((frame.id, frame.safety_margin, _longest(field), _share_on_moving(fitted, field)))
    if not marked:
        return None
    shares = ", ".join(f"{percent(share)} at Γ {percent(margin)}" for _, margin, _, share in rows)
    return Plate(
        name="fig-12-poly-cam-raw",
        figure=draw_fields_beside_saliency(marked),
        alt=f"Raw frame, displacement field and Poly-CAM map side by side at {listed([one.title for one in marked])}",
        caption="Poly-CAM on raw images beside the displacement of the markers. Share of the saliency that lies where "
        f"the skin moves by more than half of that frame's largest displacement: {shares}.",
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
    length = np.linalg.norm(field.displacement_px, axis=-1)[field.confidence > _SURE]
    return float(length.max()) if len(length) else 0.0


def _share_on_moving(saliency: np.ndarray, field: DisplacementField) -> float:
    length = np.linalg.norm(field.displacement_px, axis=-1) * (field.confidence > _SURE)
    high, wide = saliency.shape
    rows = np.abs(np.arange(high)[:, None] - field.y_px).argmin(axis=1)
    columns = np.abs(np.arange(wide)[:, None] - field.x_px).argmin(axis=1)
    moving = (length > length.max() / 2)[rows][:, columns]
    total = float(saliency.sum())
    return float(saliency[moving].sum() / total) if total > 0 else float("nan")


def _resized(saliency: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Network pixels to camera pixels."""
    if saliency.shape == size:
        return saliency
    image = Image.fromarray(saliency.astype(np.float32), mode="F")
    return np.clip(np.asarray(image.resize((size[1], size[0]), Image.Resampling.BILINEAR)), 0, 1)


def _tell_motion(frame: StateFrame, field: DisplacementField | None) -> str:
    told = "unknown" if field is None else f"{_longest(field):.1f} px"
    return f"{told} at {frame.contact_state}, Γ {percent(frame.safety_margin)}"


def _marker_numbers(frames: list[StateFrame]) -> dict[str, np.ndarray]:
    counts = [len(frame.rest_px) for frame in frames]
    rest, now = (np.concatenate([getattr(frame, name) for frame in frames]) for name in ("rest_px", "now_px"))
    named = ("contact_state", "safety_margin")
    return {
        "frame_id": np.repeat([frame.id for frame in frames], counts),
        **{name: np.repeat([getattr(frame, name) for frame in frames], counts) for name in named},
        "rest_x_px": rest[:, 0],
        "rest_y_px": rest[:, 1],
        "x_px": now[:, 0],
        "y_px": now[:, 1],
    }


def _bare(ax) -> None:  # noqa: ANN001
    ax.set(xticks=[], yticks=[], xlabel="", ylabel="")
    ax.grid(visible=False)


_FRAMES = 3
_METHODS = 3


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
        effects = (truth.network_maps[row], truth.margin_maps[row])
        cells = [
            Cell(picture=picture),
            *(Cell(picture=paint_effects(picture, one), words=f"up to {_points(one)} points") for one in effects),
            *(Cell(picture=show_map(picture, explained.saliency[method][index])) for method in methods),
        ]
        rows.append((f"Γ {percent(own.safety_margin)}\nread {percent(own.prediction)}", cells))
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

    Effects of another height and width than the picture's are repeated.
    """
    high, wide = picture.shape[:2]
    rows = np.arange(high) * effects.shape[0] // high
    columns = np.arange(wide) * effects.shape[1] // wide
    fitted = effects[rows][:, columns].astype(np.float64)
    size = np.abs(fitted).max()
    value = fitted / size if size > 0 else fitted
    grey = (DIM * lightness(picture))[..., None]
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
