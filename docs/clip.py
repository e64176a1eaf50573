"""Draw the clip of the README: python docs/clip.py docs/images/grip.webp.

The trial is the first dry one that tests of the preset `small`: chosen by its number, not by its predictions.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

import sliplens as sl
from sliplens.files import DEFAULT_NETWORK
from sliplens.plots.charts import column
from sliplens.plots.style import BLACK, BLUE, GREY, drawing_style
from sliplens.recordings import Recording
from sliplens.results.explanation import full_colour, overlay_relevance
from sliplens.simulation import make_recipe, plan_trials, simulate_trial

METHOD = "shapley-marker"
SHOWN_A_SECOND = 4
_NETWORK = DEFAULT_NETWORK


def draw_pictures(recording: Recording) -> Iterator[Image.Image]:
    """One picture of every other frame in contact: camera, map, and the margin up to here."""
    rows = sl.predict(_NETWORK, recording.frames, reference=recording.reference).to_arrow()
    touched = np.flatnonzero(np.isfinite(recording.safety_margin))[::2]
    explanation = sl.explain(_NETWORK, recording.frames[touched], reference=recording.reference, method=METHOD)
    maps = explanation.relevance[METHOD]
    limit = full_colour(maps)
    for at, relevance in zip(touched.tolist(), maps, strict=True):
        yield _draw(recording, rows, touched, at, overlay_relevance(recording.frames[at], relevance / limit))


def _draw(recording: Recording, rows: pa.Table, touched: np.ndarray, at: int, overlay: np.ndarray) -> Image.Image:
    true, predicted = 100 * recording.safety_margin, 100 * column(rows, "prediction")
    low, high = 100 * column(rows, "low_90"), 100 * column(rows, "high_90")
    time_s, seen = recording.time_s, touched[touched <= at]
    with drawing_style():
        figure = Figure(figsize=(8.0, 2.9), dpi=100)
        canvas = FigureCanvasAgg(figure)
        for left, picture, title in (
            (0.01, recording.frames[at], "camera"),
            (0.3, overlay, "why: orange lowers,\nblue raises"),
        ):
            ax = figure.add_axes((left, 0.02, 0.275, 0.76))
            ax.imshow(picture)
            ax.set_axis_off()
            ax.set_title(title, fontsize=10, loc="left", fontweight="normal")
        chart = figure.add_axes((0.665, 0.19, 0.32, 0.54))
        chart.fill_between(time_s[seen], low[seen], high[seen], color=BLUE, alpha=0.18, linewidth=0, label="90 %")
        chart.plot(time_s[touched], true[touched], color=BLACK, linestyle="--", linewidth=1, label="true")
        chart.plot(time_s[seen], predicted[seen], color=BLUE, label="predicted")
        chart.plot(time_s[at], predicted[at], color=BLUE, marker="o", markersize=5)
        chart.set(xlim=(time_s[touched[0]], time_s[touched[-1]]), ylim=(-4, 104), yticks=(0, 50, 100))
        chart.set_xlabel("time (s)", fontsize=8)
        chart.tick_params(labelsize=8)
        chart.legend(loc="lower left", fontsize=7)
        figure.text(0.665, 0.9, f"safety margin {predicted[at]:.0f} %", fontsize=15, fontweight="bold", color=BLUE)
        caption = f"90 % interval {low[at]:.0f} to {high[at]:.0f} %, true {true[at]:.0f} %"
        figure.text(0.665, 0.81, caption, fontsize=9, color=GREY)
        canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path)
    arguments = parser.parse_args()
    plans = plan_trials(make_recipe("small"))
    [chosen, *_] = (plan for plan in plans if plan.split == "test" and plan.condition == "dry")
    first, *others = draw_pictures(simulate_trial(chosen))
    milliseconds = [1000 // SHOWN_A_SECOND] * len(others) + [2000]
    first.save(
        arguments.output, save_all=True, append_images=others, duration=milliseconds, loop=0, quality=60, method=6
    )
