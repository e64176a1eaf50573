"""Poly-CAM against a plain loop of one masked image at a time, on trained networks and frames of their own kind.

The exact map must be that of torch alone; the fast one, which starts with a budget and goes on until it expects to be
like the exact one, must be like it. All times are taken in this run, on the same frames, and those of the last frame
once more beside another process that keeps one core busy. The plain loop runs in a process of its own, with threads
that wait as suits it best; it is timed on every n-th channel of each layer, `--loop-passes` in all, and its time
scaled up: a pass costs the same whatever its mask.
"""

import argparse
import json
import os
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # threads that spin take the cores from the engine's own

import numpy as np
import torch
from torch import Tensor

from fairness import at_its_best, busy_process
from sliplens.explainers.attribution import pearson_r, resize, to_masks, top_overlap
from sliplens.explainers.cam import capture, find_layers
from sliplens.explainers.frames import FrameSelection, frames_from_dataset, frames_from_folder
from sliplens.explainers.poly_cam import PolyCam
from sliplens.files import machine, versions
from sliplens.models import Network
from sliplens.models.checkpoint import load
from sliplens.recordings import Dataset, load_dataset
from sliplens.simulation import SimulationRecipe, simulate_dataset

NETWORKS = ("chromatouch-difference", "thesis-raw")
REAL = Path(os.environ.get("SLIPLENS_REFERENCE", "../shared/reference")) / "chromatouch" / "difference"
BUDGET = 0.25
RECIPE = SimulationRecipe(dry_trials=8, wet_trials=0, frames_per_trial=24, seed=7)


def pick_inputs(trained: Network, data: Dataset, *, real: Path, count: int) -> tuple[Tensor, Tensor]:
    """Inputs and references: real difference images where the network takes them, then simulated frames."""
    chosen = [frames_from_dataset(trained, data, FrameSelection())]
    if trained.manifest.input == "difference" and real.is_dir():
        chosen.insert(0, frames_from_folder(trained, real))
    images = torch.cat([trained.encoding.normalise(one.images) for one in chosen])
    references = torch.cat([trained.encoding.normalise(one.references) for one in chosen])
    # first and last of each kind, and then between: small and large changes alike
    order = torch.linspace(0, len(images) - 1, min(count, len(images))).round().long()
    return images[order], references[order]


@torch.no_grad()
def plain_loop(run: Path, pixels: np.ndarray, untouched: np.ndarray, passes: int) -> tuple[float, int]:
    """Seconds that a loop of one masked image at a time takes for all channels, and the number that it timed."""
    model, image, reference = load(run).model, torch.from_numpy(pixels), torch.from_numpy(untouched)
    names = [layer.name for layer in find_layers(model, image[None])]
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
    return (time.perf_counter() - started) * total / measured, measured


def measure(run: Path, images: Tensor, references: Tensor, *, options: argparse.Namespace) -> dict[str, Any]:
    """Times, errors and likeness on the frames of one network, frame by frame."""
    trained, rows = load(run), []
    model = trained.model
    # torch alone and in batches: the loop's own map where its passes are too many to make them all
    plain = PolyCam(engine="torch")
    exact = PolyCam()
    fast = PolyCam(budget=options.budget)
    with_engine = exact(model, images[:1], reference=references[:1])  # prepares the engine, as the first frame does
    preparation = with_engine.seconds
    for image, reference in zip(images, references, strict=True):
        loop_s, _ = at_its_best(plain_loop, run, image.numpy(), reference.numpy(), options.loop_passes)
        whole = exact(model, image[None], reference=reference[None])
        quick = fast(model, image[None], reference=reference[None])
        oracle = plain(model, image[None], reference=reference[None])
        rows.append(
            {
                "prediction": float(whole.prediction),
                "change": float(whole.change),
                "loop_s": loop_s,
                "exact_s": whole.seconds,
                "fast_s": quick.seconds,
                "exact_error": float((whole.saliency - oracle.saliency).abs().max()),
                "pearson_r": pearson_r(whole.saliency[0], quick.saliency[0]),
                "top10_overlap": top_overlap(whole.saliency[0], quick.saliency[0]),
            }
        )
    with busy_process():
        busy_loop_s, _ = at_its_best(plain_loop, run, images[-1].numpy(), references[-1].numpy(), options.loop_passes)
        busy_exact_s = exact(model, images[-1:], reference=references[-1:]).seconds
    return {
        "exact_speedup_beside_busy": busy_loop_s / busy_exact_s,
        "exact_busy_s": busy_exact_s,
        "loop_busy_s": busy_loop_s,
        "exact_speedup": sum(row["loop_s"] for row in rows) / sum(row["exact_s"] for row in rows),
        "fast_speedup": sum(row["loop_s"] for row in rows) / sum(row["fast_s"] for row in rows),
        "exact_max_error": max(row["exact_error"] for row in rows),
        "fast_pearson_r": min(row["pearson_r"] for row in rows),
        "fast_top10_overlap": min(row["top10_overlap"] for row in rows),
        "first_frame_s": preparation,
        "engine": with_engine.engine,
        "image_size": trained.manifest.image_size,
        "frames": rows,
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, nargs="+", default=[Path(name) for name in NETWORKS], help="networks")
    parser.add_argument("--data", type=Path, help="data set with test trials; simulated if not given")
    parser.add_argument("--real", type=Path, default=REAL, help="folder of real difference images")
    parser.add_argument("--frames", type=int, default=6, help="for each network")
    parser.add_argument("--budget", type=float, default=BUDGET)
    parser.add_argument("--loop-passes", type=int, default=600, help="of the plain loop for each frame; 0 for all")
    parser.add_argument("--json", action="store_true", help="end with one line of JSON")
    options = parser.parse_args(arguments)
    load_average = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as scratch:
        data = simulate_dataset(Path(scratch) / "data", RECIPE) if options.data is None else load_dataset(options.data)
        found = {}
        for run in options.run:
            images, references = pick_inputs(load(run), data, real=options.real, count=options.frames)
            found[str(run)] = measure(run, images, references, options=options)
    result: dict[str, Any] = {
        key: least(one[key] for one in found.values())
        for key, least in (
            ("exact_speedup", min),
            ("exact_speedup_beside_busy", min),
            ("exact_max_error", max),
            ("fast_speedup", min),
            ("fast_pearson_r", min),
            ("fast_top10_overlap", min),
        )
    }
    more = {"budget": options.budget, "threads": torch.get_num_threads(), "load_average": load_average}
    result |= {**more, "networks": found, "machine": machine(), "versions": versions()}
    print(json.dumps(result, indent=None if options.json else 2))


if __name__ == "__main__":
    main()
