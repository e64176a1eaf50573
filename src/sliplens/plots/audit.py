"""Audit of an imported trial: one page with its labels and the estimates behind them."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from textwrap import wrap
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from sliplens.errors import InputError
from sliplens.images import absolute_difference
from sliplens.plots.contact_sheet import (
    NAMED_STATES,
    STATE_COLOURS,
    STATE_TINTS,
    TIMES,
    brighten,
    brightening,
    choose_margins,
    plot_margin,
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
from sliplens.recordings.labelling import Found, FrictionEstimate, Labelling, Lag
from sliplens.recordings.store import load_recording, read_frames, read_header

_MINUS = "\N{MINUS SIGN}"
_LOOSE = 10.0  # percentage points: beyond, margins 20 points apart are hard to tell apart
_IMAGE_SIGMAS = 5.0  # an image that moves less at the onset does not confirm a slip
_SEE_FLAGS = "in doubt: see the flags"
_NO_TARE = "no untouched sample shows it"


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
    basis, reference = labelling.basis, labelling.reference
    if basis is None:
        return _describe_imported(recording, labelling)
    axes, limit, notes = basis.axes, basis.force_range_n, labelling.notes
    pressing = f"normal force is {'+' if axes.sign > 0 else _MINUS}{axes.normal}"
    turned = f", turned by {axes.tilt_deg:.1f} degrees" if axes.direction else ""
    mounting = f"{pressing}{turned} (axis {_origin(axes.normal_found)}, sign {_origin(axes.sign_found)})"
    still = f"untouched until {decimals(axes.still_until_s, 2)} s"
    noise = [f"± {_three(axes.tare_sigma_n)} N", f"noise of a sample {_three(axes.noise_n)} N"]
    tare = [f"x, y, z: {_three(axes.tare_n, signed)} N", *noise, still]
    energy, drift = decimals(reference.contact_energy, 2), decimals(reference.drift, 2)
    means = f"means over {_milli(basis.window_s)} ms; gaps over {_milli(basis.gap_s)} ms count as missing"
    span = "range of the sensor unknown" if limit is None else f"range of the sensor ± {limit:g} N"
    chosen = [f"frame {reference.index}, {reference.method}", f"contact energy {energy}, drift {drift} grey levels"]
    chosen = [reference.method] if reference.index is None else chosen
    return [
        _describe_frames(recording),
        *([Fact("Flags", [], tuple(f"• {flag}" for flag in basis.flags), indent="   ")] if basis.flags else []),
        Fact("Axes", [mounting], (_SEE_FLAGS,) if any("axis" in note for note in axes.notes) else ()),
        Fact(f"Tare {_origin(axes.tare_found)}", tare, (_NO_TARE,) if axes.tare_found == Found.ASSUMED else ()),
        _describe_friction(basis.friction, basis.slip_s),
        _describe_lag(recording, basis.lag, applied=basis.lag_applied),
        Fact("Forces", [f"contact from {decimals(basis.contact_threshold_n, 3)} N", means, span]),
        Fact("Reference", chosen),
        *([Fact("Notes", [f"• {note}" for note in notes], indent="   ")] if notes else []),
    ]


def _describe_imported(recording: Recording, labelling: Labelling) -> list[Fact]:
    """Describe labels that came with the recording and were not made from forces."""
    index, clip = labelling.reference.index, asdict(labelling.clip) if labelling.clip else {}
    which = "recorded apart from the frames" if index is None else f"frame {index}"
    labelled = bool(recording.labelled.any())
    words = ["They came with the recording; nothing was found from forces."] if labelled else ["No frame has one."]
    facts = [
        f"{name.replace('_', ' ')}: {('no', 'yes')[value] if isinstance(value, bool) else value}"
        for name, value in clip.items()
    ]
    notes = [f"• {note}" for note in labelling.notes]
    counts = recording.count()
    lost = [", ".join(f"{count} {reason}" for reason, count in counts.items() if reason != "valid")]
    return [
        Fact(f"Frames: {counts.get('valid', 0)} of {sum(counts.values())} valid", lost),
        Fact("Labels", words if labelled else [], () if labelled else tuple(words)),
        *([Fact("Known of the whole clip", facts)] if facts else []),
        Fact("Reference", [which]),
        *([Fact("Notes", notes, indent="   ")] if notes else []),
    ]


def _describe_frames(recording: Recording) -> Fact:
    """Count the frames with a valid label, and the others by the reason."""
    states, sigma = np.array([str(state) for state in recording.contact_state]), recording.safety_margin_sigma
    lacking = {
        "missing samples": np.isnan(recording.normal_force_n),
        "no contact": states == ContactState.NO_CONTACT,
        "after gross slip": states == ContactState.FULL_SLIP,
        "outside the sensor's range": np.isnan(recording.safety_margin),
    }
    kinds = np.select([recording.labelled, *lacking.values()], range(5), default=5)
    counts = dict(zip(("valid", *lacking, "not valid"), np.bincount(kinds, minlength=6).tolist(), strict=True))
    if recording.reason is not None:
        counts = {"valid": 0, **recording.count()}
    words = [", ".join(f"{count} {name}" for name, count in counts.items() if count and name != "valid")]
    middle = most = 0.0
    if sigma is not None and np.isfinite(sigma).any():
        middle, most = 100 * float(np.nanmedian(sigma)), 100 * float(np.nanmax(sigma))
        words.append(f"Γ known to ± {middle:.1f} % (median), {most:.1f} % at worst")
    lost = len(states) - sum(counts.get(name, 0) for name in ("valid", "no contact", "after gross slip"))
    doubts = [f"{number_of(lost, 'frame')} in contact, before a slip, without a valid label"] if lost else []
    doubts += [f"beyond ± {_LOOSE:g} %, margins that are far apart look alike"] if middle > _LOOSE else []
    return Fact(f"Frames: {counts['valid']} of {len(states)} valid", words, tuple(doubts))


def _describe_friction(friction: FrictionEstimate, slip_s: float | None) -> Fact:
    exact, moved = friction.low == friction.high, friction.image_sigmas
    ends = f"{decimals(friction.low, 3)} to {decimals(friction.high, 3)}"
    interval = "taken as exact" if exact else f"68 % interval {ends}"
    image = [] if moved is None else [f"image moves {moved:.1f} σ more at the slip"]  # noqa: RUF001 (sigma is meant)
    later = "".join(f", and again at {later_s:.3f} s" for later_s in friction.later_onsets_s)
    slip = "no slip found" if slip_s is None else f"slips at {slip_s:.3f} s{later} on the clock of the forces"
    doubts = ["its uncertainty is unknown, and no label counts it"] if exact else []
    if friction.found == Found.INFERRED and (moved is None or moved < _IMAGE_SIGMAS):
        doubts.append("forces alone show the slip: the image hardly moves at it")
    words = [f"μ {decimals(friction.mu, 3)}, {interval}", friction.method, *image, slip]
    return Fact(f"Friction {_origin(friction.found)}", words, (*doubts, *([_SEE_FLAGS] if friction.notes else [])))


def _describe_lag(recording: Recording, lag: Lag | None, *, applied: bool) -> Fact:
    head = f"Lag {'applied' if applied else 'not applied'}"
    if lag is None or lag.doubt:
        return Fact(head, [], (f"unknown: {lag.doubt}" if lag else "not estimated",))
    late = f"camera late by {_milli(lag.lag_s)} ± {_milli(lag.sigma_s)} ms"
    # significant, and half a frame or more: the labels are those of another frame
    least = max(2 * lag.sigma_s, np.ptp(recording.time_s) / (2 * len(recording)))
    ignored = not applied and abs(lag.lag_s) > least
    doubts = ("it is not taken off: labels may be those of the frame beside",) if ignored else ()
    return Fact(head, [late, f"correlation {decimals(lag.correlation, 2)}"], doubts)


def _origin(origin: Found) -> str:
    return "found" if origin is Found.INFERRED else str(origin)


def _milli(value: float) -> str:
    return decimals(1000 * value, 1).replace("-", _MINUS)


def _three(values: Sequence[float], write: Callable[..., str] = decimals) -> str:
    return ", ".join(write(value, 3) for value in values)


_HIGHEST = 2.5  # times mu_s: under a light touch F_t / F_n is arbitrary
_HIGHEST_UNKNOWN = 2.0  # where mu_s is unknown


def plot_contact_forces(recording: Recording, threshold_n: float | None, *, ax: Axes) -> None:
    """Draw F_n and F_t over time, in newtons, and the least F_n of a contact."""
    forces = {"$F_n$": (recording.normal_force_n, BLUE, "-"), "$F_t$": (recording.tangential_force_n, VERMILLION, "--")}
    for name, (force, colour, line) in forces.items():
        label = name if np.isfinite(force).any() else "_unknown"
        ax.plot(recording.time_s, force, color=colour, linestyle=line, linewidth=_width(recording), label=label)
    if threshold_n is not None:
        label = f"contact from {threshold_n:.3g} N"
        ax.axhline(threshold_n, color=BLACK, linestyle=":", linewidth=1.3, label=label)
    ax.set(ylabel="Force (N)", xmargin=0)
    if not np.isfinite(recording.normal_force_n).any():
        _leave_empty(ax, "no forces were recorded")


def force_ratio(recording: Recording) -> Float[np.ndarray, " frames"]:
    """Compute F_t / F_n where something touches and presses; NaN elsewhere."""
    normal = recording.normal_force_n
    touches = (normal > 0) & np.array([state != ContactState.NO_CONTACT for state in recording.contact_state])
    return np.divide(recording.tangential_force_n, normal, where=touches, out=np.full(len(recording), np.nan))


def end_of_ratio(ratio: Float[np.ndarray, " frames"], mu: float, *, above: float = 0.0) -> float:
    """Choose the upper end of a chart of F_t / F_n: a little above ratio, friction and the value `above`."""
    least, largest = max(mu, above), float(np.max(ratio, where=np.isfinite(ratio), initial=0))
    highest = max(_HIGHEST * mu, least) if mu else _HIGHEST_UNKNOWN
    return 1.12 * max(least, min(largest, highest)) or 1.0


def plot_force_ratio(recording: Recording, friction: FrictionEstimate | None, *, ax: Axes) -> None:
    """Draw F_t / F_n of the frames in contact, and the static friction with its interval."""
    ratio = force_ratio(recording)
    drawn = {"color": BLUE, "linewidth": _width(recording), "marker": _marker(recording)}
    ax.plot(recording.time_s, ratio, label="$F_t/F_n$ in contact" if np.isfinite(ratio).any() else "_", **drawn)
    mu, low, high = (friction.mu, friction.low, friction.high) if friction else (None, None, None)
    touches = np.array([state != ContactState.NO_CONTACT for state in recording.contact_state])
    coefficient = np.where(touches, recording.friction_coefficient, np.nan)
    if friction is None and np.isfinite(coefficient).any():
        ax.plot(recording.time_s, coefficient, color=GREEN, linewidth=1.1, label=r"$\mu$ that came with the frames")
        mu = float(np.nanmax(coefficient))
    if low is not None and high is not None and low < high:
        ax.axhspan(low, high, color=GREEN, alpha=0.35, linewidth=0, label="its 68 % interval")
    if mu is not None and friction is not None:
        ax.axhline(mu, color=GREEN, linewidth=1.1, label=f"$\\mu_s$ = {mu:.3g}")
    ax.set(ylabel="$F_t/F_n$", xmargin=0, ylim=(0, end_of_ratio(ratio, mu or 0.0, above=high or 0.0)))
    if not np.isfinite(ratio).any():
        _leave_empty(ax, "F_t / F_n is not known")


def plot_labels(recording: Recording, *, ax: Axes) -> None:
    """Draw the safety margin with its uncertainty on the colours of the states, and mark frames without a label."""
    plot_margin(recording, ax=ax)
    time_s, valid, margin = recording.time_s, recording.labelled, 100 * recording.safety_margin
    # margins that are no labels are drawn differently
    ax.lines[0].set(color=GREY, linestyle=":", linewidth=1.3)
    sigma = recording.safety_margin_sigma
    if sigma is not None:
        low, high = margin - 100 * sigma, margin + 100 * sigma
        ax.fill_between(time_s, low, high, where=valid, color=PURPLE, alpha=0.75, linewidth=0, label=r"Γ $\pm\,\sigma$")
    labels = np.where(valid, margin, np.nan)
    ax.plot(time_s, labels, color=BLACK, linewidth=_width(recording), marker=_marker(recording), label="Γ")
    ax.plot(time_s, np.where(valid, np.nan, -9), color=GREY, linewidth=4, solid_capstyle="butt", label="no valid label")
    ax.set(xlabel="", ylim=(-14, 107))
    if not np.isfinite(margin).any():
        write_over(ax, "no frame has a label")


def _leave_empty(ax: Axes, words: str) -> None:
    ax.set(yticks=[])
    write_over(ax, words, parse_math=False)


def _width(recording: Recording) -> float:
    """Return a smaller line width for so many frames that noise would fill the chart."""
    return 1.5 if len(recording) <= 1000 else 0.7


def _marker(recording: Recording) -> str:
    """Return dots for so few frames that one alone would draw no line."""
    return "." if len(recording) <= 60 else ""


_SHARES = (0, 1, 0.25, 0.5, 0.75)  # of the way from full stick to the slip; its ends first
_EVEN = 0.05  # margin by which a frame may be off, to spread frames of similar margins over time
_ONSET = "slip", r"as the camera sees it (lag $\pm\,\sigma$)"
# inches; from left to right: facts, then charts above pictures
_WIDTH, _HEIGHT, _EDGE, _LEFT, _GAP = 12.0, 9.0, 0.2, 3.75, 0.07
_SPAN = _WIDTH - _LEFT - _EDGE
_PICTURE = (_SPAN + _GAP) / (1 + len(_SHARES)) - _GAP
# from top to bottom
_TOP, _LEGEND, _TICKS, _LEADER, _HEAD, _FOOT, _PICTURE_HEIGHT = 0.78, 0.25, 0.22, 0.26, 0.52, 0.36, (0.6, 1.36)
_LINE, _WRAP = 0.145, 43  # height of a line of facts, and its characters


ReadFrames = Callable[[Sequence[int]], UInt8[np.ndarray, "frames height width 3"]]
"""Reads the frames of some numbers, in their order."""


def draw_audit(recording: Recording, labelling: Labelling, *, read_frames: ReadFrames | None = None) -> Figure:
    """Draw a page from which to judge the labels of an imported trial."""
    height = float(np.clip(_PICTURE * recording.reference.shape[0] / recording.reference.shape[1], *_PICTURE_HEIGHT))
    top = _HEIGHT - _FOOT - 2 * height - _GAP
    with drawing_style():
        figure = Figure(figsize=(_WIDTH, _HEIGHT))
        charts = _draw_charts(figure, recording, labelling, bottom=top - _HEAD - _LEADER - _TICKS)
        columns = [labelling.reference.index, *choose_along(recording)]
        read = recording.frames.__getitem__ if read_frames is None else read_frames
        _draw_pictures(figure, recording, columns, read, top=top, height=height)
        for column, at in enumerate(columns):
            if at is None:  # the reference was recorded apart from the frames
                continue
            time_s = recording.time_s[at]
            middle = (_LEFT + column * (_PICTURE + _GAP) + _PICTURE / 2) / _WIDTH
            _lead(figure, charts, float(time_s), middle, top=top - _HEAD - _LEADER)
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


def choose_along(recording: Recording) -> list[int]:
    """Choose five frames in the order of time, or all if there are fewer, evenly spaced in their margins."""
    if not np.isfinite(recording.safety_margin).any():
        return np.unique(np.linspace(0, len(recording) - 1, len(_SHARES)).round().astype(int)).tolist()
    margins, margin = choose_margins(recording), np.nan_to_num(recording.safety_margin)
    allowed = recording.labelled.copy()
    places = np.flatnonzero(allowed) if allowed.any() else np.arange(len(recording))
    begin = int(places[0]) if margins[0] is None else margins[0]
    end = int(places[np.argmin(margin[places])]) if margins[-1] is None else margins[-1]
    allowed[[begin, end]] = True
    free, way = np.ones(len(recording), dtype=bool), end - begin
    for share in _SHARES[: len(recording)]:
        wanted = margin[begin] + share * (margin[end] - margin[begin])
        late = np.abs(np.arange(len(recording)) - (begin + share * way)) / max(abs(way), 1)
        cost = np.abs(margin - wanted) + _EVEN * late + np.where(allowed, 0, 1)
        free[np.argmin(np.where(free, cost, np.inf))] = False
    return [int(at) for at in np.flatnonzero(~free)]


def _draw_charts(figure: Figure, recording: Recording, labelling: Labelling, *, bottom: float) -> list[Axes]:
    height = (bottom - _TOP) / 3 - _LEGEND
    tops = [_TOP + row * (height + _LEGEND) + _LEGEND for row in range(3)]
    charts = [place_axes(figure, _LEFT, top, _SPAN, height) for top in tops]
    basis = labelling.basis
    plot_contact_forces(recording, basis and basis.contact_threshold_n, ax=charts[0])
    plot_force_ratio(recording, basis and basis.friction, ax=charts[1])
    plot_labels(recording, ax=charts[2])
    lag = basis.lag if basis else None
    shift = lag.lag_s if basis and lag and basis.lag_applied else 0.0
    shades = [(str(state), STATE_COLOURS[state], STATE_TINTS[state]) for state in NAMED_STATES]
    tints = [Patch(color=colour, alpha=tint, linewidth=0, label=name) for name, colour, tint in shades]
    for ax in charts:
        if basis is not None and basis.slip_s is not None:
            slip_s = basis.slip_s + shift
            ax.axvline(slip_s, color=BLACK, linestyle="-.", linewidth=1.3, label=f"{_ONSET[0]} at {slip_s:.2f} s")
            if lag is not None and not lag.doubt:
                visible_s = basis.slip_s + lag.lag_s + np.array([-1, 1]) * lag.sigma_s
                ax.axvspan(*visible_s, color=SKY, alpha=0.6, linewidth=0, label=_ONSET[1], zorder=0)
            for later_s in basis.friction.later_onsets_s:
                ax.axvline(later_s + shift, color=BLACK, linestyle="-.", linewidth=1.3, label="_slip")
        place = {"loc": "lower left", "bbox_to_anchor": (0, 1), "borderaxespad": 0.1, "borderpad": 0}
        handles, names = ax.get_legend_handles_labels()
        if ax is not charts[1]:  # equal entries are written once
            handles = [line for line, name in zip(handles, names, strict=True) if not name.startswith(_ONSET)]
        handles += tints if ax is charts[2] else []
        ax.legend(
            handles=handles, ncols=9, columnspacing=1.1, handlelength=1.9, handletextpad=0.5, fontsize=8.5, **place
        )
        ax.tick_params(labelbottom=ax is charts[-1], labelsize=8.5)
        ax.xaxis.set_major_formatter("{x:g} s")
        ax.yaxis.set_label_coords(-0.058, 0.5)
        ax.sharex(charts[0])
    return charts


def _lead(figure: Figure, charts: list[Axes], time_s: float, middle: float, *, top: float) -> None:
    """Mark the time of a frame on the charts, and draw a line from there to its picture."""
    for ax in charts:
        ax.axvline(time_s, color=BLACK, linewidth=0.7, alpha=0.45, zorder=1, label="_frame")
    low, high = charts[-1].get_xlim()
    from_x = (_LEFT + _SPAN * (time_s - low) / (high - low)) / _WIDTH
    ends = [1 - top / _HEIGHT, 1 - (top + _LEADER - 0.04) / _HEIGHT]
    figure.add_artist(Line2D([from_x, middle], ends, color=BLACK, linewidth=0.7, alpha=0.45))


def _draw_pictures(
    figure: Figure, recording: Recording, columns: list[int | None], read: ReadFrames, *, top: float, height: float
) -> None:
    index, *along = columns
    reference, second = recording.reference, top + height + _GAP
    free = [at for at, state in enumerate(recording.contact_state) if state == ContactState.NO_CONTACT]
    # the difference of the reference from itself is 0; that of an untouched frame far from it shows the drift
    far = max(free, key=lambda at: abs(at - (index or 0)), default=index)
    images = read([at for at in (*along, far) if at is not None])
    frames = [reference, *images[: len(along)]]
    untouched = reference if far is None else images[-1]
    differences = absolute_difference(np.stack([untouched, *frames[1:]]), reference)
    factor = brightening([differences])
    for text, middle in (("camera", top + height / 2), (f"difference\n{TIMES} {factor:g}", second + height / 2)):
        turned = {"rotation": 90, "ha": "right", "va": "center", "multialignment": "center"}
        place_text(figure, _LEFT - 0.06, middle, text, fontsize=8.5, color=GREY, **turned)
    for column, (at, frame, difference) in enumerate(zip(columns, frames, differences, strict=True)):
        x = _LEFT + column * (_PICTURE + _GAP)
        state = ContactState.NO_CONTACT if at is None else recording.contact_state[at]
        for y, picture in ((top, frame), (second, brighten(difference, factor))):
            ax = place_axes(figure, x, y, _PICTURE, height)
            ax.imshow(picture)
            ax.set(xticks=[], yticks=[])
            ax.spines[:].set(visible=True, color=STATE_COLOURS[state], linewidth=2)
        title = _margin(recording, at) if at is not None and column else "reference"
        apart = "" if at is None or recording.labelled[at] or not column else ", not valid"
        lines = (
            (title, 0.37, "bold"),
            ("recorded apart" if at is None else f"{recording.time_s[at]:.2f} s", 0.21, "normal"),
            (state + apart, 0.06, "normal"),
        )
        for text, up, weight in lines:
            place_text(figure, x + _PICTURE / 2, top - up, text, ha="center", va="bottom", fontsize=8, weight=weight)
    words = f"Differences are $|T_n - T_0|$, brightened {TIMES} {factor:g}"
    if free and far is not None:
        untouched = f"that of the untouched frame at {recording.time_s[far]:.2f} s"
        words += f"; beneath the reference {untouched}: it should be dark"
    place_text(figure, _LEFT, _HEIGHT - _FOOT + 0.08, words, fontsize=8, color=GREY)


def _margin(recording: Recording, at: int) -> str:
    margin, sigma = float(recording.safety_margin[at]), recording.safety_margin_sigma
    if not np.isfinite(margin):
        return "no Γ"
    band = "" if sigma is None or not np.isfinite(sigma[at]) else f" ± {100 * sigma[at]:.1f}"
    return f"Γ {100 * margin:.0f}{band} %"


def _write_facts(figure: Figure, recording: Recording, labelling: Labelling) -> None:
    # a dollar sign in a name begins no formula
    plain = {"parse_math": False}
    place_text(figure, _EDGE, 0.17, _cut(recording.trial, 75), fontsize=14, fontweight="bold", **plain)
    about = f"{_cut(recording.sensor, 30)}, day {recording.day}, {_cut(recording.condition, 20)}"
    sources = [_cut(words, 50) for words in (labelling.source, labelling.forces) if words]
    place_text(figure, _EDGE, 0.47, "   ·   ".join([about, *sources]), fontsize=9, color=GREY, **plain)
    top = _TOP + 0.05
    facts = audit_facts(recording, labelling)
    if any(fact.doubts for fact in facts):
        place_text(figure, _EDGE, _HEIGHT - _FOOT + 0.08, "▲ may put the labels in doubt", fontsize=8, color=VERMILLION)
    for fact in facts:
        lines = [line for words in fact.lines for line in wrap(words, _WRAP, subsequent_indent=fact.indent)]
        room = max(1, int((_HEIGHT - _FOOT - top) / _LINE - 1.15))
        lines = lines if len(lines) <= room else [*lines[: room - 1], "…"]
        colour, mark = (VERMILLION, "▲ ") if fact.doubts else (BLACK, "")
        place_text(figure, _EDGE, top, mark + fact.head, fontsize=9, fontweight="bold", color=colour)
        for row, line in enumerate(lines):
            place_text(figure, _EDGE, top + (row + 1.15) * _LINE, line, fontsize=8, **plain)
        top += (len(lines) + 1.8) * _LINE


def _cut(words: str, most: int) -> str:
    """Leave out the middle of a text that is too long: the end of a path or of a numbered name matters most."""
    return words if len(words) <= most else f"{words[: most // 3]}…{words[most // 3 + 1 - most :]}"
