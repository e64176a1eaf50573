"""Contact sheet: frames of trials from the untouched sensor to full slip, on one picture."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from textwrap import fill

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import Normal, Stroke

from sliplens.errors import InputError
from sliplens.images import absolute_difference
from sliplens.plots.style import (
    BLACK,
    BLUE,
    GREY,
    ORANGE,
    SKY,
    VERMILLION,
    decimals,
    drawing_style,
    percent,
    place_axes,
    place_text,
    require_picture_path,
    save_page,
    write_over,
)
from sliplens.progress import number_of
from sliplens.recordings import ContactState, Recording
from sliplens.recordings.trial import OUTSIDE, STICKS
from sliplens.results.explanation import MARGIN_LEVELS

STATE_COLOURS = dict(zip(ContactState, (GREY, BLUE, ORANGE, VERMILLION, "white"), strict=True))
# full slip is darker, so that lightness too separates it from incipient slip
STATE_TINTS = dict(zip(ContactState, (0.2, 0.2, 0.2, 0.55, 0), strict=True))
NAMED_STATES = tuple(state for state in ContactState if state is not ContactState.UNKNOWN)
"""States in legends."""
TIMES = "\N{MULTIPLICATION SIGN}"

_BRIGHT_PERCENTILE = 99.5  # of the differences: a few outlying pixels would leave the rest dark


def brightening(differences: Sequence[UInt8[np.ndarray, "_ _ _ 3"]]) -> float:
    """Compute the factor, at least 1 and of one decimal, that makes the brightest half percent of pixels white."""
    levels = [float(np.percentile(pixels.max(axis=-1), _BRIGHT_PERCENTILE)) for pixels in differences if pixels.size]
    return max(1.0, round(255 / max([1.0, *levels]), 1))


def brighten(difference: UInt8[np.ndarray, "*any"], factor: float) -> UInt8[np.ndarray, "*any"]:
    """Multiply grey levels by a factor, up to 255."""
    return np.minimum(np.round(np.float32(factor) * difference), 255).astype(np.uint8)


def plot_forces(recording: Recording, *, ax: Axes) -> Axes:
    """Draw F_n, F_t and the friction limit mu F_n over time, in newtons, with a legend above."""
    time_s, normal = recording.time_s, recording.normal_force_n
    ax.plot(time_s, normal, color=BLUE, label="$F_n$")
    ax.plot(time_s, recording.tangential_force_n, color=VERMILLION, linestyle="--", label="$F_t$")
    limit = recording.friction_coefficient * normal
    ax.plot(time_s, limit, color=GREY, linestyle=":", linewidth=1.3, label=r"$\mu F_n$")
    ax.set(ylabel="Force (N)", xmargin=0)
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3, borderaxespad=0.1, columnspacing=1.2)
    return ax


def plot_margin(recording: Recording, *, ax: Axes) -> Axes:
    """Draw the safety margin over time, in percent, on the colours of the contact states."""
    states = recording.contact_state
    changes = [at for at in range(1, len(states)) if states[at] != states[at - 1]]
    edges = recording.time_s[[0, *changes, len(states) - 1]]
    for at, (begin, end) in zip([0, *changes], pairwise(edges), strict=True):
        ax.axvspan(begin, end, color=STATE_COLOURS[states[at]], alpha=STATE_TINTS[states[at]], linewidth=0)
    ax.plot(recording.time_s, 100 * recording.safety_margin, color=BLACK)
    ax.set(xlabel="Time (s)", ylabel="Γ (%)", xmargin=0, ylim=(-7, 107), yticks=[0, 50, 100])
    return ax


def outline_handles(recordings: Sequence[Recording]) -> list[Line2D]:
    """Create the legend of the outlines, empty where no trial has any."""
    models = [recording.truth.displacement for recording in recordings if recording.truth is not None]
    stick = "outline of its stick zone" + (" (nominal)" if "calibrated" in models else "")
    lines = (("white", "outline of the contact"), (SKY, stick)) if models else ()
    rim = [Stroke(linewidth=3.4, foreground=BLACK), Normal()]
    return [Line2D([], [], color=colour, linewidth=1.8, path_effects=rim, label=label) for colour, label in lines]


_REACHED_WITHIN = 0.1 - 1e-9  # half the distance between two columns: no frame stands in both
_ALIKE = 0.005  # margins that are equal in whole percents

# inches, from left to right: facts of the trial, pictures, charts
_WIDTH, _EDGE, _INFO, _GAP, _AXIS, _CHART = 16.0, 0.2, 1.9, 0.07, 0.62, 2.9
_PICTURE = (_WIDTH - 2 * _EDGE - _INFO - _AXIS - _CHART) / (1 + len(MARGIN_LEVELS)) - _GAP
# from top to bottom; charts need some height, and very long or very high pictures are reduced
_HEAD, _TIME, _FOOT, _LEGEND, _LEAST, _PICTURE_HEIGHT = 0.42, 0.42, 0.18, 0.75, 2.6, (0.8, 2.4)


def draw_contact_sheet(recordings: Sequence[Recording], *, title: str | None = None) -> Figure:
    """Draw one band a trial: frames from the untouched sensor to full slip, their differences, and the forces.

    A band shows the frames of `choose_untouched` and `choose_margins`, beneath each its absolute difference image,
    brightened by one factor for the whole sheet so that trials compare, and at the right forces and safety margin over
    time. Outlines of the true contact and its stick zone lie over the camera frames of simulated trials.
    """
    if not recordings:
        raise InputError("a contact sheet needs a trial; give at least one recording")
    rows = [[choose_untouched(recording), *choose_margins(recording)] for recording in recordings]
    factor = brightening(
        [
            absolute_difference(recording.frames[[at for at in row if at is not None]], recording.reference)
            for recording, row in zip(recordings, rows, strict=True)
        ]
    )
    aspects = [recording.reference.shape[0] / recording.reference.shape[1] for recording in recordings]
    heights = [float(np.clip(_PICTURE * aspect, *_PICTURE_HEIGHT)) for aspect in aspects]
    bands = [_HEAD + max(2 * height + _GAP, _LEAST) + _FOOT for height in heights]
    top = 0.1 if title is None else 0.55
    with drawing_style():
        figure = Figure(figsize=(_WIDTH, top + sum(bands) + _LEGEND))
        if title is not None:
            place_text(figure, _EDGE, 0.16, title, fontsize=14, fontweight="bold", parse_math=False)
        for recording, row, height, band in zip(recordings, rows, heights, bands, strict=True):
            _draw_pictures(figure, recording, row, top=top + _HEAD, height=height, factor=factor)
            chosen = [at for at in row[1:] if at is not None]
            _write_facts(figure, recording, chosen, top=top + _HEAD)
            marked = chosen if row[0] is None else [row[0], *chosen]
            _draw_charts(figure, recording, marked, top=top + _HEAD, height=band - _HEAD - _TIME - _FOOT)
            top += band
        _explain(figure, recordings, factor)
    return figure


def write_contact_sheet(recordings: Sequence[Recording], path: Path, *, title: str | None = None) -> None:
    """Save a contact sheet as .png, .pdf or .svg; it appears when complete."""
    require_picture_path(path, example="preview.png")
    save_page(draw_contact_sheet(recordings, title=title), path)


def choose_margins(recording: Recording) -> list[int | None]:
    """Choose the frames nearest to Γ = 100, 80, 60, 40, 20 and 0 %; None where none is within 10 percentage points.

    100 % is taken from contact without slip, 0 % from full slip and the others from before the first full slip, where
    possible. Of frames equal to half a percentage point the one pressed hardest is chosen: at first touch the margin is
    100 % too, but little shows.
    """
    labelled, states = np.isfinite(recording.safety_margin), np.array(recording.contact_state)
    sliding = states == ContactState.FULL_SLIP
    wanted = {1.0: states == ContactState.CONTACT, 0.0: sliding}
    chosen: list[int | None] = []
    for nominal in MARGIN_LEVELS:
        nearest = None
        for fitting in (labelled, labelled & wanted.get(nominal, ~np.logical_or.accumulate(sliding))):
            distance = np.where(fitting, np.abs(recording.safety_margin - nominal), np.inf)
            if distance.min() < _REACHED_WITHIN:
                alike = distance <= distance.min() + _ALIKE
                nearest = int(np.argmax(np.where(alike, np.nan_to_num(recording.normal_force_n), -np.inf)))
        chosen.append(nearest)
    return chosen


def choose_untouched(recording: Recording) -> int | None:
    """Choose the middle frame of those without contact; None without any."""
    free = [index for index, state in enumerate(recording.contact_state) if state == ContactState.NO_CONTACT]
    return free[len(free) // 2] if free else None


def _draw_pictures(
    figure: Figure, recording: Recording, row: list[int | None], *, top: float, height: float, factor: float
) -> None:
    first, second = _EDGE + _INFO, top + height + _GAP
    for text, middle in (("camera", top + height / 2), (f"difference\n{TIMES} {factor:g}", second + height / 2)):
        turned = {"rotation": 90, "ha": "right", "va": "center", "multialignment": "center"}
        place_text(figure, first - 0.06, middle, text, fontsize=8.5, color=GREY, **turned)
    for column, index in enumerate(row):
        x = first + column * (_PICTURE + _GAP)
        camera, below = (place_axes(figure, x, y, _PICTURE, height) for y in (top, second))
        for ax in (camera, below):
            ax.set(xticks=[], yticks=[])
            ax.spines[:].set_visible(False)
        if index is None and column:
            camera.spines[:].set(visible=True, color="#E5E7EB")
            write_over(camera, f"no frame\nnear {percent(MARGIN_LEVELS[column - 1])}")
            continue
        frame = recording.reference if index is None else recording.frames[index]
        camera.imshow(frame)
        below.imshow(brighten(absolute_difference(frame, recording.reference), factor))
        if index is not None and recording.truth is not None:
            _plot_outlines(recording.truth.contact_map[index], ax=camera)
        name = f"Γ {percent(float(recording.safety_margin[index]))}" if index is not None and column else "untouched"
        when = "reference" if index is None else f"{recording.time_s[index]:.1f} s, {recording.contact_state[index]}"
        for words, up, settings in ((name, 0.2, {"weight": "bold"}), (when, 0.05, {"fontsize": 8, "color": GREY})):
            place_text(figure, x + _PICTURE / 2, top - up, words, ha="center", va="bottom", **settings)


def _plot_outlines(contact: UInt8[np.ndarray, "height width"], *, ax: Axes) -> None:
    touches, sticks = contact != OUTSIDE, contact == STICKS
    # dark rims first, then wide under narrow, so that outlines that run together both show
    lines = ((touches, BLACK, 2.2), (sticks, BLACK, 1.6), (touches, "white", 1.5), (sticks, SKY, 0.9))
    for zone, colour, width in lines:
        if zone.any() and not zone.all():  # else there is no line to draw
            ax.contour(zone, levels=[0.5], colors=[colour], linewidths=width)


def _draw_charts(figure: Figure, recording: Recording, marked: list[int], *, top: float, height: float) -> None:
    x, tall, gap = _WIDTH - _EDGE - _CHART, 0.56 * height, 0.1
    forces = plot_forces(recording, ax=place_axes(figure, x, top, _CHART, tall))
    forces.tick_params(labelbottom=False)
    margin = plot_margin(recording, ax=place_axes(figure, x, top + tall + gap, _CHART, height - tall - gap))
    for ax in (forces, margin):
        for time_s in recording.time_s[marked]:
            ax.axvline(time_s, color=BLACK, linewidth=0.7, alpha=0.45, zorder=1)
    margin.plot(recording.time_s[marked], 100 * recording.safety_margin[marked], "o", color=BLACK, markersize=5)
    figure.align_ylabels([forces, margin])


def _write_facts(figure: Figure, recording: Recording, chosen: list[int], *, top: float) -> None:
    # a dollar sign in a name begins no formula
    name = fill(recording.trial, 17, max_lines=3, placeholder="…")
    place_text(figure, _EDGE, top, name, fontsize=10, fontweight="bold", parse_math=False)
    top += 0.19 * len(name.splitlines()) + 0.05
    facts = (f"{recording.condition}, day {recording.day}", recording.sensor)
    length = f"{number_of(len(recording), 'frame')} in {np.ptp(recording.time_s):.1f} s"
    lines = "\n".join(fill(fact, 20, max_lines=2, placeholder="…") for fact in (*facts, length))
    place_text(figure, _EDGE, top, lines, fontsize=9.5, linespacing=1.5, parse_math=False)
    top += 0.205 * len(lines.splitlines()) + 0.08
    force, friction = recording.normal_force_n[chosen], recording.friction_coefficient[chosen]
    place_text(figure, _EDGE, top, f"$F_n$ {_range(force)} N\n$\\mu$ {_range(friction)}", fontsize=9.5, linespacing=1.5)


def _range(values: Float[np.ndarray, " frames"]) -> str:
    ends = [decimals(end, 2) for end in (np.nanmin(values), np.nanmax(values))] if np.isfinite(values).any() else ["?"]
    return "–".join(dict.fromkeys(ends))  # noqa: RUF001 (an en dash is meant)


def _explain(figure: Figure, recordings: Sequence[Recording], factor: float) -> None:
    bottom = float(figure.get_size_inches()[1])
    words = (
        f"Frames nearest to Γ = {', '.join(f'{100 * nominal:.0f}' for nominal in MARGIN_LEVELS)} %; at the left the "
        "ranges of their $F_n$ and $\\mu$. Differences are $|T_n - T_0|$ against the untouched sensor, brightened "
        f"{TIMES} {factor:g}: one factor for the whole sheet, so pictures compare."
    )
    place_text(figure, _EDGE, bottom - 0.65, words, fontsize=9)
    mark = Line2D([], [], color=BLACK, linewidth=0.7, marker="o", markersize=5, label="frame shown")
    tints = [(state, {"color": STATE_COLOURS[state], "alpha": STATE_TINTS[state]}) for state in NAMED_STATES]
    states = [Patch(linewidth=0, label=str(state), **tint) for state, tint in tints]
    place = {"loc": "lower left", "bbox_to_anchor": (_EDGE / _WIDTH, 0.1 / bottom), "borderaxespad": 0, "borderpad": 0}
    figure.legend(handles=[*outline_handles(recordings), mark, *states], ncols=7, **place)
