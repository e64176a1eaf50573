"""Poly-CAM against a plain loop of one masked image at a time, on two networks and frames of their own kind.

The exact map must be that of torch alone, and the fast one, from a quarter of the channels on, must resemble it. All
times are taken in one run on the same frames. The plain loop is timed on every n-th channel of each layer,
`--loop-passes` in all, and its time scaled up: a pass costs the same whatever its mask. `python benchmarks/poly_cam.py
--frames 1 --loop-passes 40 --json` takes five minutes on two quiet cores, mostly for the exact map by torch alone.
"""

import argparse
import json
import multiprocessing
import os
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # threads that spin take the cores from the engine's own

import numpy as np
import torch
from torch import Tensor

from sliplens.explainers.attribution import pearson_r, resize, to_masks, top_overlap
from sliplens.explainers.cam import capture, find_layers
from sliplens.explainers.frames import FrameSelection, frames_from_dataset, frames_from_folder
from sliplens.explainers.poly_cam import PolyCam
from sliplens.files import machine, versions
from sliplens.models import Network
from sliplens.models.checkpoint import load
from sliplens.recordings import Dataset
from sliplens.simulation import SimulationRecipe, simulate_dataset

NETWORKS = ("chromatouch-difference", "thesis-raw")
REAL = Path(os.environ.get("SLIPLENS_REFERENCE", "../shared/reference")) / "chromatouch" / "difference"
BUDGET = 0.25
RECIPE = SimulationRecipe(dry_trials=8, wet_trials=0, frames_per_trial=24, seed=7)


def pick_inputs(trained: Network, data: Dataset, *, count: int) -> tuple[Tensor, Tensor]:
    """Return inputs and references: real difference images where the network takes them, then simulated frames."""
    frames = [frames_from_dataset(trained, data, FrameSelection())]
    if trained.manifest.input == "difference" and REAL.is_dir():
        frames.insert(0, frames_from_folder(trained, REAL))
    images = torch.cat([trained.encoding.normalise(some.images) for some in frames])
    references = torch.cat([trained.encoding.normalise(some.references) for some in frames])
    # first and last of each kind, and then between: small and large changes alike
    order = torch.linspace(0, len(images) - 1, min(count, len(images))).round().long()
    return images[order], references[order]


@torch.no_grad()
def plain_loop(network: str, pixels: np.ndarray, untouched: np.ndarray, passes: int) -> float:
    """Return the seconds of a loop of one masked image at a time over all channels."""
    model, image, reference = load(Path(network)).model, torch.from_numpy(pixels), torch.from_numpy(untouched)
    names = list(find_layers(model, image[None]))
    with capture(model, names) as outputs:
        model(image[None])
    masks = [to_masks(outputs[name][0]) for name in names]
    total = sum(map(len, masks))
    step, measured, started = max(1, round(2 * total / passes)) if passes else 1, 0, time.perf_counter()
    for layer in masks:
        for channel in range(0, len(layer), step):
            added = (image - reference) * resize(layer[channel], (image.shape[-2], image.shape[-1]))
            model((reference + added)[None])
            model((image - added)[None])
            measured += 1
    return (time.perf_counter() - started) * total / measured


def faster_loop(*inputs: Any) -> float:
    """Return the seconds of `plain_loop` under the better of two ways in which idle threads wait.

    Threads that sleep (`OMP_WAIT_POLICY=passive`) make a loop of small batches up to three times slower where waking a
    core takes long, as on virtual machines. The loop runs in a process of its own each way.
    """
    seconds = []
    for spins in ({}, {"GOMP_SPINCOUNT": "300000"}):
        os.environ.update(spins)
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as process:
            seconds.append(process.submit(plain_loop, *inputs).result())
    os.environ.pop("GOMP_SPINCOUNT")
    return min(seconds)


def measure(network: str, data: Dataset, *, frames: int, passes: int) -> dict[str, Any]:
    """Return times, errors and likeness on the frames of one network, frame by frame."""
    trained, rows = load(Path(network)), []
    images, references = pick_inputs(trained, data, count=frames)
    maps = {"oracle": PolyCam(engine="torch"), "exact": PolyCam(), "fast": PolyCam(budget=BUDGET)}
    first = maps["exact"](trained.model, images[:1], reference=references[:1])  # prepares the engine
    for image, reference in zip(images, references, strict=True):
        loop_s = faster_loop(network, image.numpy(), reference.numpy(), passes)
        made = {name: method(trained.model, image[None], reference=reference[None]) for name, method in maps.items()}
        exact, fast = made["exact"], made["fast"]
        shown = {name: attribution.influence / attribution.influence.amax() for name, attribution in made.items()}
        rows.append(
            {
                "loop_s": loop_s,
                "exact_s": exact.seconds,
                "fast_s": fast.seconds,
                "exact_error": float((shown["exact"] - shown["oracle"]).abs().max()),
                "pearson_r": pearson_r(shown["exact"][0], shown["fast"][0]),
                "top10_overlap": top_overlap(shown["exact"][0], shown["fast"][0]),
            }
        )
    return {
        "exact_speedup": sum(row["loop_s"] for row in rows) / sum(row["exact_s"] for row in rows),
        "fast_speedup": sum(row["loop_s"] for row in rows) / sum(row["fast_s"] for row in rows),
        "exact_max_error": max(row["exact_error"] for row in rows),
        "fast_pearson_r": min(row["pearson_r"] for row in rows),
        "fast_top10_overlap": min(row["top10_overlap"] for row in rows),
        "engine": first.engine,
        "frames": rows,
    }


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=6, help="for each network")
    parser.add_argument("--loop-passes", type=int, default=600, help="of the plain loop for each frame; 0 for all")
    parser.add_argument("--json", action="store_true", help="end with one line of JSON")
    options = parser.parse_args()
    load_average = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as scratch:
        data = simulate_dataset(Path(scratch) / "data", RECIPE)
        found = {name: measure(name, data, frames=options.frames, passes=options.loop_passes) for name in NETWORKS}
    least = {
        name: min(each[name] for each in found.values()) for name in found[NETWORKS[0]] if name.endswith("_speedup")
    }
    least |= {name: min(each[name] for each in found.values()) for name in ("fast_pearson_r", "fast_top10_overlap")}
    result = {
        **least,
        "exact_max_error": max(each["exact_max_error"] for each in found.values()),
        "threads": torch.get_num_threads(),
        "load_average": load_average,
        "networks": found,
        "machine": machine(),
        "versions": versions(),
    }
    print(json.dumps(result, indent=None if options.json else 2))


if __name__ == "__main__":
    main()
