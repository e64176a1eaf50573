"""Draw the picture of the README from a finished demo: python docs/panel.py runs/demo docs/images/panel.png."""

import argparse
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec

from sliplens.plots.saliency import choose_frames, overlay_saliency, plot_colour_bar, stretch_saliency
from sliplens.plots.style import method_name, methods_in_order, percent
from sliplens.report.results import load_results


def draw(workspace: Path) -> Figure:
    """Draw inputs of the difference network from full stick to full slip above what each method made of them."""
    explained = load_results(workspace).explanations["difference", "simulated"]
    columns = [index for _, index in choose_frames(explained.frames)[1] if index is not None]
    methods = methods_in_order(explained.methods)
    figure = Figure(figsize=(2 * len(columns) + 0.4, 2 * (len(methods) + 1) + 1.1), dpi=100, layout="constrained")
    grid = GridSpec(len(methods) + 2, len(columns), figure=figure, height_ratios=[1] * (len(methods) + 1) + [0.06])
    for column, index in enumerate(columns):
        frame, picture = explained.frames[index], explained.pictures[index]
        rows = [picture] + [overlay_saliency(picture, stretch_saliency(explained.saliency[m][index])) for m in methods]
        for row, (name, pixels) in enumerate(zip(["Input", *map(method_name, methods)], rows, strict=True)):
            ax = figure.add_subplot(grid[row, column])
            ax.imshow(pixels)
            ax.set(xticks=[], yticks=[])
            ax.spines[:].set_visible(False)
            if column == 0:
                ax.set_ylabel(name, fontsize=13)
            if row == 0:
                title = f"Γ {percent(frame.safety_margin)}\nread {percent(frame.prediction)}"
                ax.set_title(title, fontsize=13)
    plot_colour_bar(ax=figure.add_subplot(grid[-1, :]))
    return figure


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("output", type=Path)
    arguments = parser.parse_args()
    draw(arguments.workspace).savefig(arguments.output)
