"""Charts of an imported trial over time: forces, their ratio beside the friction, labels with their uncertainty."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from sliplens.recordings import ContactState, Recording
from sliplens.report.style import BLACK, BLUE, GREEN, GREY, PURPLE, VERMILLION
from sliplens.report.trial_charts import plot_margin

_HIGHEST = 2.5  # times mu_s: where hardly anything presses, F_t / F_n goes anywhere


def plot_contact_forces(recording: Recording, threshold_n: float | None, *, ax: Axes) -> None:
    """Draw F_n and F_t over time, in newtons, and the least F_n of a contact."""
    forces = {"$F_n$": (recording.normal_force_n, BLUE, "-"), "$F_t$": (recording.tangential_force_n, VERMILLION, "--")}
    for name, (force, colour, line) in forces.items():
        told = name if np.isfinite(force).any() else "_unknown"
        ax.plot(recording.time_s, force, color=colour, linestyle=line, linewidth=_width(recording), label=told)
    if threshold_n is not None:
        told = f"contact from {threshold_n:.3g} N"
        ax.axhline(threshold_n, color=BLACK, linestyle=":", linewidth=1.3, label=told)
    ax.set(ylabel="Force (N)", xmargin=0)
    if not np.isfinite(recording.normal_force_n).any():
        _say(ax, "no forces were recorded")


def plot_force_ratio(recording: Recording, friction: Mapping[str, Any] | None, *, ax: Axes) -> None:
    """Draw F_t / F_n of the frames in contact, and the static friction with its interval.

    Where friction came with the frames (None), that of each frame is drawn.
    """
    touches = np.array([state != ContactState.NO_CONTACT for state in recording.contact_state])
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(touches, recording.tangential_force_n / recording.normal_force_n, np.nan)
    drawn = {"color": BLUE, "linewidth": _width(recording), "marker": _marker(recording)}
    ax.plot(recording.time_s, ratio, label="$F_t/F_n$ in contact" if np.isfinite(ratio).any() else "_", **drawn)
    mu, low, high = (friction or {}).get("mu"), (friction or {}).get("low"), (friction or {}).get("high")
    own = np.where(touches, recording.friction_coefficient, np.nan)
    if friction is None and np.isfinite(own).any():
        ax.plot(recording.time_s, own, color=GREEN, linewidth=1.1, label=r"$\mu$ that came with the frames")
        mu = float(np.nanmax(own))
    if low is not None and high is not None and low < high:
        ax.axhspan(low, high, color=GREEN, alpha=0.35, linewidth=0, label="its 68 % interval")
    if mu is not None and friction is not None:
        ax.axhline(mu, color=GREEN, linewidth=1.1, label=f"$\\mu_s$ = {mu:.3g}")
    largest = float(np.max(ratio, where=np.isfinite(ratio), initial=0))
    known = [value for value in (mu, high) if value is not None]
    ceiling = max(_HIGHEST * mu, *known) if mu else 2.0
    ax.set(ylabel="$F_t/F_n$", xmargin=0, ylim=(0, 1.12 * max([min(largest, ceiling), *known]) or 1))
    if not np.isfinite(ratio).any():
        _say(ax, "F_t / F_n is not known")


def plot_labels(recording: Recording, *, ax: Axes) -> None:
    """Draw the safety margin with its uncertainty on the colours of the states, and which frames have no label."""
    plot_margin(recording, ax=ax)
    time_s, valid, margin = recording.time_s, recording.labelled, 100 * recording.safety_margin
    # what is no label stays in sight, but apart
    ax.lines[0].set(color=GREY, linestyle=":", linewidth=1.3)
    sigma = recording.safety_margin_sigma
    if sigma is not None:
        low, high = margin - 100 * sigma, margin + 100 * sigma
        ax.fill_between(time_s, low, high, where=valid, color=PURPLE, alpha=0.75, linewidth=0, label=r"Γ $\pm\,\sigma$")
    held = np.where(valid, margin, np.nan)
    ax.plot(time_s, held, color=BLACK, linewidth=_width(recording), marker=_marker(recording), label="Γ")
    ax.plot(time_s, np.where(valid, np.nan, -9), color=GREY, linewidth=4, solid_capstyle="butt", label="no valid label")
    ax.set(xlabel="", ylim=(-14, 107))
    if not np.isfinite(margin).any():
        ax.text(0.5, 0.5, "no frame has a label", transform=ax.transAxes, ha="center", va="center", color=GREY)


def _say(ax: Axes, words: str) -> None:
    """Say over an empty chart why it is empty."""
    ax.set(yticks=[])
    ax.text(0.5, 0.5, words, transform=ax.transAxes, ha="center", va="center", color=GREY, parse_math=False)


def _width(recording: Recording) -> float:
    """Thinner where frames are so many that noise would fill the chart."""
    return 1.5 if len(recording) <= 1000 else 0.7


def _marker(recording: Recording) -> str:
    """Dots where frames are so few that one alone would draw no line."""
    return "." if len(recording) <= 60 else ""
