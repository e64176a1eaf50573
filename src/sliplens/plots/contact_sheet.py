"""Contact sheet: frames of trials from the untouched sensor to full slip, on one picture."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from textwrap import fill

import numpy as np
from jaxtyping import UInt8
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
    drawing_style,
    percent,
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
_NAMED = tuple(state for state in ContactState if state is not ContactState.UNKNOWN)
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


def state_patches() -> list[Patch]:
    """Create the legend of the contact states."""
    return [Patch(lw=0, label=str(state), color=STATE_COLOURS[state], alpha=STATE_TINTS[state]) for state in _NAMED]


_REACHED_WITHIN = 0.1 - 1e-9  # half the distance between two columns: no frame stands in both
_ALIKE = 0.005  # margins that are equal in whole percents


def draw_contact_sheet(recordings: Sequence[Recording], *, title: str | None = None) -> Figure:
    """Draw two rows a trial: frames from the untouched sensor to full slip, and their differences; forces at the right.

    Frames are those of `choose_untouched` and `choose_margins`; difference images are brightened by one factor, so that
    trials compare. Outlines of the true contact and stick zone lie over the frames of simulated trials.
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
    with drawing_style():
        figure = Figure(figsize=(16, 3.9 * len(recordings) + 0.9), layout="constrained")
        figure.suptitle(title or "", x=0.01, ha="left", fontsize=14, fontweight="bold", parse_math=False)
        grid = figure.add_gridspec(2 * len(rows), len(rows[0]) + 1, width_ratios=[*[1.0] * len(rows[0]), 1.8])
        for band, (recording, row) in enumerate(zip(recordings, rows, strict=True)):
            for column, index in enumerate(row):
                pair = [figure.add_subplot(grid[2 * band + line, column]) for line in (0, 1)]
                _draw_pictures(recording, index, pair, factor=factor, nominal=[None, *MARGIN_LEVELS][column])
            for line, plot in enumerate((plot_forces, plot_margin)):
                ax = plot(recording, ax=figure.add_subplot(grid[2 * band + line, -1]))
                for time_s in recording.time_s[[at for at in row if at is not None]]:
                    ax.axvline(time_s, color=BLACK, linewidth=0.7, alpha=0.45, zorder=1)
        models = [recording.truth.displacement for recording in recordings if recording.truth is not None]
        stick = "outline of its stick zone" + (" (nominal)" if "calibrated" in models else "")
        rim = [Stroke(linewidth=3.4, foreground=BLACK), Normal()]
        outlines = [
            Line2D([], [], color=colour, linewidth=1.8, path_effects=rim, label=label)
            for colour, label in ((("white", "outline of the contact"), (SKY, stick)) if models else ())
        ]
        mark = Line2D([], [], color=BLACK, linewidth=0.7, label="frame shown")
        figure.legend(handles=[*outlines, mark, *state_patches()], ncols=7, loc="outside lower left")
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
    recording: Recording, index: int | None, axes: Sequence[Axes], *, factor: float, nominal: float | None
) -> None:
    """Draw a frame and its difference image; the first column, without a nominal margin, has the facts of the trial."""
    for ax in axes:
        ax.set(xticks=[], yticks=[])
        ax.spines[:].set_visible(False)
    camera, below = axes
    if index is None and nominal is not None:
        write_over(camera, f"no frame\nnear {percent(nominal)}")
        return
    frame = recording.reference if index is None else recording.frames[index]
    camera.imshow(frame)
    below.imshow(brighten(absolute_difference(frame, recording.reference), factor))
    when = "reference" if index is None else f"{recording.time_s[index]:.1f} s, {recording.contact_state[index]}"
    if nominal is None:
        name = fill(recording.trial, 26, max_lines=2, placeholder="…")
        length = f"{number_of(len(recording), 'frame')} in {np.ptp(recording.time_s):.1f} s"
        facts = f"{name}\n{recording.condition}, day {recording.day}, {recording.sensor}\n{length}"
        # a dollar sign in a name begins no formula
        camera.set_ylabel(facts, fontsize=8, parse_math=False)
        below.set_ylabel(f"difference {TIMES} {factor:g}", fontsize=8)
        camera.set_title(f"untouched\n{when}", fontsize=8.5)
    elif index is not None:
        camera.set_title(f"Γ {percent(float(recording.safety_margin[index]))}\n{when}", fontsize=8.5)
    if index is not None and recording.truth is not None:
        contact = recording.truth.contact_map[index]
        touches, sticks = contact != OUTSIDE, contact == STICKS
        # dark rims first, then wide under narrow, so that outlines that run together both show
        lines = ((touches, BLACK, 2.2), (sticks, BLACK, 1.6), (touches, "white", 1.5), (sticks, SKY, 0.9))
        for zone, colour, width in lines:
            if zone.any() and not zone.all():  # else there is no line to draw
                camera.contour(zone, levels=[0.5], colors=[colour], linewidths=width)
