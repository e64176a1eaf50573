"""The deletion score of 42 images in batches, by an engine, against one image and one step at a time.

The plain loop makes each masked image and asks the network once for it, as the thesis did; the numbers must be alike.
"""

import argparse
import json
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # must be set before torch is imported

import numpy as np
import torch

from sliplens.errors import SliplensError
from sliplens.faithfulness import deletion_curves, get_fill, random_order
from sliplens.models import load_checkpoint
from sliplens.models.checkpoint import find_run
from sliplens.models.engines import prepare
from sliplens.simulation import PRESETS, plan_trials, simulate_trial

IMAGES, LOOPED = 42, 2
"""Images that are scored, and how many of them one by one: enough to time a step, of which there are 224 an image."""


def main() -> None:
    """Print the speed-up and the largest difference, as text or as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, default=Path("chromatouch-difference"), help="a trained network")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    try:
        trained = load_checkpoint(find_run(options.run))
    except SliplensError as error:
        sys.exit(f"{Path(__file__).name}: {error}")
    trial = simulate_trial(plan_trials(PRESETS["small"])[0])
    rows = np.linspace(4, len(trial) - 1, IMAGES).round().astype(int)
    images = trained.encode(trial.frames[rows], trial.reference)
    size = images.shape[-1]
    rng = np.random.default_rng(0)
    orders = np.stack([random_order((size, size), rng=rng) for _ in images])
    fill, whole = get_fill("grey"), trained.predict(images)

    trained.predict(images[:1])  # the first call prepares what all others use
    started = time.perf_counter()
    slow = one_by_one(trained.model, images[:LOOPED], orders[:LOOPED])
    slow_s = (time.perf_counter() - started) / LOOPED

    started = time.perf_counter()
    ready = prepare(trained.model, images, whole, passes=IMAGES * size)
    prepared_s = time.perf_counter() - started
    found = deletion_curves(ready, images, orders, fill=fill)
    fast_s = (time.perf_counter() - started) / IMAGES

    told = {
        "speedup": slow_s / fast_s,
        "max_difference": float(np.abs(found.predictions[:LOOPED] - slow).max()),
        "engine": ready.name,
        "seconds_an_image": {"one by one": slow_s, "in batches": fast_s},
        "preparation_s": prepared_s,
    }
    if options.json:
        print(json.dumps(told))
        return
    print(f"{told['speedup']:.1f} times as fast ({ready.name}), largest difference {told['max_difference']:.1e}")


@torch.no_grad()
def one_by_one(model: torch.nn.Module, images: torch.Tensor, orders: np.ndarray) -> np.ndarray:
    """The plain loop."""
    size = images.shape[-1]
    answers = np.empty((len(images), size))
    for index, (image, order) in enumerate(zip(images, orders, strict=True)):
        for step in range(1, size + 1):
            masked = image.clone().flatten(1)
            masked[:, order[: step * size]] = 0.5
            answers[index, step - 1] = float(model(masked.view(1, 3, size, size)))
    return answers


if __name__ == "__main__":
    main()
