"""Real above simulated, and beneath them what their numbers say."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from realism.markers import MarkerTable
from realism.measures import (
    background_noise,
    noise_spectrum,
    radial_profile,
    regions,
    top_over_bottom,
)
from realism.scene import PUBLISHED, SEEN, Simulated
from sliplens.plots.style import BLACK, BLUE, ORANGE, SOURCE_NAMES, drawing_style

_STYLES = (("Real", BLACK, "o"), ("Simulated", ORANGE, "s"))
_LIFT_UNTOUCHED, _LIFT = 8, 1.4


@dataclass(frozen=True, kw_only=True)
class Tracks:
    """Markers in the real and the simulated images, by label and marker."""

    table: MarkerTable
    simulated_px: np.ndarray
    """Tracked as the table was."""
    true_px: np.ndarray
    """Where the simulated markers really went."""


def draw(path: Path, *, real: np.ndarray, simulated: Simulated, tracks: Tracks) -> None:
    """Write the picture as PNG, about 1,700 px wide."""
    pairs = real, simulated.images[[0, *SEEN]]
    with drawing_style():
        figure = Figure(figsize=(17, 10.4), layout="constrained")
        panels: Any = figure.subfigures(2, 1, height_ratios=[2.2, 1])
        images, charts = panels
        _draw_images(images.subplots(2, len(PUBLISHED)), *pairs)
        axes = charts.subplots(1, 5)
        margins = np.array(list(PUBLISHED.values()))[1:]
        _draw_pair(axes[0], margins * 100, [image.mean(axis=(1, 2, 3))[1:] for image in pairs])
        axes[0].set(title="Mean intensity", xlabel="Safety margin Γ (%)", ylabel="Grey levels", ylim=(0, None))
        _draw_pair(axes[1], margins * 100, [top_over_bottom(image)[1:] for image in pairs])
        axes[1].set(title="Top over bottom half", xlabel="Safety margin Γ (%)", ylabel="Ratio of means", ylim=(0, 1.2))
        profiles = [radial_profile(image)[[1, -1]] for image in pairs]
        radii = 8 * np.arange(profiles[0].shape[1]) + 4.0
        _draw_pair(axes[2], radii, [profile[0] for profile in profiles], label="Γ = 100 %")
        _draw_pair(axes[2], radii, [profile[1] for profile in profiles], label="Γ = 0 %", linestyle="--")
        axes[2].set(title="Radial profile", xlabel="Distance from the apex (px)", ylabel="Grey levels", ylim=(0, None))
        axes[2].legend()
        _draw_spectra(axes[3], real, simulated)
        _draw_tracks(axes[4], tracks)
        figure.savefig(path, dpi=100)


def _draw_images(axes: np.ndarray, real: np.ndarray, simulated: np.ndarray) -> None:
    names = [name.capitalize() for name in (SOURCE_NAMES["real"], SOURCE_NAMES["simulated"])]
    for row, images, name in zip(axes, (real, simulated), names, strict=True):
        for column, (axis, image, margin) in enumerate(zip(row, images, PUBLISHED.values(), strict=True)):
            lift = _LIFT if column else _LIFT_UNTOUCHED
            axis.imshow(np.clip(image * lift, 0, 255).astype(np.uint8), interpolation="nearest")
            axis.set(xticks=[], yticks=[])
            axis.grid(visible=False)
            axis.spines[:].set_visible(False)
            if images is real:
                title = f"Γ = {margin:.0%}".replace("%", " %") if column else "Before contact"
                axis.set_title(f"{title} (brightened {lift:g} times)")
            if not column:
                axis.set_ylabel(name)


def _draw_pair(axes: Axes, x: np.ndarray, values: list[np.ndarray], *, label: str = "", linestyle: str = "-") -> None:
    for (name, colour, marker), y in zip(_STYLES, values, strict=True):
        text = f"{name}, {label}" if label else name
        axes.plot(x, y, label=text, linestyle=linestyle, color=colour, marker=marker, markersize=4)
    axes.legend()


def _draw_spectra(axes: Axes, real: np.ndarray, simulated: Simulated) -> None:
    for image, index, name, linestyle in ((0, 0, "before contact", "--"), (1, SEEN[0], "Γ = 100 %", "-")):
        background = regions(simulated, index)["background"]
        pair = real[image], simulated.images[index]
        spectra = [noise_spectrum(background_noise(one, background), background) for one in pair]
        _draw_pair(axes, spectra[0][0], [power for _, power in spectra], label=name, linestyle=linestyle)
    axes.set(
        title="Noise of the background",
        xlabel="Frequency (cycles per pixel)",
        ylabel="Power (grey levels²)",
        ylim=(0, None),
    )


def _draw_tracks(axes: Axes, tracks: Tracks) -> None:
    kept = tracks.table.reliable
    measured = tracks.table.displacement_px[kept].ravel()
    axes.plot(measured, tracks.true_px[kept].ravel(), "x", color=BLUE, alpha=0.3, markersize=4, label="its true motion")
    axes.plot(
        measured,
        tracks.simulated_px[kept].ravel(),
        ".",
        color=ORANGE,
        alpha=0.6,
        label="tracked as the table was",
    )
    axes.axline((0, 0), slope=1, color=BLACK, linewidth=1)
    axes.set(
        title="Marker displacement, x and y",
        xlabel="Table of the real images (px)",
        ylabel="Simulated (px)",
        aspect="equal",
    )
    axes.legend(loc="upper left")
