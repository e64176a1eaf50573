"""What a network that was trained on simulated touch alone reads from real difference images.

The network that comes with the package by default; the images are those of `SLIPLENS_REFERENCE`, or of any folder whose
files are named as `image_433_20.png`, with the safety margin in percent at the end. Five frames of one trial say
little, the less as the simulator was fitted to them: so each answer is told with its interval, the error also where the
frames are moved a little (2 px, 2 degrees and 3 % of their size at most, drawn evenly). Nothing is to be chosen by
these figures.
"""

import argparse
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn import functional

from sliplens.explainers.frames import frames_from_folder
from sliplens.models.checkpoint import load

NETWORK = "chromatouch-difference"
FRAMES = Path(os.environ.get("SLIPLENS_REFERENCE", "../shared/reference")) / "chromatouch" / "difference"


NOTE = "n = 1 trial, simulator fitted to these frames"
SHIFT_PX, TURN_DEG, SCALE = 2.0, 2.0, 0.03


def jitter(images: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
    """Images (batch, 3, size, size), each moved, turned and scaled a little; black where nothing was seen."""
    count, size = len(images), images.shape[-1]
    turn, scale = np.radians(rng.uniform(-TURN_DEG, TURN_DEG, count)), rng.uniform(1 - SCALE, 1 + SCALE, count)
    shift = rng.uniform(-SHIFT_PX, SHIFT_PX, (2, count)) * 2 / 224
    along, across = np.cos(turn) / scale, np.sin(turn) / scale
    rows = [[along, -across, shift[0]], [across, along, shift[1]]]
    grid = functional.affine_grid(
        torch.from_numpy(np.array(rows)).permute(2, 0, 1).float(), [count, 3, size, size], align_corners=False
    )
    return functional.grid_sample(images, grid, align_corners=False).clamp(0, 1)


def read_real_frames(run: Path, frames: Path, *, draws: int = 40) -> dict[str, Any]:
    """Answers of a network to real frames, their mean absolute error, and whether their order is right."""
    trained = load(run)
    chosen = frames_from_folder(trained, frames, labels_in_names=True)
    inputs = trained.encoding.normalise(chosen.images)
    estimate = trained.estimate(inputs)
    labels = chosen.safety_margin.astype(np.float64)
    # of frames with one label none need come first
    pairs = [(one, other) for one in range(len(labels)) for other in range(len(labels)) if labels[one] > labels[other]]
    rng = np.random.default_rng(0)
    moved = np.stack([trained.estimate(jitter(inputs, rng)).margin for _ in range(draws)])
    off = np.abs(moved - labels).mean(axis=1)
    told: dict[str, Any] = {
        "note": NOTE,
        "mae": float(np.abs(estimate.margin - labels).mean()),
        "jittered_mae": {"mean": float(off.mean()), "sd": float(off.std(ddof=1)), "draws": draws},
        "jittered_sd": dict(zip(chosen.ids, moved.std(axis=0, ddof=1).round(4).tolist(), strict=True)),
        "order_right": all(estimate.margin[one] > estimate.margin[other] for one, other in pairs),
        "predictions": {
            name: round(float(margin), 4) for name, margin in zip(chosen.ids, estimate.margin, strict=True)
        },
        "labels": {name: round(float(label), 4) for name, label in zip(chosen.ids, labels, strict=True)},
    }
    interval = estimate.interval(0.9) if estimate.calibration else None
    if interval is not None:
        low, high = (np.round(ends, 4).tolist() for ends in interval)
        told["intervals_90"] = dict(zip(chosen.ids, zip(low, high, strict=True), strict=True))
        told["within_90"] = float(np.mean((labels >= interval[0]) & (labels <= interval[1])))
    return told


def main() -> None:
    """Print the answers as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, default=Path(NETWORK), help="a trained network, or one of the package")
    parser.add_argument("--frames", type=Path, default=FRAMES, help="folder of images whose names end in _GG.png")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    told = read_real_frames(options.run, options.frames)
    print(json.dumps(told, indent=None if options.json else 2))


if __name__ == "__main__":
    main()
