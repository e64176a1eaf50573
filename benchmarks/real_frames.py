"""What a network that was trained on simulated touch alone reads from real difference images.

The network that comes with the package by default; the images are those of `SLIPLENS_REFERENCE`, or of any folder whose
files are named as `image_433_20.png`, with the safety margin in percent at the end.
"""

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

from sliplens.errors import SliplensError
from sliplens.models.checkpoint import load
from sliplens.study import frames_from_folder

NETWORK = "chromatouch-difference"
FRAMES = Path(os.environ.get("SLIPLENS_REFERENCE", "../shared/reference")) / "chromatouch" / "difference"


def read_real_frames(run: Path, frames: Path) -> dict[str, Any]:
    """Answers of a network to real frames, their mean absolute error, and whether their order is right."""
    trained = load(run)
    chosen = frames_from_folder(trained, frames, labels_in_names=True)
    estimate = trained.estimate(trained.encoding.normalise(chosen.images))
    labels = chosen.safety_margin.astype(np.float64)
    # of frames with one label none need come first
    pairs = [(one, other) for one in range(len(labels)) for other in range(len(labels)) if labels[one] > labels[other]]
    told: dict[str, Any] = {
        "mae": float(np.abs(estimate.margin - labels).mean()),
        "order_right": all(estimate.margin[one] > estimate.margin[other] for one, other in pairs),
        "predictions": {
            name: round(float(margin), 4) for name, margin in zip(chosen.ids, estimate.margin, strict=True)
        },
        "labels": {name: round(float(label), 4) for name, label in zip(chosen.ids, labels, strict=True)},
    }
    interval = estimate.interval(0.9) if estimate.calibration else None
    if interval is not None:
        told["within_90"] = float(np.mean((labels >= interval[0]) & (labels <= interval[1])))
    return told


def main() -> None:
    """Print the answers, as a table or as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, default=Path(NETWORK), help="a trained network, or one of the package")
    parser.add_argument("--frames", type=Path, default=FRAMES, help="folder of images whose names end in _GG.png")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    try:
        told = read_real_frames(options.run, options.frames)
    except SliplensError as error:
        sys.exit(f"{Path(__file__).name}: {error}")
    if options.json:
        print(json.dumps(told))
        return
    for name, margin in told["predictions"].items():
        print(f"{name:24} true {100 * told['labels'][name]:4.0f} %   read {100 * margin:6.1f} %")
    print(f"mean absolute error {told['mae']:.3f}, order {'right' if told['order_right'] else 'wrong'}")


if __name__ == "__main__":
    main()
