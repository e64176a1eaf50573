"""The protocol of the thesis on simulated touch: both inputs trained by one recipe, tested on another day.

With its defaults it is the whole of it: 128,043 training frames of 224 x 224 pixels, 25 epochs, difference and raw:
minutes on a data-centre GPU, a day on two processors. The options make it smaller, and say so in what is printed.
"""

import argparse
import json
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # must be set before torch is imported

from sliplens.recordings import Dataset, load_dataset
from sliplens.simulation import PRESETS, simulate_dataset
from sliplens.training import evaluate, train

INPUTS = ("difference", "raw")
# what the thesis reports (Table 1)
THESIS = {"difference": {"dry_r2": 0.89, "wet_r2": 0.66}, "raw": {"dry_r2": 0.85, "wet_r2": 0.57}}


def train_and_test(data: Dataset, folder: Path, *, name: str, options: argparse.Namespace) -> dict[str, float]:
    """Train one input and score it on the test trials, dry and wet."""
    started = time.perf_counter()
    changes = {name: getattr(options, name) for name in ("epochs", "image_size", "max_minutes", "seed")}
    run = train(data, folder / name, input=name, recipe=options.recipe, **changes)
    minutes = (time.perf_counter() - started) / 60
    scores = evaluate(run, data).conditions
    found = {f"{condition}_{key}": getattr(one, key) for condition, one in scores.items() for key in ("r2", "mse")}
    return {**found, "minutes": minutes}


def main() -> None:
    """Print scores and minutes by input, as a table or as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="simulated data set; made with --preset if not given")
    parser.add_argument("--preset", default="thesis", choices=sorted(PRESETS))
    parser.add_argument("--frames-per-trial", type=int, help="fewer than the preset has")
    parser.add_argument("--recipe", default="thesis", choices=["thesis", "default"])
    parser.add_argument("--epochs", type=int)
    parser.add_argument("--image-size", type=int)
    parser.add_argument("--max-minutes", type=float, help="for each input")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--work", type=Path, help="folder to keep data and networks in; gone afterwards if not given")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        work = options.work or Path(scratch)
        if options.data is None:
            folder = work / "data"
            recipe = replace(PRESETS[options.preset], seed=options.seed)
            if options.frames_per_trial is not None:
                recipe = replace(recipe, frames_per_trial=options.frames_per_trial, frame_totals=None)
            data = simulate_dataset(folder, recipe)
        else:
            data = load_dataset(options.data)
        found = {name: train_and_test(data, work, name=name, options=options) for name in INPUTS}
    if options.json:
        asked = {key: value for key, value in vars(options).items() if key not in {"json", "work", "data"}}
        print(json.dumps({**found, "minutes": sum(one["minutes"] for one in found.values()), "asked": asked}))
        return
    for name, scores in found.items():
        print(name, ", ".join(f"{key} {value:.4f}" for key, value in scores.items()), f"(thesis: {THESIS[name]})")


if __name__ == "__main__":
    main()
