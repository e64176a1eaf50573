"""How fast trials are simulated, and whether memory stays flat as the frames grow.

Each memory figure is taken in a fresh process: the peak of a process never falls.
"""

import argparse
import json
import multiprocessing
import resource
import sys
import tempfile
import time
from pathlib import Path

import torch

from sliplens.recordings.store import save_recording
from sliplens.simulation import SimulationRecipe, plan_trials, simulate_dataset, simulate_trial
from sliplens.simulation.filming import batches
from sliplens.simulation.trials import prepare_trial


def frames_per_second(frames: int, device: str) -> float:
    """Frames drawn in a second, markers moved and noise chosen before; the first batches warm up."""
    _, film = prepare_trial(plan_trials(SimulationRecipe(frames_per_trial=frames))[0])

    def draw() -> float:
        start = time.perf_counter()
        for part in batches(frames, device=device):
            film.draw(part, device=device)
        if device == "cuda":
            torch.cuda.synchronize()
        return frames / (time.perf_counter() - start)

    draw()
    return draw()


def stored_frames_per_second(frames: int) -> float:
    """Frames simulated, labelled and written to disk in a second: what `sliplens simulate` does."""
    plan = plan_trials(SimulationRecipe(frames_per_trial=frames))[0]
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        save_recording(simulate_trial(plan), Path(folder) / "trial.parquet")
        return frames / (time.perf_counter() - start)


def peak_rss_mb(trials: int, frames: int) -> float:
    """Peak resident memory of a fresh process that simulates a data set, in megabytes."""
    context = multiprocessing.get_context("spawn")
    with context.Pool(1) as pool:
        return pool.apply(_simulate_and_measure, (trials, frames))


def _simulate_and_measure(trials: int, frames: int) -> float:
    with tempfile.TemporaryDirectory() as folder:
        simulate_dataset(Path(folder), SimulationRecipe(dry_trials=trials, wet_trials=0, frames_per_trial=frames))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=400, help="frames to time")
    parser.add_argument(
        "--trials", type=int, default=3, help="trials of the smaller data set; the larger has ten times"
    )
    parser.add_argument("--trial-frames", type=int, default=40, help="frames in each of its trials")
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    arguments = parser.parse_args()
    numbers = {
        "frames_per_s_cpu": frames_per_second(arguments.frames, "cpu"),
        # a GPU needs more work to keep it busy
        "frames_per_s_gpu": frames_per_second(10 * arguments.frames, "cuda") if torch.cuda.is_available() else None,
        "stored_frames_per_s": stored_frames_per_second(arguments.frames),
        "peak_rss_mb_1x": peak_rss_mb(arguments.trials, arguments.trial_frames),
        "peak_rss_mb_10x": peak_rss_mb(10 * arguments.trials, arguments.trial_frames),
    }
    for name, value in numbers.items():
        print(f"{name:20s} {'-' if value is None else f'{value:.1f}'}")
    if arguments.json:
        print(json.dumps(numbers))


if __name__ == "__main__":
    main()
