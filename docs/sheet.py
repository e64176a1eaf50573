"""Draw the contact sheet of the README: python docs/sheet.py docs/images/sheet.jpg."""

import argparse
import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from textwrap import shorten

import numpy as np
from jaxtyping import UInt8
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image
from scipy.ndimage import binary_dilation

from sliplens.images import absolute_difference
from sliplens.plots import style
from sliplens.plots.saliency import PictureRow, draw_pictures
from sliplens.plots.sheets import TIMES, brighten, brightening, choose_margins
from sliplens.plots.style import drawing_style
from sliplens.recordings import ContactState, Recording
from sliplens.recordings.trial import OUTSIDE, STICKS
from sliplens.results.explanation import MARGIN_LEVELS
from sliplens.simulation import FLAT_GEL, PRESETS, SimulationRecipe, plan_trials, simulate_trial

WIDTH_PX = 1600


def first_trial(recipe: SimulationRecipe, condition: str) -> Recording:
    """Simulate the first trial of a condition at 30 frames a second."""
    plan = next(plan for plan in plan_trials(recipe) if plan.condition == condition)
    return simulate_trial(replace(plan, frames=240))


def paint_outlines(camera: UInt8[np.ndarray, "height width 3"], contact: UInt8[np.ndarray, "height width"]) -> None:
    """Paint white around the contact, and blue inside its stick zone, both with a dark rim: neither hides the other."""
    thick, (touches, loose) = max(1, len(contact) // 224), (contact != OUTSIDE, contact != STICKS)
    for zone, inner in ((touches, "white"), (loose, style.SKY)):
        for steps, colour in ((2, style.BLACK), (1, inner)):
            rim = binary_dilation(zone, iterations=steps * thick) & ~zone
            camera[rim] = np.round(255 * np.array(to_rgb(colour)))


def choose_untouched(recording: Recording) -> int | None:
    """Choose the middle frame of those without contact; None without any."""
    free = [index for index, state in enumerate(recording.contact_state) if state == ContactState.NO_CONTACT]
    return free[len(free) // 2] if free else None


def draw_contact_sheet(recordings: Sequence[Recording]) -> Figure:
    """Draw two rows a trial: frames from the untouched sensor to full slip, and their differences.

    Frames are those of `choose_untouched` and `choose_margins`; difference images are brightened by one factor, so that
    trials compare. Outlines of the true contact (white) and stick zone (blue) lie over the frames of simulated trials.
    """
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
            camera = (recording.reference if index is None else recording.frames[index]).copy()
            difference = brighten(absolute_difference(camera, recording.reference), factor)
            if index is None and column:
                camera, difference = (np.full_like(picture, 255) for picture in (camera, difference))
            elif index is not None and recording.truth is not None:
                paint_outlines(camera, recording.truth.contact_map[index])
            cameras.append(camera)
            differences.append(difference)
            moment = "" if index is None else f"{recording.time_s[index]:.1f} s, {recording.contact_state[index]}"
            words.append(moment or ("no frame" if column else "reference"))
        name = f"{shorten(recording.trial, 36, placeholder='…')}, {recording.condition}, day {recording.day}"
        rows.append(PictureRow(name=name, pictures=cameras, words=words))
        rows.append(PictureRow(name=f"difference {TIMES} {factor:g}", pictures=differences))
    heads = ["untouched", *(f"Γ {style.percent(level)}" for level in MARGIN_LEVELS)]
    return draw_pictures(rows, heads=heads)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path)
    output: Path = parser.parse_args().output
    dome = PRESETS["small"]
    recordings = [
        first_trial(dome, "dry"),
        first_trial(dome, "wet"),
        first_trial(replace(dome, sensor=FLAT_GEL, release=True), "dry"),
    ]
    buffer = io.BytesIO()
    with drawing_style():
        draw_contact_sheet(recordings).savefig(buffer, format="png", dpi=150)
    picture = Image.open(buffer).convert("RGB")
    size = (WIDTH_PX, round(picture.height * WIDTH_PX / picture.width))
    picture.resize(size, Image.Resampling.LANCZOS).save(output, quality=80, subsampling=0, optimize=True)
