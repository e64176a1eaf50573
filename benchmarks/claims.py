"""The claims of the thesis on the networks that come with the package, and how a moved camera changes these.

Simulates the sensor of the networks (preset `thesis`, seed 0, as `replica.py`), studies the networks on training trials
as the thesis did, and on test trials, shifts the camera, and writes the record that the report shows
(`src/sliplens/report/thesis.json`). Continues where it was interrupted.
"""

import argparse
import json
import os
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # must be set before torch is imported

import numpy as np
import torch
from jaxtyping import UInt8
from torch.nn import functional

import replica
import sliplens as sl
from sliplens.cli.console import Terminal
from sliplens.codec import save_record
from sliplens.plots.style import input_name
from sliplens.recordings import Dataset
from sliplens.report.claims import THREE, ShiftPoint, ThesisRecord, judge_claims, method_rows
from sliplens.report.results import load_results
from sliplens.results.study import QUICK_METHODS, StudyConfig

NETWORKS = {"difference": "thesis-difference", "raw": "thesis-raw"}
SHIFTS_PX = (0.0, 0.25, 0.5, 1.0, 2.0)
STUDIES = {
    "train": StudyConfig(methods=THREE, tests=("score", "map-quality")),
    "test": StudyConfig(split="test", trials=6, methods=(*THREE, *QUICK_METHODS), tests=("score", "truth")),
}
RECORD = Path(__file__).resolve().parents[1] / "src" / "sliplens" / "report" / "thesis.json"
RESAMPLES = 500


def shift_image(frames: UInt8[np.ndarray, "frames height width 3"], *, x_px: float, y_px: float) -> np.ndarray:
    """Shift images by a part of a pixel, bicubic; the border is repeated."""
    images = torch.from_numpy(frames).permute(0, 3, 1, 2).float()
    height, width = images.shape[-2:]
    y, x = torch.meshgrid(torch.arange(height) - y_px, torch.arange(width) - x_px, indexing="ij")
    grid = torch.stack([(2 * x + 1) / width - 1, (2 * y + 1) / height - 1], dim=-1).float()
    shifted = functional.grid_sample(
        images, grid.expand(len(images), -1, -1, -1), mode="bicubic", padding_mode="border", align_corners=False
    )
    return shifted.clamp(0, 255).round().byte().permute(0, 2, 3, 1).numpy()


def measure_shift(data: Dataset) -> tuple[tuple[ShiftPoint, ...], str]:
    """R2 on dry test trials whose frames and reference are shifted, each trial in one of eight directions."""
    networks = {name: sl.load(network) for name, network in NETWORKS.items()}
    predicted: dict[str, list[list[np.ndarray]]] = {name: [[] for _ in SHIFTS_PX] for name in NETWORKS}
    labels = []
    infos = data.select(split="test", condition="dry")
    for number, info in enumerate(infos):
        recording, angle = data.load(info, truth=False), np.pi / 4 * (number % 8)
        rows = np.flatnonzero(recording.labelled & np.isfinite(recording.safety_margin))[::3]
        labels.append(recording.safety_margin[rows])
        for at, shift in enumerate(SHIFTS_PX):
            frames, reference = recording.frames[rows], recording.reference
            if shift:
                both = np.concatenate([frames, reference[None]])
                both = shift_image(both, x_px=shift * np.cos(angle), y_px=shift * np.sin(angle))
                frames, reference = both[:-1], both[-1]
            for name, network in networks.items():
                predicted[name][at].append(network.predict(network.encode(frames, reference)).numpy())

    def r2(some: list[np.ndarray], trials: np.ndarray) -> float:
        true, values = (np.concatenate([each[trial] for trial in trials]) for each in (labels, some))
        return float(1 - np.mean((values - true) ** 2) / true.var())

    def ends(some: list[np.ndarray]) -> tuple[float, float, float]:
        rng, count = np.random.default_rng(0), len(labels)
        drawn = [r2(some, rng.integers(count, size=count)) for _ in range(RESAMPLES)]
        low, high = np.quantile(drawn, [0.025, 0.975]).tolist()
        return r2(some, np.arange(count)), low, high

    points = tuple(
        ShiftPoint(shift_px=shift, r2={name: ends(predicted[name][at]) for name in NETWORKS})
        for at, shift in enumerate(SHIFTS_PX)
    )
    return points, f"{sum(map(len, labels))} frames of {len(infos)} trials of six days"


def main() -> None:
    """Make the record, and print it as a table or as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path, help="folder of the data set and the studies")
    parser.add_argument("--frames", type=int, default=40, help="frames of a trial")
    parser.add_argument("--on", default="processes=2")
    parser.add_argument("--write", action="store_true", help="replace the record of the package")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    replica.FRAMES = options.frames
    data = replica.simulate(options.work, seed=0, quiet=options.json)
    for name, config in STUDIES.items():
        out = options.work / f"study-{name}"
        sl.run_study(data, list(NETWORKS.values()), config, out=out, on=options.on, on_progress=Terminal())
    sample, held_out = (load_results(options.work / f"study-{name}") for name in STUDIES)
    choice, tested = sample.study.choice, held_out.study.choice
    assert choice is not None
    assert tested is not None
    shift, frames = measure_shift(data)
    errors = ", ".join(f"{100 * error:.0f} ({input_name(name).lower()})" for name, error in tested.mean_error.items())
    record = ThesisRecord(
        sample=f"Maps of training trials, as in the thesis. {choice.summary} Truth and the rows of test trials: "
        f"{len(tested.trials)} dry trials of {len({frame.day for frame in tested.frames})} test days, the best "
        f"predicted of {tested.considered}, off by {errors} points.",
        claims=judge_claims(sample, held_out, rng=np.random.default_rng(0)),
        methods=method_rows(held_out),
        shift=shift,
        shift_frames=frames,
    )
    if options.write:
        save_record(record, RECORD)
    if options.json:
        outcomes = {f"{row.claim}, {row.subject}": [row.outcome, row.thesis, row.ours] for row in record.claims}
        print(json.dumps({"claims": outcomes, "shift": {point.shift_px: point.r2 for point in shift}}))
        return
    for row in record.claims:
        print(f"{row.outcome:14} {row.source:16} {row.subject:18} {row.claim}: {row.thesis} | {row.ours}")


if __name__ == "__main__":
    main()
