"""Saliency over what the network saw, and the frames to show it on."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from sliplens.images import write_png
from sliplens.plots.style import ORANGE, SKY, drawing_style, in_order, method_name, percent, reading_words
from sliplens.results.explanation import MARGIN_LEVELS, ExplainedFrame, Explanation, require_saliency

# perceptually uniform, rises in lightness, and read alike under every common colour blindness
COLORMAP = "inferno"
DIM = 0.55  # of the picture's lightness: leaves the bright end of the colours to the saliency
_OPAQUE_FROM = 0.4  # saliency from which the picture no longer shines through
FULL_COLOUR_PERCENTILE = 99.5
"""Percentile of a map that gets the brightest colour: a few outlying pixels would leave the rest of the map black."""


def overlay_saliency(
    picture: UInt8[np.ndarray, "height width 3"], saliency: Float[np.ndarray, "rows columns"]
) -> UInt8[np.ndarray, "height width 3"]:
    """Picture in dimmed grey with the saliency in colour on top.

    The picture loses its own colours, so that every colour seen is saliency, in [0, 1]; where it is low the picture
    shows through.
    """
    value = np.clip(require_saliency(saliency, picture.shape[:2]), 0, 1)
    return np.round(255 * _blend(DIM * lightness(picture), value)).astype(np.uint8)


def stretch_saliency(saliency: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows columns"]:
    """Stretch a map for viewing, so that its 99.5th percentile and all above are 1; a zero map stays zero."""
    top = np.percentile(saliency, FULL_COLOUR_PERCENTILE) or saliency.max()
    return np.clip(saliency / top, 0, 1) if top > 0 else saliency


def plot_colour_bar(*, ax: Axes) -> Axes:
    """Draw the colours of `overlay_saliency` from least to most important, over a mid-grey picture."""
    value = np.linspace(0, 1, 256)[None]
    ax.imshow(_blend(np.full_like(value, DIM / 2), value), extent=(0, 1, 0, 1), aspect="auto")
    ax.set(xlabel="Saliency (share of its own picture's 99.5th percentile)", yticks=[], xticks=[0, 0.25, 0.5, 0.75, 1])
    ax.grid(visible=False)
    return ax


LOWERS, RAISES = ORANGE, SKY
"""Colours of what lowers an answer and of what raises it: bright on dark, and told apart by everyone."""
SIGN_COLOURS = LinearSegmentedColormap.from_list("sign", [LOWERS, (DIM / 2,) * 3, RAISES])
"""Both over a mid-grey picture, from -1 to 1."""


def full_colour(relevance: Float[np.ndarray, "*any"], *, percentile: float = FULL_COLOUR_PERCENTILE) -> float:
    """Size of signed values that gets the full colour; 1 where all are zero."""
    sizes = np.abs(relevance)
    return float(np.percentile(sizes, percentile)) or float(sizes.max()) or 1.0


def overlay_relevance(
    picture: UInt8[np.ndarray, "height width 3"], share: Float[np.ndarray, "rows columns"]
) -> UInt8[np.ndarray, "height width 3"]:
    """Picture in dimmed grey under a signed map in [-1, 1]: orange lowers, blue raises, the stronger the less grey.

    A map of another height and width than the picture's is repeated.
    """
    places = [np.arange(side) * count // side for side, count in zip(picture.shape, share.shape, strict=False)]
    value = np.clip(share[np.ix_(*places)].astype(np.float64), -1, 1)[..., None]
    colour = np.where(value < 0, to_rgb(LOWERS), to_rgb(RAISES))
    mixed = (1 - np.abs(value)) * (DIM * lightness(picture))[..., None] + np.abs(value) * colour
    return np.round(255 * mixed).astype(np.uint8)


def lightness(picture: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width"]:
    """Luma of a picture, 0 to 1, by the weights of ITU-R BT.601."""
    return picture @ np.array([0.299, 0.587, 0.114]) / 255


def _blend(
    grey: Float[np.ndarray, "height width"], saliency: Float[np.ndarray, "height width"]
) -> Float[np.ndarray, "height width 3"]:
    alpha = np.clip(saliency / _OPAQUE_FROM, 0, 1)[..., None]
    return (1 - alpha) * grey[..., None] + alpha * colormaps[COLORMAP](saliency)[..., :3]


def overlay_jet(
    picture: UInt8[np.ndarray, "height width 3"], saliency: Float[np.ndarray, "height width"]
) -> UInt8[np.ndarray, "height width 3"]:
    """Picture under half of the saliency in Jet, divided by the brightest value, as the thesis's figures have it.

    Jet has bright bands where nothing changes and is not read alike by everyone; use it to compare with those figures.

    `show_cam_on_image` of the public pytorch-grad-cam, which the thesis's code calls.
    """
    mixed = 0.5 * colormaps["jet"](np.clip(saliency, 0, 1))[..., :3] + 0.5 * picture / 255
    return np.round(255 * mixed / max(mixed.max(), 1e-12)).astype(np.uint8)


Colours: TypeAlias = Literal["signed", "jet"]
"""Colours of overlays: `signed`, what raises and what lowers, on one scale; `jet`, what supports, as in the thesis."""
_CELL_IN = 1.6
_BAR_IN = 3.6  # as wide as the label of the colour bar
_WIDEST = 12
"""Frames of a panel at most, which can still be seen on a screen."""
_LEAST = 0.2
"""Least full colour, in points of margin per 1 % of the image: 2 points, which is nothing to explain, on a tenth."""


def full_points(relevance: Float[np.ndarray, "frames height width"]) -> float:
    """Return the relevance that gets the full colour in all frames, in points of margin per 1 % of the image."""
    return max(full_colour(relevance * relevance[0].size), _LEAST)


def overlay_points(
    pictures: UInt8[np.ndarray, "frames height width 3"], relevance: Float[np.ndarray, "frames height width"]
) -> list[UInt8[np.ndarray, "height width 3"]]:
    """Overlay pictures with signed maps on one scale (`full_points`)."""
    limit = full_points(relevance)
    return [
        overlay_relevance(picture, values * values.size / limit)
        for picture, values in zip(pictures, relevance, strict=True)
    ]


def draw_explanation(explanation: Explanation, folder: Path, *, colours: Colours = "signed") -> None:
    """Write an overlay of every map (`overlays/METHOD/FRAME.png`), and up to 12 frames side by side (`panel.png`)."""
    count = len(explanation.frames)
    columns = np.linspace(0, count - 1, min(count, _WIDEST)).round().astype(int).tolist()
    rows = {"Network input": [explanation.pictures[column] for column in columns]}
    for method, relevance in explanation.relevance.items():
        (overlays := folder / "overlays" / method).mkdir(parents=True, exist_ok=True)
        if colours == "jet":
            pictures = list(map(overlay_jet, explanation.pictures, explanation.saliency[method]))
            scale = ""
        else:
            pictures = overlay_points(explanation.pictures, relevance)
            scale = f"\nfull colour: {full_points(relevance):.2g} points"
        for frame, picture in zip(explanation.frames, pictures, strict=True):
            write_png(overlays / f"{frame.id}.png", picture)
        rows[f"{method_name(method)}{scale}"] = [pictures[column] for column in columns]
    titles = []
    for frame in (explanation.frames[column] for column in columns):
        name = frame.id if len(frame.id) <= 22 else f"\N{HORIZONTAL ELLIPSIS}{frame.id[-21:]}"
        true = "" if frame.safety_margin is None else f", true {percent(frame.safety_margin)}"
        titles.append(f"{name}\n{reading_words(frame.prediction, frame.withheld)}{true}")
    if colours == "jet":
        bar, words = (
            ScalarMappable(Normalize(0, 1), "jet"),
            "supports the answer (share of its own picture's strongest)",
        )
    else:
        bar = ScalarMappable(Normalize(-1, 1), SIGN_COLOURS)
        words = "lowers the margin  |  raises it, in shares of the full colour\n"
        words += "(which is in points of margin per 1 % of the image)"
    if len(columns) < count:
        words += f"\n{len(columns)} of {count} frames, evenly spread; overlays/ has them all"
    with drawing_style():
        figure = _draw_panel(rows, titles, bar)
        figure.axes[-1].set_xlabel(words, fontsize=8)
        figure.savefig(folder / "panel.png", bbox_inches="tight")


def _draw_panel(
    rows: Mapping[str, Sequence[UInt8[np.ndarray, "height width 3"]]], titles: Sequence[str], bar: ScalarMappable
) -> Figure:
    size = (max(_CELL_IN * len(titles) + 0.6, _BAR_IN), _CELL_IN * len(rows) + 1.2)
    figure = Figure(figsize=size, dpi=120, layout="constrained")
    axes = figure.subplots(len(rows), len(titles), squeeze=False)
    for line, (name, pictures) in zip(axes, rows.items(), strict=True):
        line[0].set_ylabel(name, fontsize=8)
        for ax, picture in zip(line, pictures, strict=True):
            ax.set(xticks=[], yticks=[])
            ax.spines[:].set_visible(False)
            ax.imshow(picture, interpolation="nearest")
    for ax, title in zip(axes[0], titles, strict=True):
        ax.set_title(title, fontsize=7, loc="center", fontweight="normal", parse_math=False)
    colour_bar = figure.colorbar(bar, ax=list(axes.flat), location="bottom", fraction=0.05, aspect=50, pad=0.02)
    colour_bar.ax.tick_params(labelsize=7)
    colour_bar.ax.xaxis.set_major_formatter(PercentFormatter(1))
    return figure


_TOLERANCE = 0.1  # half the distance between two columns


def choose_columns(frames: tuple[ExplainedFrame, ...]) -> tuple[str, list[tuple[float | None, int | None]]]:
    """Pick the condition, and a frame's index for each nominal margin (None where none is near).

    The nearest label wins and ties go to the first frame: the network's answer plays no part.
    """
    conditions = [frame.condition for frame in frames]
    condition = max(in_order(set(conditions), ("dry", "wet")), key=conditions.count)
    rows = [index for index, frame in enumerate(frames) if frame.condition == condition]
    labels = {index: margin for index in rows if (margin := frames[index].safety_margin) is not None}
    if not labels:
        return condition, [(None, index) for index in rows[: len(MARGIN_LEVELS)]]
    if len(labels) == len(rows) <= len(MARGIN_LEVELS):
        return condition, [(labels[index], index) for index in sorted(rows, key=lambda index: -labels[index])]
    chosen = []
    for nominal in MARGIN_LEVELS:
        nearest = min(labels, key=lambda index: abs(labels[index] - nominal))
        near = abs(labels[nearest] - nominal) < _TOLERANCE
        chosen.append((nominal, nearest if near else None))
    return condition, chosen
