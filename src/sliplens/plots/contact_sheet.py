"""Contact sheet: frames of trials from the untouched sensor to full slip, on one picture."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from textwrap import shorten

import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from PIL import Image
from scipy.ndimage import binary_dilation

from sliplens.errors import InputError
from sliplens.images import absolute_difference
from sliplens.plots.saliency import PictureRow, draw_pictures
from sliplens.plots.style import (
    BLACK,
    BLUE,
    GREY,
    ORANGE,
    SKY,
    VERMILLION,
    percent,
    require_picture_path,
    save_page,
)
from sliplens.recordings import ContactState, Recording
from sliplens.recordings.trial import OUTSIDE, STICKS
from sliplens.results.explanation import MARGIN_LEVELS

STATE_COLOURS = dict(zip(ContactState, (GREY, BLUE, ORANGE, VERMILLION, "white"), strict=True))
# full slip is darker, so that lightness too separates it from incipient slip
STATE_TINTS = dict(zip(ContactState, (0.2, 0.2, 0.2, 0.55, 0), strict=True))
_NAMED = tuple(state for state in ContactState if state is not ContactState.UNKNOWN)
TIMES = "\N{MULTIPLICATION SIGN}"

_BRIGHT_PERCENTILE = 99.5  # of the differences: a few outlying pixels would leave the rest dark


def brightening(differences: Sequence[UInt8[np.ndarray, "_ _ _ 3"]]) -> float:
    """Compute the factor, at least 1 and of one decimal, that makes the brightest half percent of pixels white."""
    levels = [float(np.percentile(pixels.max(axis=-1), _BRIGHT_PERCENTILE)) for pixels in differences if pixels.size]
    return max(1.0, round(255 / max([1.0, *levels]), 1))


def brighten(difference: UInt8[np.ndarray, "*any"], factor: float) -> UInt8[np.ndarray, "*any"]:
    """Multiply grey levels by a factor, up to 255."""
    return np.minimum(np.round(np.float32(factor) * difference), 255).astype(np.uint8)


def plot_margin(recording: Recording, *, ax: Axes) -> Axes:
    """Draw the safety margin over time, in percent, on the colours of the contact states."""
    states = recording.contact_state
    changes = [at for at in range(1, len(states)) if states[at] != states[at - 1]]
    edges = recording.time_s[[0, *changes, len(states) - 1]]
    for at, (begin, end) in zip([0, *changes], pairwise(edges), strict=True):
        ax.axvspan(begin, end, color=STATE_COLOURS[states[at]], alpha=STATE_TINTS[states[at]], linewidth=0)
    ax.plot(recording.time_s, 100 * recording.safety_margin, color=BLACK)
    ax.set(xlabel="Time (s)", ylabel="Γ (%)", xmargin=0, ylim=(-7, 107), yticks=[0, 50, 100])
    return ax


def state_patches() -> list[Patch]:
    """Create the legend of the contact states."""
    return [Patch(lw=0, label=str(state), color=STATE_COLOURS[state], alpha=STATE_TINTS[state]) for state in _NAMED]


_REACHED_WITHIN = 0.1 - 1e-9  # half the distance between two columns: no frame stands in both
_ALIKE = 0.005  # margins that are equal in whole percents
# pixels; pictures are enlarged up to the first size and reduced down to the second one, given as (height, width)
_SMALL, _LARGE = (480, 640), (720, 960)


def _scale(height: int, width: int) -> tuple[int, int]:
    """Choose whole factors to enlarge and to reduce a picture by, one of them 1."""
    return max(1, min(_SMALL[0] // height, _SMALL[1] // width)), max(-(-height // _LARGE[0]), -(-width // _LARGE[1]))


def enlarge(pixels: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "rows columns 3"]:
    """Enlarge or reduce a picture by a whole factor to a size to look at."""
    up, down = _scale(*pixels.shape[:2])
    image = Image.fromarray(pixels).reduce(down)
    return np.array(image.resize((image.width * up, image.height * up), Image.Resampling.LANCZOS))


def paint_outlines(camera: UInt8[np.ndarray, "rows columns 3"], contact: UInt8[np.ndarray, "height width"]) -> None:
    """Paint white around the contact, and blue inside its stick zone, both with a dark rim: neither hides the other."""
    up, down = _scale(*contact.shape)
    contact = contact[::down, ::down].repeat(up, axis=0).repeat(up, axis=1)
    touches, loose = contact != OUTSIDE, contact != STICKS
    for zone, steps, colour in ((touches, 3, BLACK), (touches, 2, "white"), (loose, 3, BLACK), (loose, 2, SKY)):
        camera[binary_dilation(zone, iterations=steps) & ~zone] = to_bytes(colour)


def to_bytes(colour: str) -> tuple[int, ...]:
    """Return the levels of a colour."""
    return tuple(round(255 * level) for level in to_rgb(colour))


def draw_contact_sheet(recordings: Sequence[Recording], *, title: str | None = None) -> Figure:
    """Draw two rows a trial: frames from the untouched sensor to full slip, and their differences.

    Frames are those of `choose_untouched` and `choose_margins`; difference images are brightened by one factor, so that
    trials compare. Outlines of the true contact (white) and stick zone (blue) lie over the frames of simulated trials.
    """
    if not recordings:
        raise InputError("a contact sheet needs a trial; give at least one recording")
    chosen = [[choose_untouched(recording), *choose_margins(recording)] for recording in recordings]
    factor = brightening(
        [
            absolute_difference(recording.frames[[at for at in row if at is not None]], recording.reference)
            for recording, row in zip(recordings, chosen, strict=True)
        ]
    )
    rows = []
    for recording, row in zip(recordings, chosen, strict=True):
        cameras, differences, words = [], [], []
        for column, index in enumerate(row):
            frame = recording.reference if index is None else recording.frames[index]
            camera, difference = enlarge(frame), brighten(absolute_difference(frame, recording.reference), factor)
            if index is None and column:
                camera, difference = (np.full_like(picture, 255) for picture in (camera, difference))
                words.append("no frame")
            elif index is None:
                words.append("reference")
            else:
                words.append(f"{recording.time_s[index]:.1f} s, {recording.contact_state[index]}")
                if recording.truth is not None:
                    paint_outlines(camera, recording.truth.contact_map[index])
            cameras.append(camera)
            differences.append(difference)
        name = f"{shorten(recording.trial, 36, placeholder='…')}, {recording.condition}, day {recording.day}"
        rows.append(PictureRow(name=name, pictures=cameras, words=words))
        rows.append(PictureRow(name=f"difference {TIMES} {factor:g}", pictures=differences))
    heads = ["untouched", *(f"Γ {percent(level)}" for level in MARGIN_LEVELS)]
    return draw_pictures(rows, heads=heads, title=title)


def write_contact_sheet(recordings: Sequence[Recording], path: Path, *, title: str | None = None) -> None:
    """Save a contact sheet as .png, .pdf or .svg; it appears when complete."""
    require_picture_path(path, example="preview.png")
    save_page(draw_contact_sheet(recordings, title=title), path)


def choose_margins(recording: Recording) -> list[int | None]:
    """Choose the frames nearest to Γ = 100, 80, 60, 40, 20 and 0 %; None where none is within 10 percentage points.

    100 % is taken from contact without slip, 0 % from full slip and the others from before the first full slip, where
    possible. Of frames equal to half a percentage point the one pressed hardest is chosen: at first touch the margin is
    100 % too, but little shows.
    """
    labelled, states = np.isfinite(recording.safety_margin), np.array(recording.contact_state)
    sliding = states == ContactState.FULL_SLIP
    wanted = {1.0: states == ContactState.CONTACT, 0.0: sliding}
    chosen: list[int | None] = []
    for nominal in MARGIN_LEVELS:
        nearest = None
        for fitting in (labelled, labelled & wanted.get(nominal, ~np.logical_or.accumulate(sliding))):
            distance = np.where(fitting, np.abs(recording.safety_margin - nominal), np.inf)
            if distance.min() < _REACHED_WITHIN:
                alike = distance <= distance.min() + _ALIKE
                nearest = int(np.argmax(np.where(alike, np.nan_to_num(recording.normal_force_n), -np.inf)))
        chosen.append(nearest)
    return chosen


def choose_untouched(recording: Recording) -> int | None:
    """Choose the middle frame of those without contact; None without any."""
    free = [index for index, state in enumerate(recording.contact_state) if state == ContactState.NO_CONTACT]
    return free[len(free) // 2] if free else None
