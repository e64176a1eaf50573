"""How long a first answer takes: a few images predicted, a first explanation to look at, a mistake refused.

    python benchmarks/start.py --json

Each command runs in a process of its own, as a user types it, on five images that are drawn here. `predict_s` and
`refused_s` end with the process, `explain_first_s` when the first picture of a map is on disk.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

_IMAGES, _SIZE = 5, 224


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one object of numbers")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        numbers = measure(Path(folder))
    print(json.dumps(numbers) if asked.json else "\n".join(f"{name}: {value:.2f}" for name, value in numbers.items()))


def measure(folder: Path) -> dict[str, float]:
    """Seconds of each command, and those that it kept processors busy, which other programs hardly change."""
    images = folder / "images"
    images.mkdir()
    draw_images(images)
    run("--version")  # what lies on disk is then in memory, as after any first command
    words, maps = ("chromatouch-difference", "--frames", str(images)), folder / "maps"
    actions = {
        "predict": partial(run, "predict", words[0], words[2], "-o", str(folder / "margins.csv")),
        "refused": partial(run, "predict", words[0], words[2], "-o", str(folder / "margins.txt"), code=2),
        "explain_first": partial(draw_first, maps, "explain", *words, "-o", str(maps)),
    }
    numbers = {}
    for name, action in actions.items():
        began, busy = time.perf_counter(), processor_s()
        action()
        numbers |= {f"{name}_s": time.perf_counter() - began, f"{name}_processor_s": processor_s() - busy}
    return numbers


def processor_s() -> float:
    """Seconds that ended commands kept processors busy."""
    times = os.times()
    return times.children_user + times.children_system


def draw_images(folder: Path) -> None:
    """Difference images of markers that moved a little more from frame to frame."""
    down, right = np.mgrid[:_SIZE, :_SIZE]
    centres = np.stack(np.meshgrid(np.arange(28, 200, 24), np.arange(28, 200, 24)), axis=-1).reshape(-1, 2)
    for number in range(_IMAGES):
        rest, moved = (
            np.max([np.exp(-((right - x - shift) ** 2 + (down - y) ** 2) / 30) for x, y in centres], axis=0)
            for shift in (0, number)
        )
        pixels = np.round(255 * np.abs(moved - rest)).astype(np.uint8)
        Image.fromarray(np.repeat(pixels[..., None], 3, axis=2)).save(folder / f"frame{number}.png")


def run(*words: str, code: int = 0) -> None:
    """Run a command, which must end with this exit code."""
    ended = subprocess.run([sys.executable, "-m", "sliplens", *words], capture_output=True, text=True, check=False)
    if ended.returncode != code:
        raise SystemExit(f"sliplens {' '.join(words)} ended with {ended.returncode}: {ended.stderr}")


def draw_first(folder: Path, *words: str) -> None:
    """Run a command until it has drawn a first map."""
    command = [sys.executable, "-m", "sliplens", *words]
    overlays = folder.with_name(f".{folder.name}.partial") / "overlays", folder / "overlays"
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as asked:
        while asked.poll() is None and not any(one.is_dir() and any(one.rglob("*.png")) for one in overlays):
            time.sleep(0.02)
        if asked.poll() not in {None, 0}:
            raise SystemExit(f"sliplens {' '.join(words)} ended with {asked.returncode}")
        asked.kill()


if __name__ == "__main__":
    main()
