"""What contact sheets and clips share: charts of a trial over time, colours of its states, bright differences."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke

from sliplens.recordings import ContactState, Recording
from sliplens.report.style import BLACK, BLUE, GREY, ORANGE, SKY, VERMILLION

STATE_COLOURS = dict(zip(ContactState, (GREY, BLUE, ORANGE, VERMILLION, "white"), strict=True))
# full slip darker than the rest: told from incipient slip by its lightness too
STATE_TINTS = dict(zip(ContactState, (0.2, 0.2, 0.2, 0.55, 0), strict=True))
NAMED_STATES = tuple(state for state in ContactState if state is not ContactState.UNKNOWN)
"""What a legend tells of."""
TIMES = "\N{MULTIPLICATION SIGN}"

_BRIGHT_PERCENTILE = 99.5  # of the differences: a few outlying pixels would leave the rest dark


def brightening(differences: Sequence[UInt8[np.ndarray, "_ _ _ 3"]]) -> float:
    """Give the factor, at least 1 and of one decimal, that makes the brightest half percent of pixels white."""
    levels = [float(np.percentile(some.max(axis=-1), _BRIGHT_PERCENTILE)) for some in differences if some.size]
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
    """Legend of the outlines, empty where no trial has any."""
    known = [one.truth.displacement for one in recordings if one.truth is not None]
    stick = "outline of its stick zone" + (" (nominal)" if "calibrated" in known else "")
    told = (("white", "outline of the contact"), (SKY, stick)) if known else ()
    rim = [Stroke(linewidth=3.4, foreground=BLACK), Normal()]
    return [Line2D([], [], color=colour, linewidth=1.8, path_effects=rim, label=label) for colour, label in told]
