"""Draw the contact sheet of the README: python docs/sheet.py docs/images/sheet.jpg."""

import argparse
import io
from dataclasses import replace
from pathlib import Path

from PIL import Image

from sliplens.plots.sheets import draw_contact_sheet
from sliplens.plots.style import drawing_style
from sliplens.recordings import Recording
from sliplens.simulation import FLAT_GEL, PRESETS, SimulationRecipe, plan_trials, simulate_trial

WIDTH_PX = 1600


def first_trial(recipe: SimulationRecipe, condition: str) -> Recording:
    """Simulate the first trial of a condition at 30 frames a second."""
    plan = next(plan for plan in plan_trials(recipe) if plan.condition == condition)
    return simulate_trial(replace(plan, frames=240))


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
