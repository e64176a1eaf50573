"""An episode of a grip: force, margin and slip over time."""

from collections.abc import Sequence

from matplotlib.axes import Axes

from sliplens.plots.style import BLACK, BLUE, GREY, ORANGE, VERMILLION
from sliplens.results.grip import GripTrace


def plot_grip_force(trace: GripTrace, *, ax: Axes) -> Axes:
    """Draw the grip force over the least force that holds, and when the markers told of a slip."""
    ax.plot(trace.time_s, trace.force_n, color=BLUE, label="grip force")
    ax.plot(trace.time_s, trace.least_force_n, color=BLACK, linestyle="--", label="least that holds")
    ax.fill_between(trace.time_s, trace.least_force_n, trace.force_n, color=BLUE, alpha=0.12, linewidth=0)
    for number, time_s in enumerate(trace.time_s[trace.slip_seen]):
        ax.axvline(time_s, color=VERMILLION, linewidth=1, linestyle=":", label="slip seen" if number == 0 else None)
    # room for the legend above what is drawn
    ax.set(xlabel="Time (s)", ylabel="Force (N)", ylim=(0, 1.4 * float(trace.force_n.max()) or 1.0))
    ax.legend(loc="upper right", ncols=2)
    return ax


def plot_grip_margin(trace: GripTrace, *, ax: Axes) -> Axes:
    """Draw the margin read, with its interval, and the true one."""
    ax.fill_between(trace.time_s, 100 * trace.low, 100 * trace.high, color=ORANGE, alpha=0.2, linewidth=0)
    ax.plot(trace.time_s, 100 * trace.margin, color=ORANGE, linewidth=1, label="read, with 90 % interval")
    ax.plot(trace.time_s, 100 * trace.true_margin, color=BLACK, linestyle="--", label="true")
    ax.set(xlabel="Time (s)", ylabel="Safety margin Γ (%)", ylim=(-3, 103))
    ax.legend(loc="lower right")
    return ax


def plot_grip_slip(trace: GripTrace, *, ax: Axes) -> Axes:
    """Draw how far the object has slid, in millimetres."""
    ax.plot(trace.time_s, 1e3 * trace.slip_m, color=GREY)
    ax.set(xlabel="Time (s)", ylabel="Slip (mm)", ylim=(0, max(1.0, 1.05e3 * float(trace.slip_m.max()))))
    return ax


def plot_grip(trace: GripTrace, *, axes: Sequence[Axes]) -> None:
    """Draw force, margin and slip on three axes."""
    for draw, title, ax in zip(
        (plot_grip_force, plot_grip_margin, plot_grip_slip), ("Force", "Margin", "Slip"), axes, strict=True
    ):
        draw(trace, ax=ax).set_title(title)
