"""Audit of an imported trial: one page with its labels and the estimates behind them."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from textwrap import wrap
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sliplens.errors import InputError
from sliplens.images import absolute_difference
from sliplens.plots.contact_sheet import (
    STATE_COLOURS,
    TIMES,
    brighten,
    brightening,
    choose_margins,
    plot_margin,
    state_patches,
)
from sliplens.plots.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    PURPLE,
    SKY,
    VERMILLION,
    decimals,
    drawing_style,
    place_axes,
    place_text,
    save_page,
    signed,
    write_over,
)
from sliplens.progress import OnProgress, number_of, open_stage, report_each, reporting
from sliplens.recordings import ContactState, Dataset, Recording
from sliplens.recordings.dataset import trial_path
from sliplens.recordings.labelling import Found, FrictionEstimate, Labelling, Lag, Reason
from sliplens.recordings.store import load_recording, read_frames, read_header

_LOOSE = 10.0  # percentage points: beyond, margins 20 points apart are hard to tell apart
_IMAGE_SIGMAS = 5.0  # an image that moves less at the onset does not confirm a slip


class Fact(NamedTuple):
    """A paragraph beside the charts."""

    head: str
    words: list[str]
    doubts: tuple[str, ...] = ()
    """Reasons why a label may be wrong."""
    indent: str = ""

    @property
    def lines(self) -> list[str]:
        """Return words and doubts, in the order of the page."""
        return [*self.words, *self.doubts]


def audit_facts(recording: Recording, labelling: Labelling) -> list[Fact]:
    """Describe the declared, estimated and assumed settings behind the labels, and the doubts about them."""
    basis, reference, counts = labelling.basis, labelling.reference, recording.count()
    valid, frames = counts.pop("valid", 0), len(recording)
    words, doubts = [", ".join(f"{count} {reason}" for reason, count in counts.items())], []
    sigma = 100 * np.array([0.0] if recording.safety_margin_sigma is None else recording.safety_margin_sigma)
    if np.nanmax(sigma, initial=0) > 0:
        words.append(f"Γ known to ± {np.nanmedian(sigma):.1f} % (median), {np.nanmax(sigma):.1f} % at worst")
        if np.nanmedian(sigma) > _LOOSE:
            doubts.append(f"beyond ± {_LOOSE:g} %, margins that are far apart look alike")
    lost = sum(counts.values()) - sum(counts.get(reason, 0) for reason in (Reason.NO_CONTACT, Reason.AFTER_GROSS_SLIP))
    if basis is not None and lost:
        doubts.append(f"{number_of(lost, 'frame')} in contact, before a slip, without a valid label")
    facts = [Fact(f"Frames: {valid} of {frames} valid", words, tuple(doubts))]
    chosen = [reference.method if reference.index is None else f"frame {reference.index}, {reference.method}"]
    if reference.contact_energy is not None:
        chosen.append(f"contact energy {reference.contact_energy:.2f} grey levels")
    if basis is None:
        came, none = ["They came with the recording."], ("No frame has one.",)
        facts.append(Fact("Labels", came) if valid else Fact("Labels", [], none))
    else:
        axes = basis.axes
        if basis.flags:
            facts.append(Fact("Flags", [], tuple(f"• {flag}" for flag in basis.flags), indent="   "))
        turned = f", turned by {axes.tilt_deg:.1f} degrees" if axes.direction else ""
        origins = f"(axis {_origin(axes.normal_found)}, sign {_origin(axes.sign_found)})"
        sign = "+" if axes.sign > 0 else "\N{MINUS SIGN}"
        unsure = ("see the flags",) if any("axis" in note for note in axes.notes) else ()
        tare = [
            f"x, y, z: {_three(axes.tare_n, signed)} N",
            f"± {_three(axes.tare_sigma_n)} N",
            f"noise of a sample {_three(axes.noise_n)} N",
            f"untouched until {decimals(axes.still_until_s, 2)} s",
        ]
        assumed = ("no untouched sample shows it",) if axes.tare_found is Found.ASSUMED else ()
        forces = [
            f"contact from {basis.contact_threshold_n:.3f} N",
            f"means over {_milli(basis.window_s)} ms; gaps over {_milli(basis.gap_s)} ms count as missing",
        ]
        facts += [
            Fact("Axes", [f"normal force is {sign}{axes.normal}{turned} {origins}"], unsure),
            Fact(f"Tare {_origin(axes.tare_found)}", tare, assumed),
            _describe_friction(basis.friction, basis.slip_s),
            _describe_lag(recording, basis.lag, applied=basis.lag_applied),
            Fact("Forces", forces),
        ]
    facts.append(Fact("Reference", chosen))
    if labelling.notes:
        facts.append(Fact("Notes", [f"• {note}" for note in labelling.notes], indent="   "))
    return facts


def _describe_friction(friction: FrictionEstimate, slip_s: float | None) -> Fact:
    exact, moved = friction.low == friction.high, friction.image_sigmas
    interval = "taken as exact" if exact else f"68 % interval {friction.low:.3f} to {friction.high:.3f}"
    words = [f"μ {friction.mu:.3f}, {interval}", friction.method]
    if moved is not None:
        words.append(f"image moves {moved:.1f} σ more at the slip")  # noqa: RUF001 (sigma is meant)
    later = "".join(f", and again at {later_s:.3f} s" for later_s in friction.later_onsets_s)
    words.append("no slip found" if slip_s is None else f"slips at {slip_s:.3f} s{later} on the clock of the forces")
    doubts = ["its uncertainty is unknown, and no label counts it"] if exact else []
    if friction.found is Found.INFERRED and (moved or 0) < _IMAGE_SIGMAS:
        doubts.append("forces alone show the slip: the image hardly moves at it")
    if friction.notes:
        doubts.append("see the flags")
    return Fact(f"Friction {_origin(friction.found)}", words, tuple(doubts))


def _describe_lag(recording: Recording, lag: Lag | None, *, applied: bool) -> Fact:
    head = f"Lag {'applied' if applied else 'not applied'}"
    if lag is None or lag.doubt:
        return Fact(head, [], (f"unknown: {lag.doubt}" if lag else "not estimated",))
    words = [f"camera late by {_milli(lag.lag_s)} ± {_milli(lag.sigma_s)} ms"]
    words.append(f"correlation {decimals(lag.correlation, 2)}")
    # significant, and half a frame or more: the labels are those of another frame
    ignored = not applied and abs(lag.lag_s) > max(2 * lag.sigma_s, np.ptp(recording.time_s) / (2 * len(recording)))
    return Fact(head, words, ("it is not taken off: labels may be those of the frame beside",) if ignored else ())


def _origin(origin: Found) -> str:
    return "found" if origin is Found.INFERRED else str(origin)


def _milli(value: float) -> str:
    return decimals(1000 * value, 1)


def _three(values: Sequence[float], write: Callable[..., str] = decimals) -> str:
    return ", ".join(write(value, 3) for value in values)


def force_ratio(recording: Recording) -> Float[np.ndarray, " frames"]:
    """Compute F_t / F_n where something touches and presses; NaN elsewhere."""
    normal = recording.normal_force_n
    touches = (normal > 0) & np.array([state != ContactState.NO_CONTACT for state in recording.contact_state])
    return np.divide(recording.tangential_force_n, normal, where=touches, out=np.full(len(recording), np.nan))


def end_of_ratio(ratio: Float[np.ndarray, " frames"], mu: float, *, above: float = 0.0) -> float:
    """Choose the upper end of a chart of F_t / F_n: a little above ratio, friction and the value `above`."""
    least, largest = max(mu, above), float(np.max(ratio, where=np.isfinite(ratio), initial=0))
    highest = max(2.5 * mu, least) if mu else 2.0  # under a light touch the ratio is arbitrary
    return 1.12 * max(least, min(largest, highest)) or 1.0


def plot_contact_forces(recording: Recording, threshold_n: float | None, *, ax: Axes) -> None:
    """Draw F_n and F_t over time, in newtons, and the least F_n of a contact."""
    _draw_line(recording, recording.normal_force_n, BLUE, "$F_n$", ax=ax)
    _draw_line(recording, recording.tangential_force_n, VERMILLION, "$F_t$", ax=ax, style="--")
    if threshold_n is not None:
        ax.axhline(threshold_n, color=BLACK, ls=":", lw=1.3, label=f"contact from {threshold_n:.3g} N")
    ax.set(ylabel="Force (N)", xmargin=0)
    if not np.isfinite(recording.normal_force_n).any():
        write_over(ax, "no forces were recorded")


def plot_force_ratio(recording: Recording, friction: FrictionEstimate | None, *, ax: Axes) -> None:
    """Draw F_t / F_n of the frames in contact, and the static friction with its interval."""
    ratio, mu, high = force_ratio(recording), 0.0, 0.0
    _draw_line(recording, ratio, BLUE, "$F_t/F_n$ in contact", ax=ax)
    if friction is not None:
        mu, high = friction.mu, friction.high
        ax.axhspan(friction.low, high, color=GREEN, alpha=0.35, lw=0, label="its 68 % interval")
        ax.axhline(mu, color=GREEN, lw=1.1, label=f"$\\mu_s$ = {mu:.3g}")
    ax.set(ylabel="$F_t/F_n$", xmargin=0, ylim=(0, end_of_ratio(ratio, mu, above=high)))
    if not np.isfinite(ratio).any():
        write_over(ax, "F_t / F_n is not known", parse_math=False)


def plot_labels(recording: Recording, *, ax: Axes) -> None:
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


def _draw_line(
    recording: Recording, values: Float[np.ndarray, " frames"], colour: str, label: str, *, ax: Axes, style: str = "-"
) -> None:
    """Draw values over time: thin where frames are many, with dots where one alone draws no line."""
    width, marker = 1.5 if len(recording) <= 1000 else 0.7, "." if len(recording) <= 60 else ""
    ax.plot(recording.time_s, values, style, color=colour, label=label, linewidth=width, marker=marker)


_FRAMES = 6  # beside the reference
# inches: facts at the left, charts above pictures at the right
_WIDTH, _HEIGHT, _EDGE, _LEFT, _GAP, _TOP, _FOOT = 12.0, 9.0, 0.2, 3.75, 0.07, 0.78, 0.36
_CHART, _LEGEND, _TICKS, _HEAD = 1.27, 0.25, 0.3, 0.52
_PICTURE = (_WIDTH - _LEFT - _EDGE + _GAP) / (1 + _FRAMES) - _GAP
_LINE, _WRAP = 0.145, 43  # height of a line of facts, and its characters

ReadFrames = Callable[[Sequence[int]], UInt8[np.ndarray, "frames height width 3"]]
"""Reads the frames of some numbers, in their order."""


def draw_audit(recording: Recording, labelling: Labelling, *, read_frames: ReadFrames | None = None) -> Figure:
    """Draw a page from which to judge the labels of an imported trial."""
    frames = [labelling.reference.index, *spread_audit_frames(recording)]
    with drawing_style():
        figure = Figure(figsize=(_WIDTH, _HEIGHT))
        _draw_charts(figure, recording, labelling, [at for at in frames if at is not None])
        _draw_pictures(figure, recording, frames, read_frames or recording.frames.__getitem__)
        _write_facts(figure, recording, labelling)
    return figure


def write_audits(data: Dataset, folder: Path, *, on_progress: OnProgress | None = None) -> int:
    """Draw the audit of every trial, `TRIAL.png`, unless a newer page is there; returns the number of new pages."""
    for info in data.trials:
        if read_header(trial_path(data.folder, info.trial)).labelling is None:
            raise InputError(
                f"{info.trial} of {data.folder} was not imported, so the origin of its labels is unknown; "
                "label it into a new folder with --output"
            )
    drawn = 0
    folder.mkdir(parents=True, exist_ok=True)
    with reporting(on_progress), open_stage("Drawing pages"):
        for info in report_each(data.trials):
            path, page = trial_path(data.folder, info.trial), folder / f"{info.trial}.png"
            if not page.is_file() or page.stat().st_mtime_ns < path.stat().st_mtime_ns:
                # without pixels but those on the page: a long trial needs little memory
                recording = load_recording(path, pixels=False)
                assert recording.labelling is not None
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
    tops = [_TOP + _LEGEND + row * (_CHART + _LEGEND) for row in range(3)]
    charts = [place_axes(figure, _LEFT, top, _WIDTH - _LEFT - _EDGE, _CHART) for top in tops]
    plot_contact_forces(recording, basis and basis.contact_threshold_n, ax=charts[0])
    plot_force_ratio(recording, basis and basis.friction, ax=charts[1])
    plot_labels(recording, ax=charts[2])
    for ax in charts:
        handles = [*ax.get_legend_handles_labels()[0], *(state_patches() if ax is charts[2] else [])]
        if basis is not None and basis.slip_s is not None:
            shift = lag.lag_s if lag and basis.lag_applied else 0.0
            slips_s = [basis.slip_s, *basis.friction.later_onsets_s]
            lines = [ax.axvline(at_s + shift, color=BLACK, ls="-.", lw=1.3, label="_slip") for at_s in slips_s]
            lines[0].set_label(f"slip at {slips_s[0] + shift:.2f} s")
            entries: list[Artist] = [*lines[:1]]
            if lag is not None and not lag.doubt:
                ends_s = basis.slip_s + lag.lag_s + np.array([-1, 1]) * lag.sigma_s
                entries.append(ax.axvspan(*ends_s, color=SKY, alpha=0.6, lw=0, zorder=0))
                entries[-1].set_label(r"as the camera sees it (lag $\pm\,\sigma$)")
            handles += entries if ax is charts[1] else []  # equal entries are written once
        for at in frames:
            ax.axvline(recording.time_s[at], color=BLACK, lw=0.7, alpha=0.45, zorder=1, label="_frame")
        place = {"loc": "lower left", "bbox_to_anchor": (0, 1), "borderaxespad": 0.1, "borderpad": 0}
        ax.legend(handles=handles, ncols=9, columnspacing=1.1, handlelength=1.9, fontsize=8.5, **place)
        ax.tick_params(labelbottom=ax is charts[-1], labelsize=8.5)
        ax.xaxis.set_major_formatter("{x:g} s")
        ax.yaxis.set_label_coords(-0.058, 0.5)
        ax.sharex(charts[0])


def _draw_pictures(figure: Figure, recording: Recording, frames: list[int | None], read: ReadFrames) -> None:
    index, *along = frames
    reference, time_s, states = recording.reference, recording.time_s, recording.contact_state
    height = float(np.clip(_PICTURE * reference.shape[0] / reference.shape[1], 0.6, 1.2))
    top = _TOP + 3 * (_CHART + _LEGEND) + _TICKS + _HEAD
    free = [at for at, state in enumerate(states) if state == ContactState.NO_CONTACT]
    # the difference of the reference from itself is 0; that of an untouched frame far from it shows the drift
    far = max(free, key=lambda at: abs(at - (index or 0)), default=index)
    images = read([at for at in (*along, far) if at is not None])
    pictures = [reference, *images[: len(along)]]
    differences = absolute_difference(np.stack([reference if far is None else images[-1], *pictures[1:]]), reference)
    factor = brightening([differences])
    for column, (at, frame, difference) in enumerate(zip(frames, pictures, differences, strict=True)):
        x, state = _LEFT + column * (_PICTURE + _GAP), ContactState.NO_CONTACT if at is None else states[at]
        for y, picture in ((top, frame), (top + height + _GAP, brighten(difference, factor))):
            ax = place_axes(figure, x, y, _PICTURE, height)
            ax.imshow(picture)
            ax.set(xticks=[], yticks=[])
            ax.spines[:].set(visible=True, color=STATE_COLOURS[state], linewidth=2)
        title, when, how = "reference", "recorded apart" if at is None else f"{time_s[at]:.2f} s", str(state)
        if column and at is not None:
            margin, sigma = recording.safety_margin[at], recording.safety_margin_sigma
            band = "" if sigma is None or np.isnan(sigma[at]) else f" ± {100 * sigma[at]:.1f}"
            title = f"Γ {100 * margin:.0f}{band} %" if np.isfinite(margin) else "no Γ"
            how += "" if recording.labelled[at] else ", not valid"
        for text, up, weight in ((title, 0.37, "bold"), (when, 0.21, "normal"), (how, 0.06, "normal")):
            place_text(figure, x + _PICTURE / 2, top - up, text, ha="center", va="bottom", fontsize=8, weight=weight)
    words = f"Differences are $|T_n - T_0|$, brightened {TIMES} {factor:g}"
    if free and far is not None:
        words += f"; beneath the reference that of the untouched frame at {time_s[far]:.2f} s: it should be dark"
    place_text(figure, _LEFT, top + 2 * (height + _GAP), words, fontsize=8, color=GREY)


def _write_facts(figure: Figure, recording: Recording, labelling: Labelling) -> None:
    # a dollar sign in a name begins no formula
    plain = {"parse_math": False}
    place_text(figure, _EDGE, 0.17, _cut(recording.trial, 75), fontsize=14, fontweight="bold", **plain)
    about = f"{_cut(recording.sensor, 30)}, day {recording.day}, {_cut(recording.condition, 20)}"
    sources = [_cut(words, 50) for words in (labelling.source, labelling.forces) if words]
    place_text(figure, _EDGE, 0.47, "   ·   ".join([about, *sources]), fontsize=9, color=GREY, **plain)
    top, facts = _TOP + 0.05, audit_facts(recording, labelling)
    if any(fact.doubts for fact in facts):
        place_text(figure, _EDGE, _HEIGHT - _FOOT + 0.08, "▲ may put the labels in doubt", fontsize=8, color=VERMILLION)
    for fact in facts:
        lines = [line for words in fact.lines for line in wrap(words, _WRAP, subsequent_indent=fact.indent)]
        room = max(1, int((_HEIGHT - _FOOT - top) / _LINE - 1.15))
        lines = lines if len(lines) <= room else [*lines[: room - 1], "…"]
        colour, mark = (VERMILLION, "▲ ") if fact.doubts else (BLACK, "")
        place_text(figure, _EDGE, top, mark + fact.head, fontsize=9, fontweight="bold", color=colour)
        place_text(figure, _EDGE, top + 1.15 * _LINE, "\n".join(lines), fontsize=8, linespacing=1.25, **plain)
        top += (len(lines) + 1.8) * _LINE


def _cut(words: str, most: int) -> str:
    """Leave out the middle of a text that is too long: the end of a path or of a numbered name matters most."""
    return words if len(words) <= most else f"{words[: most // 3]}…{words[most // 3 + 1 - most :]}"
