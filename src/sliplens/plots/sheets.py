"""Picture of a trial over time, and the audit page of an imported one."""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from textwrap import wrap

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from sliplens.errors import InputError
from sliplens.images import absolute_difference
from sliplens.plots import style
from sliplens.plots.style import BLACK, BLUE, GREEN, GREY, PURPLE, SKY, VERMILLION, drawing_style, save_page
from sliplens.progress import OnProgress, open_stage, report_each, reporting
from sliplens.recordings import ContactState, Dataset, Recording
from sliplens.recordings.dataset import trial_path
from sliplens.recordings.labelling import FrictionEstimate, LabelBasis, Labelling
from sliplens.recordings.store import load_recording, read_frames
from sliplens.results.explanation import MARGIN_LEVELS

STATE_COLOURS = dict(zip(ContactState, (style.GREY, style.BLUE, style.ORANGE, style.VERMILLION, "white"), strict=True))
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


def plot_margin(recording: Recording, *, ax: Axes) -> Axes:
    """Draw the safety margin over time, in percent, on the colours of the contact states."""
    states = recording.contact_state
    changes = [at for at in range(1, len(states)) if states[at] != states[at - 1]]
    edges = recording.time_s[[0, *changes, len(states) - 1]]
    for at, (begin, end) in zip([0, *changes], pairwise(edges), strict=True):
        ax.axvspan(begin, end, color=STATE_COLOURS[states[at]], alpha=STATE_TINTS[states[at]], linewidth=0)
    ax.plot(recording.time_s, 100 * recording.safety_margin, color=style.BLACK)
    ax.set(xlabel="Time (s)", ylabel="Γ (%)", xmargin=0, ylim=(-7, 107), yticks=[0, 50, 100])
    return ax


_REACHED_WITHIN = 0.1 - 1e-9  # half the distance between two columns: no frame stands in both
_ALIKE = 0.005  # margins that are equal in whole percents


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


_FRAMES = 6  # beside the reference
_WRAP, _MOST_LINES, _LINE = 47, 54, 0.0165  # characters of a line, lines of the page, and their height as a share

ReadFrames = Callable[[Sequence[int]], UInt8[np.ndarray, "frames height width 3"]]
"""Reads the frames of some numbers, in their order."""


def describe_labels(recording: Recording, labelling: Labelling) -> list[str]:
    """Describe what the labels rest on, in a sentence each."""
    basis, reference, counts = labelling.basis, labelling.reference, recording.count()
    valid, sigma = counts.pop("valid", 0), recording.safety_margin_sigma
    loss = ", ".join(f"{count} {reason}" for reason, count in counts.items())
    facts = [f"{valid} of {len(recording)} frames are valid" + (f": {loss}" if loss else "")]
    if sigma is not None and np.nanmax(sigma, initial=0) > 0:
        facts.append(f"Γ is known to ± {100 * np.nanmedian(sigma):.1f} % (median)")
    chosen = reference.method if reference.index is None else f"frame {reference.index}, {reference.method}"
    facts += [f"reference: {chosen}", *(words for words in (labelling.source, labelling.forces) if words)]
    if basis is not None:
        friction, lag = basis.friction, basis.lag
        exact = friction.low == friction.high
        interval = "taken as exact" if exact else f"68 % interval {friction.low:.3f} to {friction.high:.3f}"
        facts.append(f"μ {friction.mu:.3f} ({interval}): {friction.method}")
        facts.append("no slip found" if basis.slip_s is None else f"slips at {basis.slip_s:.3f} s, clock of the forces")
        if lag is None or lag.doubt:
            facts.append(f"lag unknown: {lag.doubt}" if lag else "lag not estimated")
        else:
            late, applied = f"{1000 * lag.lag_s:.1f} ± {1000 * lag.sigma_s:.1f} ms", "" if basis.lag_applied else "not "
            how = "given by hand" if lag.correlation is None else f"correlation {lag.correlation:.2f}"
            facts.append(f"camera late by {late}, {applied}taken off ({how})")
    return [*facts, *labelling.notes]


def _draw_line(
    recording: Recording, values: Float[np.ndarray, " frames"], colour: str, label: str, *, ax: Axes, style: str = "-"
) -> None:
    """Draw values over time: thin where frames are many, with dots where one alone draws no line."""
    width, marker = 1.5 if len(recording) <= 1000 else 0.7, "." if len(recording) <= 60 else ""
    ax.plot(recording.time_s, values, style, color=colour, label=label, linewidth=width, marker=marker)


def _write_over(ax: Axes, words: str) -> None:
    ax.text(0.5, 0.5, words, transform=ax.transAxes, ha="center", va="center", color=GREY)


def _plot_forces(recording: Recording, basis: LabelBasis | None, *, ax: Axes) -> None:
    _draw_line(recording, recording.normal_force_n, BLUE, "$F_n$", ax=ax)
    _draw_line(recording, recording.tangential_force_n, VERMILLION, "$F_t$", ax=ax, style="--")
    if basis is not None:
        contact = f"contact from {basis.contact_threshold_n:.3g} N"
        ax.axhline(basis.contact_threshold_n, color=BLACK, ls=":", lw=1.3, label=contact)
    ax.set(ylabel="Force (N)", xmargin=0)
    if not np.isfinite(recording.normal_force_n).any():
        _write_over(ax, "no forces were recorded")


def _plot_ratio(recording: Recording, friction: FrictionEstimate | None, *, ax: Axes) -> None:
    """Draw F_t / F_n where something touches and presses, and the static friction with its interval."""
    normal, mu, high = recording.normal_force_n, 0.0, 0.0
    touches = (normal > 0) & np.array([state != ContactState.NO_CONTACT for state in recording.contact_state])
    ratio = np.divide(recording.tangential_force_n, normal, where=touches, out=np.full(len(recording), np.nan))
    _draw_line(recording, ratio, BLUE, "$F_t/F_n$ in contact", ax=ax)
    if friction is not None:
        mu, high = friction.mu, friction.high
        ax.axhspan(friction.low, high, color=GREEN, alpha=0.35, lw=0, label="its 68 % interval")
        ax.axhline(mu, color=GREEN, lw=1.1, label=f"$\\mu_s$ = {mu:.3g}")
    # under a light touch the ratio is arbitrary: it does not set the scale
    largest, most = float(np.max(ratio, where=np.isfinite(ratio), initial=0)), max(2.5 * mu, high) or 2.0
    ax.set(ylabel="$F_t/F_n$", xmargin=0, ylim=(0, 1.12 * max(high, min(largest, most)) or 1.0))
    if not np.isfinite(ratio).any():
        _write_over(ax, "the ratio is not known")


def _plot_labels(recording: Recording, *, ax: Axes) -> None:
    """Draw the safety margin with its uncertainty on the colours of the states, and mark frames without a label."""
    plot_margin(recording, ax=ax)
    time_s, valid, margin = recording.time_s, recording.labelled, 100 * recording.safety_margin
    ax.lines[0].set(color=GREY, linestyle=":", linewidth=1.3)  # margins that are no labels
    if (sigma := recording.safety_margin_sigma) is not None:
        ends = margin - 100 * sigma, margin + 100 * sigma
        ax.fill_between(time_s, *ends, where=valid, color=PURPLE, alpha=0.75, lw=0, label=r"Γ $\pm\,\sigma$")
    _draw_line(recording, np.where(valid, margin, np.nan), BLACK, "Γ", ax=ax)
    ax.plot(time_s, np.where(valid, np.nan, -9), color=GREY, lw=4, solid_capstyle="butt", label="no valid label")
    ax.set(xlabel="", ylim=(-14, 107))


def draw_audit(recording: Recording, labelling: Labelling, *, read_frames: ReadFrames | None = None) -> Figure:
    """Draw a page from which to judge the labels of an imported trial."""
    frames = [labelling.reference.index, *spread_audit_frames(recording)]
    with drawing_style():
        figure = Figure(figsize=(12.0, 9.0))
        _draw_charts(figure, recording, labelling, [at for at in frames if at is not None])
        _draw_pictures(figure, recording, frames, read_frames or recording.frames.__getitem__)
        _write_facts(figure, recording, labelling)
    return figure


def write_audits(data: Dataset, folder: Path, *, on_progress: OnProgress | None = None) -> int:
    """Draw the audit of every trial, `TRIAL.png`, unless a newer page is there; returns the number of new pages."""
    drawn = 0
    with reporting(on_progress), open_stage("Drawing pages"):
        for info in report_each(data.trials):
            path, page = trial_path(data.folder, info.trial), folder / f"{info.trial}.png"
            if not page.is_file() or page.stat().st_mtime_ns < path.stat().st_mtime_ns:
                # without pixels but those on the page: a long trial needs little memory
                recording = load_recording(path, pixels=False)
                if recording.labelling is None:
                    raise InputError(
                        f"{info.trial} of {data.folder} was not imported, so the origin of its labels is unknown; "
                        "label it into a new folder with --output"
                    )
                save_page(draw_audit(recording, recording.labelling, read_frames=partial(read_frames, path)), page)
                drawn += 1
    return drawn


def spread_audit_frames(recording: Recording) -> list[int]:
    """Choose the frames nearest to Γ = 100, 80, ... 0 %, in the order of time; evenly spread without margins."""
    if not np.isfinite(recording.safety_margin).any():
        return np.unique(np.linspace(0, len(recording) - 1, _FRAMES).round().astype(int)).tolist()
    return sorted({at for at in choose_margins(recording) if at is not None})


def _draw_charts(figure: Figure, recording: Recording, labelling: Labelling, frames: list[int]) -> None:
    basis, lag = labelling.basis, labelling.basis and labelling.basis.lag
    charts = figure.subplots(
        3, 1, sharex=True, gridspec_kw={"left": 0.36, "right": 0.985, "top": 0.89, "bottom": 0.43, "hspace": 0.2}
    )
    _plot_forces(recording, basis, ax=charts[0])
    _plot_ratio(recording, basis and basis.friction, ax=charts[1])
    _plot_labels(recording, ax=charts[2])
    states = [Patch(lw=0, label=each, color=STATE_COLOURS[each], alpha=STATE_TINTS[each]) for each in _NAMED]
    for ax in charts:
        once = "" if ax is charts[1] else "_"  # equal entries are written once
        if basis is not None and basis.slip_s is not None:
            shift = lag.lag_s if lag and basis.lag_applied else 0.0
            for number, at_s in enumerate([basis.slip_s, *basis.friction.later_onsets_s]):
                label = "_later" if number else f"{once}slip at {at_s + shift:.2f} s"
                ax.axvline(at_s + shift, color=BLACK, ls="-.", lw=1.3, label=label)
            if lag is not None and not lag.doubt:
                ends_s = basis.slip_s + lag.lag_s + np.array([-1, 1]) * lag.sigma_s
                label = rf"{once}as the camera sees it (lag $\pm\,\sigma$)"
                ax.axvspan(*ends_s, color=SKY, alpha=0.6, lw=0, zorder=0, label=label)
        handles = [*ax.get_legend_handles_labels()[0], *(states if ax is charts[2] else [])]
        for at in frames:
            ax.axvline(recording.time_s[at], color=BLACK, lw=0.7, alpha=0.45, zorder=1, label="_frame")
        place = {"loc": "lower left", "bbox_to_anchor": (0, 1), "borderaxespad": 0.1, "borderpad": 0}
        ax.legend(handles=handles, ncols=9, columnspacing=1.1, handlelength=1.9, fontsize=8, **place)
        ax.tick_params(labelsize=8.5)
        ax.xaxis.set_major_formatter("{x:g} s")


def _draw_pictures(figure: Figure, recording: Recording, frames: list[int | None], read: ReadFrames) -> None:
    index, *along = frames
    reference, states = recording.reference, recording.contact_state
    free = [at for at, state in enumerate(states) if state == ContactState.NO_CONTACT]
    # the difference of the reference from itself is 0; that of an untouched frame far from it shows the drift
    far = max(free, key=lambda at: abs(at - (index or 0)), default=index)
    images = read([at for at in (*along, far) if at is not None])
    pictures = [reference, *images[: len(along)]]
    differences = absolute_difference(np.stack([reference if far is None else images[-1], *pictures[1:]]), reference)
    factor = brightening([differences])
    grid = figure.add_gridspec(2, 1 + _FRAMES, left=0.31, right=0.985, top=0.325, bottom=0.06, wspace=0.05, hspace=0.05)
    for column, (at, *row) in enumerate(zip(frames, pictures, brighten(differences, factor), strict=True)):
        state = ContactState.NO_CONTACT if at is None else states[at]
        for line, picture in enumerate(row):
            ax = figure.add_subplot(grid[line, column], xticks=[], yticks=[])
            ax.imshow(picture)
            ax.spines[:].set(visible=True, color=STATE_COLOURS[state], linewidth=2)
            if not line:
                words = _frame_words(recording, at, reference=not column)
                ax.set_title(words, fontsize=7.5, loc="center", fontweight="normal")
    words = f"Differences are $|T_n - T_0|$, brightened {TIMES} {factor:g}"
    if free and far is not None:
        words += f"; beneath the reference that of the untouched frame at {recording.time_s[far]:.2f} s: should be dark"
    figure.text(0.31, 0.03, words, fontsize=8, color=GREY)


def _frame_words(recording: Recording, at: int | None, *, reference: bool) -> str:
    if reference or at is None:
        return f"reference\n{'recorded apart' if at is None else f'frame {at}'}\n"
    margin, sigma = recording.safety_margin[at], recording.safety_margin_sigma
    band = "" if sigma is None or np.isnan(sigma[at]) else f" ± {100 * sigma[at]:.1f}"
    title = f"Γ {100 * margin:.0f}{band} %" if np.isfinite(margin) else "no Γ"
    valid = "" if recording.labelled[at] else ", not valid"
    return f"{title}\n{recording.time_s[at]:.2f} s{valid}\n{recording.contact_state[at]}"


def _write_facts(figure: Figure, recording: Recording, labelling: Labelling) -> None:
    where = f"{recording.sensor}, day {recording.day}, {recording.condition}"
    flags = labelling.basis.flags if labelling.basis else ()
    lines = {VERMILLION: [*(f"▲ {text}" for text in flags), ""], BLACK: [where, *describe_labels(recording, labelling)]}
    figure.text(0.02, 0.95, recording.trial[:75], fontsize=14, fontweight="bold", parse_math=False)
    room, top = _MOST_LINES, 0.9
    for colour, sentences in lines.items():
        text = [line for sentence in sentences for line in wrap(sentence, _WRAP) or [""]]
        text = text if len(text) <= room else [*text[: room - 1], "…"]
        plain = {"va": "top", "linespacing": 1.3, "parse_math": False}
        figure.text(0.02, top, "\n".join(text), fontsize=8, color=colour, **plain)
        room, top = max(1, room - len(text)), top - len(text) * _LINE
