"""The deletion score of 42 images in batches, by an engine, against one image and one step at a time.

The plain loop makes each masked image and asks the network once for it, as the thesis did; the numbers must be alike.
It runs in a process of its own, with threads that wait as suits it best. Both are timed once more beside another
process that keeps one core busy.
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

from fairness import at_its_best, busy_process
from sliplens.errors import SliplensError
from sliplens.faithfulness.fills import get_fill
from sliplens.faithfulness.scoring import deletion_curves, random_order
from sliplens.models.checkpoint import load
from sliplens.models.engines import prepare
from sliplens.simulation import PRESETS, plan_trials, simulate_trial

IMAGES, LOOPED = 42, 2
"""Images that are scored, and how many of them one by one: enough to time a step, of which there are 224 an image."""
BESIDE_BUSY = 8
"""Images that are scored beside a process that keeps one core busy."""


def main() -> None:
    """Print the speed-up and the largest difference, as text or as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, default=Path("chromatouch-difference"), help="a trained network")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    try:
        trained = load(options.run)
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
    ready = prepare(trained.model, images, whole, passes=IMAGES * size)
    prepared_s = time.perf_counter() - started

    def measure(count: int) -> tuple[float, float, float]:
        """Seconds an image one by one and in batches, and the largest difference of their predictions."""
        slow_s, slow = at_its_best(one_by_one, options.run, images[:LOOPED].numpy(), orders[:LOOPED])
        started = time.perf_counter()
        found = deletion_curves(ready, images[:count], orders[:count], fill=fill)
        fast_s = (time.perf_counter() - started) / count
        return slow_s, fast_s, float(np.abs(found.predictions[:LOOPED] - slow).max())

    load_average = os.getloadavg()[0]
    slow_s, fast_s, error = measure(IMAGES)
    with busy_process():
        slow_busy_s, fast_busy_s, _ = measure(BESIDE_BUSY)
    fast_s += prepared_s / IMAGES

    result = {
        "speedup": slow_s / fast_s,
        "speedup_beside_busy": slow_busy_s / fast_busy_s,
        "max_difference": error,
        "engine": ready.name,
        "seconds_an_image": {"one by one": slow_s, "in batches": fast_s},
        "seconds_an_image_beside_busy": {"one by one": slow_busy_s, "in batches": fast_busy_s},
        "preparation_s": prepared_s,
        "load_average": load_average,
    }
    if options.json:
        print(json.dumps(result))
        return
    print(
        f"{result['speedup']:.1f} times as fast ({ready.name}), beside a busy process "
        f"{result['speedup_beside_busy']:.1f} times, largest difference {error:.1e}, load average {load_average:.1f}"
    )


@torch.no_grad()
def one_by_one(run: Path, pixels: np.ndarray, orders: np.ndarray) -> tuple[float, np.ndarray]:
    """Seconds an image that the plain loop takes, and what the network answers at each step."""
    model, images = load(run).model, torch.from_numpy(pixels)
    size = images.shape[-1]
    answers = np.empty((len(images), size))
    model(images[:1])  # the first pass prepares what all others use
    started = time.perf_counter()
    for index, (image, order) in enumerate(zip(images, orders, strict=True)):
        for step in range(1, size + 1):
            masked = image.clone().flatten(1)
            masked[:, order[: step * size]] = 0.5
            answers[index, step - 1] = float(model(masked.view(1, 3, size, size)))
    return (time.perf_counter() - started) / len(images), answers


if __name__ == "__main__":
    main()
