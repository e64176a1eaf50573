"""A grip from stick to slip on one picture: camera, map, and the margin that was true and read."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from sliplens.plots.layout import place_axes, place_text
from sliplens.plots.saliency import SIGN_COLOURS, full_colour, overlay_relevance
from sliplens.plots.style import BLACK, BLUE, INPUT_NAMES, SOURCE_NAMES, VERMILLION, drawing_style, method_name
from sliplens.results.explanation import Strip

_WIDTH_IN, _MARGIN_IN, _GAP_IN, _CHART_IN = 10.0, 0.75, 0.08, 2.2


def draw_strip(strip: Strip) -> Figure:
    """Draw a trial from stick to slip.

    Above, what the camera saw at a few moments with the map over it, on one scale for all: blue where a pixel raises
    the read margin, orange where it lowers it. Below, the true and the read margin over time, with the 90 % interval.
    """
    count = len(strip.shown)
    cell = (_WIDTH_IN - _MARGIN_IN - 1.0 - _GAP_IN * (count - 1)) / count
    height = 1.05 + cell + 0.45 + _CHART_IN + 0.6
    # the map's own units are too small to read: points of the margin for every hundredth of the picture
    points = strip.relevance * strip.relevance[0].size
    limit = full_colour(points)
    with drawing_style():
        figure = Figure(figsize=(_WIDTH_IN, height))
        head = f"A {strip.condition} grip from stick to slip ({SOURCE_NAMES[strip.source]})"
        place_text(figure, 0.1, 0.1, head, fontsize=13, fontweight="bold")
        place_text(figure, 0.1, 0.36, _subtitle(strip), fontsize=9.5, color="#4B5563")
        for number, (frame, picture, relevance) in enumerate(zip(strip.shown, strip.pictures, points, strict=True)):
            ax = place_axes(figure, _MARGIN_IN + number * (cell + _GAP_IN), 1.05, cell, cell)
            ax.imshow(overlay_relevance(picture, relevance / limit))
            ax.set_axis_off()
            read, true = _percent(strip.readings.prediction[frame]), _percent(strip.readings.safety_margin[frame])
            words = f"{number + 1}: {read} read\n{true} true"
            ax.set_title(words, fontsize=9.5, loc="center", fontweight="normal")
        bar = place_axes(figure, _WIDTH_IN - 0.9, 1.05, 0.13, cell)
        figure.colorbar(ScalarMappable(Normalize(-limit, limit), SIGN_COLOURS), cax=bar)
        bar.set_ylabel("points of margin\nper 1 % of the image", fontsize=8)
        bar.tick_params(labelsize=8)
        chart = place_axes(figure, _MARGIN_IN, 1.05 + cell + 0.4, _WIDTH_IN - _MARGIN_IN - 1.0, _CHART_IN)
        plot_readings(strip, ax=chart)
    return figure


def plot_readings(strip: Strip, *, ax: Axes) -> Axes:
    """Draw the true and the read margin over time, with the interval and the moments that have pictures."""
    readings = strip.readings
    touched = np.isfinite(readings.safety_margin)
    time_s = readings.time_s
    read, low, high = (
        np.where(touched, 100 * value, np.nan) for value in (readings.prediction, readings.low, readings.high)
    )
    if np.isfinite(low).any():  # a network that was never calibrated tells none
        ax.fill_between(time_s, low, high, color=BLUE, alpha=0.18, linewidth=0, label="90 % interval")
    ax.plot(time_s, read, color=BLUE, label="read from the image")
    ax.plot(time_s, 100 * readings.safety_margin, color=BLACK, linestyle="--", label="true")
    for number, frame in enumerate(strip.shown, start=1):
        ax.axvline(time_s[frame], color="#9CA3AF", linewidth=0.8, zorder=0)
        ax.annotate(str(number), (time_s[frame], 106), ha="center", fontsize=9, annotation_clip=False)
    slipping = readings.contact_state == "full slip"
    if slipping.any():
        ends = float(time_s[slipping][0]), float(time_s[-1])
        ax.axvspan(*ends, color=VERMILLION, alpha=0.15, linewidth=0, label="from the first full slip")
    ax.set(xlabel="Time (s)", ylabel="Safety margin (%)", ylim=(-4, 104), xlim=(time_s[0], time_s[-1]))
    ax.legend(loc="lower left")
    return ax


def _subtitle(strip: Strip) -> str:
    network = INPUT_NAMES.get(strip.input, strip.input).lower()
    return (
        f"Camera frames under the map of {method_name(strip.method)}, for the network on {network}: "
        "orange lowers the margin that it reads, blue raises it"
    )


def _percent(value: float) -> str:
    return f"{100 * value:.0f} %" if np.isfinite(value) else "-"
