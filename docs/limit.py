"""Draw what the markers can tell: python docs/limit.py limit.json docs/images/limit.png.

The numbers are the last line of `python benchmarks/limit.py --json`. Networks are drawn beside them from folders that
`sliplens evaluate` wrote: --networks runs/evaluation-difference ...
"""

import argparse
import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sliplens.plots.style import BLUE, GREY, ORANGE, drawing_style

NOISE_PX = 0.1
MODELS: dict[str, Literal["-", "--"]] = {"calibrated": "-", "half-space": "--"}
COLOURS = {"known": GREY, "dry": BLUE, "wet": ORANGE}
FRICTIONS = {"known": "friction known", "dry": "dry", "wet": "wet"}
VIEWS = {
    "1": "1\nframe",
    "path 2": "2\nany\nspeed",
    "path 12": "12\nany\nspeed",
    "2": "2\nknown\nspeed",
    "8": "8\nknown\nspeed",
    "all": "all\nwith\nclock",
}
GOALS = {"dry": 0.95, "wet": 0.80}
GUESS = 100 / np.sqrt(12)


def plot_bounds(numbers: dict[str, Any], networks: list[dict[str, Any]], *, ax: Axes) -> None:
    """Draw the Cramer-Rao bound of one frame, and the networks' errors in bins of the margin."""
    for row in numbers["bound"]:
        if row["noise_px"] == NOISE_PX and row["friction"] in COLOURS:
            margin, sigma = 100 * np.array(row["margin"]), 100 * np.array(row["sigma"])
            ax.plot(margin, sigma, ls=MODELS[row["model"]], color=COLOURS[row["friction"]])
    for network, symbol in zip(networks, "os^D", strict=False):
        for condition, scores in network["conditions"].items():
            bins = [one for one in scores["bins"] if one["mse"] is not None]
            middle = [50 * (one["low"] + one["high"]) for one in bins]
            ax.plot(middle, [100 * one["mse"] ** 0.5 for one in bins], symbol, color=COLOURS.get(condition, GREY), ms=5)
    ax.axhline(GUESS, color=GREY, linewidth=1)
    ax.text(99, GUESS * 1.06, "seeing nothing: 29", color=GREY, fontsize=9, ha="right")
    ax.set(
        title="One frame, at best",
        xlabel="safety margin Γ (%)",
        ylabel="standard deviation of Γ (points)",
        yscale="log",
        xlim=(0, 100),
        ylim=(0.2, 60),
        yticks=[0.3, 1, 3, 10, 30],
        yticklabels=["0.3", "1", "3", "10", "30"],
    )


def plot_reached(numbers: dict[str, Any], networks: list[dict[str, Any]], *, ax: Axes) -> None:
    """Draw the R2 that a perceptron reaches through every view, beside the goals."""
    places = dict(zip(VIEWS, (0, 1, 2, 3.4, 4.4, 5.4), strict=True))
    for condition, goal in GOALS.items():
        ax.axhline(goal, color=COLOURS[condition], linewidth=1, alpha=0.6)
        ax.text(
            2.7,
            goal - 0.004,
            f"goal {condition} {goal:.2f}",
            color=COLOURS[condition],
            fontsize=9,
            ha="center",
            va="top",
        )
        for model, line in MODELS.items():
            found = {
                row["frames"]: row["r2"]
                for row in numbers["bayes_r2"]
                if (row["model"], row["training"], row["test"], row["condition"])
                == (model, "mixed", "fresh days", condition)
            }
            for group in (("1", "path 2", "path 12"), ("2", "8", "all")):
                ax.plot(
                    [places[view] for view in group],
                    [found[view] for view in group],
                    marker="o",
                    ls=line,
                    color=COLOURS[condition],
                    ms=5,
                    mfc="white" if line == "--" else None,
                )
    for network, symbol in zip(networks, "os^D", strict=False):
        for condition, scores in network["conditions"].items():
            ax.plot(-0.25, scores["r2"], symbol, color=COLOURS.get(condition, GREY), mec="black", ms=7)
    ax.set(title="R² reached from markers, friction dry or wet", ylabel="R² of Γ", ylim=(0.5, 1.005), xlim=(-0.4, 5.8))
    ax.set_xticks(list(places.values()), list(VIEWS.values()))


def draw(numbers: dict[str, Any], networks: list[dict[str, Any]]) -> Figure:
    """Draw both panels and their key."""
    figure = Figure(figsize=(10, 4.7), layout="constrained")
    left, right = figure.subplots(1, 2)
    plot_bounds(numbers, networks, ax=left)
    plot_reached(numbers, networks, ax=right)
    key = [Line2D([], [], color=COLOURS[name], label=label) for name, label in FRICTIONS.items()]
    key += [Line2D([], [], color="black", ls=line, label=model) for model, line in MODELS.items()]
    key += [
        Line2D([], [], color="black", ls="", marker=symbol, label=f"network, {network['input']} images")
        for network, symbol in zip(networks, "os^D", strict=False)
    ]
    figure.legend(handles=key, loc="outside lower center", ncols=len(key))
    return figure


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("numbers", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--networks", type=Path, nargs="*", default=[], help="folders of `sliplens evaluate`")
    arguments = parser.parse_args()
    evaluations = [json.loads((folder / "result.json").read_text()) for folder in arguments.networks]
    with drawing_style():
        draw(json.loads(arguments.numbers.read_text()), evaluations).savefig(arguments.output, dpi=120)
