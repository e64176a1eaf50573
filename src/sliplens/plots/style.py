"""Names, colours and style of all figures and tables, and layout and saving of pictures."""

import base64
import io
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from cycler import cycler
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import FixedFormatter
from PIL import Image

from sliplens.errors import InputError
from sliplens.explainers.table import EXPLAINERS
from sliplens.files import whole_file
from sliplens.progress import visible
from sliplens.results.faithfulness import CHANCE, NEW_WEIGHTS, is_control

# Okabe and Ito's palette, distinct under every common colour blindness
BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, VERMILLION, PURPLE = (
    "#000000", "#E69F00", "#56B4E9", "#009E73", "#F0E442", "#0072B2", "#D55E00", "#CC79A7",
)  # fmt: skip
GREY = "#6B7280"

UNKNOWN = "\N{EN DASH}"
"""Stands for a missing number."""
INPUT_NAMES = {"raw": "Raw images", "difference": "Difference images", "pair": "Image pairs", "rgb": "Images"}
INPUT_COLOURS = {"raw": ORANGE, "difference": BLUE, "pair": GREEN}
CONDITION_COLOURS = {"dry": ORANGE, "wet": BLUE}

CONTROL_NAMES = {
    "edges": "Edge filter (control)",
    "change": "The change itself (control)",
    "local-change": "Local change (control)",
    "weights-1": "All channels alike (control)",
    "centre": "Centred blob (control)",
    CHANCE: "Random order (control)",
    "oracle": "The truth itself",
    "degraded-oracle": "The truth, damaged",
}
"""Names of maps that no explainer makes; those of explainers are in their rows of `EXPLAINERS`."""
FILL_NAMES = {
    "reference": "baseline frame",
    "grey": "grey",
    "background": "background",
    "blur": "blur",
    "noisy-linear": "noisy linear",
    "true": "true scene",
}
"""Names of the fills of removed parts, the most natural first."""
UNIT_NAMES = {"pixel": "pixels", "tile": "tiles", "marker": "markers"}

_STYLE: Any = {
    # letters as outlines: the page looks the same wherever it is opened
    "svg.fonttype": "path",
    "svg.hashsalt": "sliplens",
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#9CA3AF",
    "axes.labelcolor": "#1F2937",
    "axes.titlecolor": "#1F2937",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.prop_cycle": cycler(color=[BLUE, ORANGE, GREEN, VERMILLION, PURPLE, SKY]),
    "grid.color": "#E5E7EB",
    "grid.linewidth": 0.8,
    "xtick.color": "#4B5563",
    "ytick.color": "#4B5563",
    "xtick.labelsize": 9,
    "ytick.labelsize": 9,
    "legend.fontsize": 9,
    "legend.frameon": False,
    "legend.handlelength": 2.4,
    "lines.linewidth": 1.8,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
}


def drawing_style() -> AbstractContextManager[None]:
    """Draw and save figures in the style of the report; matplotlib's own settings come back afterwards."""
    return mpl.rc_context(_STYLE)


def input_name(name: str) -> str:
    """Return the display name of an input."""
    return INPUT_NAMES.get(name, f"{name.capitalize()} images")


def short_input_name(name: str) -> str:
    """Return the short display name of an input, for legends."""
    return input_name(name).removesuffix(" images")


def method_name(name: str) -> str:
    """Return the display name of a method or control."""
    of_method = name.removesuffix(NEW_WEIGHTS)
    if of_method != name:
        return f"{method_name(of_method)}, new weights (control)"
    return CONTROL_NAMES.get(name) or (EXPLAINERS[name].title if name in EXPLAINERS else name)


def in_order(names: Iterable[str], order: Iterable[str]) -> list[str]:
    """Sort names in an order, then the others by the alphabet."""
    rank = {name: index for index, name in enumerate(order)}
    return sorted(names, key=lambda name: (rank.get(name, len(rank)), name))


def inputs_in_order(names: Iterable[str]) -> list[str]:
    """Sort inputs: raw before difference, as in the thesis, then others."""
    return in_order(set(names), INPUT_NAMES)


def methods_in_order(names: Iterable[str]) -> list[str]:
    """Sort methods as in the thesis, the controls last."""
    methods = [*EXPLAINERS, *CONTROL_NAMES]
    order = [*methods, *(name + NEW_WEIGHTS for name in methods)]
    return sorted(in_order(set(names), order), key=is_control)


def fill_name(fill: str, unit: str = "pixel") -> str:
    """Return the display name of a fill, and of the removed parts where they are not pixels."""
    name = FILL_NAMES.get(fill, fill)
    # the true scene is drawn again without one marker's motion: there is no other unit
    return name if unit == "pixel" or fill == "true" else f"{name} ({UNIT_NAMES.get(unit, unit)})"


def listed(texts: Sequence[str]) -> str:
    """Join texts with commas and "and"."""
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} and {texts[-1]}"


def conditions_in_order(names: Iterable[str]) -> list[str]:
    """Sort conditions: dry before wet before any other."""
    return in_order(set(names), ("dry", "wet"))


def percent(value: float | None) -> str:
    """Write a share as a percentage, or a dash for None and NaN; without the sign of a negative zero."""
    return UNKNOWN if value is None or np.isnan(value) else f"{decimals(100 * value, 0)}\N{NO-BREAK SPACE}%"


def amount(value: float, unit: str) -> str:
    """Write a prediction in its unit; a safety margin in percent."""
    return percent(value) if unit == "margin" else f"{value:.3g} {unit}".rstrip()


def reading_words(prediction: float, withheld: str | None, unit: str = "margin") -> str:
    """Write the prediction of a frame, or that it is withheld."""
    return "withheld" if withheld else f"predicted {amount(prediction, unit)}"


def signed(value: float, digits: int) -> str:
    """Write a number with its sign; +0 for a negative zero."""
    return f"{round(value, digits) + 0.0:+.{digits}f}".replace("-", "\N{MINUS SIGN}")


def decimals(value: float | None, digits: int) -> str:
    """Write a number, or a dash for None."""
    if value is None:
        return UNKNOWN
    return f"{round(value, digits) + 0.0:.{digits}f}".replace("-", "\N{MINUS SIGN}")


# no dates: the same trials, the same file
_METADATA: dict[str, dict[str, Any]] = {".png": {}, ".pdf": {"CreationDate": None}, ".svg": {"Date": None}}


def require_picture_path(path: Path, *, example: str) -> None:
    """Check that a file name is that of a picture that can be saved."""
    if path.suffix.lower() not in _METADATA:
        raise InputError(f"{path} does not end in {', '.join(_METADATA)}; name a picture, such as {example}")


def save_page(figure: Figure, path: Path) -> None:
    """Save a page as .png, .pdf or .svg; it appears when complete."""
    suffix = path.suffix.lower()
    _escape_texts(figure)
    with written_whole(path) as part, drawing_style():
        # 150 dots an inch show frames of 224 pixels about pixel for pixel
        figure.savefig(part, format=suffix[1:], dpi=150, metadata=_METADATA[suffix])


def _escape_texts(figure: Figure) -> None:
    """Escape invisible characters of file names in texts: no font has them, and in an SVG they break the picture."""

    def whole(text: str) -> str:
        return "\n".join(map(visible, text.split("\n")))

    for artist in figure.findobj(Text):
        assert isinstance(artist, Text)
        artist.set_text(whole(artist.get_text()))
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            if isinstance(formatter := axis.get_major_formatter(), FixedFormatter):
                formatter.seq = [whole(text) for text in formatter.seq]


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Open a file beside the target (`files.whole_file`); an error is one sentence."""
    try:
        with whole_file(path) as part:
            yield part
    except OSError as error:
        raise InputError(f"cannot write {path} ({error.strerror}); choose another file") from None


_DOTS_PER_INCH = 144  # photographs of 224 pixels shown 1.5 inches wide, about pixel for pixel


def figure_uri(figure: Figure, *, pixels: bool = False) -> str:
    """Convert a figure to a data URI of SVG, or with `pixels` of PNG, which is smaller for photographs."""
    buffer = io.BytesIO()
    _escape_texts(figure)
    with drawing_style():
        if pixels:
            figure.draw_without_rendering()  # a first layout does not know the ticks of colour bars yet
            figure.savefig(buffer, format="png", dpi=_DOTS_PER_INCH)
            image = Image.open(buffer).convert("RGB")
            # 256 colours are a fourth of the size; by octree they are spread evenly, not given to the noise of a map
            reduced = image.quantize(256, method=Image.Quantize.FASTOCTREE)
            # colours are means: paper would not be quite white
            reduced.putpalette([255 if level > 250 else level for level in reduced.getpalette() or []])
            reduced.save(buffer := io.BytesIO(), "png")
        else:
            # no date: the same results make the same page
            figure.savefig(buffer, format="svg", dpi=200, metadata={"Date": None, "Creator": None})
    return f"data:image/{'png' if pixels else 'svg+xml'};base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"
