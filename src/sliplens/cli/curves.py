"""The learning curve of one training, as a picture."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from sliplens.report.files import read_learning_curve
from sliplens.report.pages import place_axes, place_text, save_page
from sliplens.report.style import BLUE, GREY, INPUT_COLOURS, VERMILLION, drawing_style

_FEW = 40
"""Epochs up to which each has a dot: one epoch alone makes no line."""


def draw_learning_curve(metrics: Path, path: Path, *, input_name: str, title: str) -> None:
    """Save the errors of a `metrics.csv` by epoch, on a logarithmic scale, with the epoch whose weights were kept.

    Parameters
    ----------
    metrics
        As `fit` writes it.
    path
        File to write: .png, .pdf or .svg.
    input_name
        What the network sees; it sets the colour, as in the report.
    title
        Head of the page.

    Raises
    ------
    InputError
        If a file cannot be read or written.
    """
    curve = read_learning_curve(metrics, command="sliplens train")
    epoch, train, validation = (curve[name] for name in ("epoch", "train_mse", "validation_mse"))
    best = int(np.argmin(validation))
    with drawing_style():
        figure = Figure(figsize=(7.0, 4.4))
        ax = place_axes(figure, 0.95, 0.75, 5.8, 3.05)
        _plot(ax, epoch, train, validation, best=best, colour=INPUT_COLOURS.get(input_name, BLUE))
        place_text(figure, 0.25, 0.15, title, fontsize=12, fontweight="bold", parse_math=False)
        kept = f"kept: epoch {epoch[best]:.4g}, validation MSE {validation[best]:.4g}"
        kept += f", root mean square error {100 * np.sqrt(validation[best]):.1f} points of Γ"
        place_text(figure, 0.25, 0.42, kept, fontsize=9, color=GREY)
        save_page(figure, path)


def _plot(ax: Axes, epoch: np.ndarray, train: np.ndarray, validation: np.ndarray, *, best: int, colour: str) -> None:
    marker = "o" if len(epoch) <= _FEW else ""
    style = {"color": colour, "marker": marker, "markersize": 3}
    ax.plot(epoch, train, linestyle=":", label="training, augmented", **style)
    ax.plot(epoch, validation, label="validation", **style)
    ax.plot(
        epoch[best], validation[best], marker="o", markersize=10, markerfacecolor="none", markeredgewidth=1.6,
        linestyle="", color=VERMILLION, label="kept",
    )  # fmt: skip
    ax.set(xlabel="Epoch (passes over the training frames)", ylabel="MSE (Γ as a fraction, squared)", yscale="log")
    ax.set_xlim(0, 1.03 * max(1.0, float(epoch[-1])))
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    # room above and below, so that a curve that hardly falls looks like one
    errors = np.concatenate([train, validation])
    ax.set_ylim(0.7 * float(errors.min()), 1.4 * float(errors.max()))
    ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5, 7)))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.yaxis.set_minor_locator(NullLocator())
    ax.legend()
