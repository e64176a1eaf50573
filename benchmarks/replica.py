"""The networks of the thesis on a simulated sensor: trained from scratch, and tested on six days of their own.

One sensor, as the preset `thesis` draws it: 160 trials of three days train, 20 of days two and three validate, and six
more days test, each with 11 dry and 11 wet trials. Each network is trained by

    python benchmarks/replica.py WORK --train --inputs difference raw --seeds 0 1 2

which simulates the data set into WORK/data, trains into WORK/INPUT-SEED, and continues where it was interrupted. The
recipe: ShuffleNetV2 x1.0 from scratch, 112 px, mean squared error, AdamW with one cosine descent from 1e-3, batches of
64, noise alone as augmentation. `--optimizer ranger21` trains with the optimizer of the thesis, `--start-from NETWORK
--epochs 3` continues from a network.

Without `--train` it prints the R2 of the networks in WORK on the test days, dry and wet: the mean over networks and its
lower and upper end, of 95 % intervals that resample networks, then days, then trials. `train_trials_within_3` counts
the training trials whose predictions lie within 3 points at margins of 0, 20, ... 100 %, for each seed: of each input,
and of both together. Data of seed 1 are for choosing the recipe and the wet friction; seed 0 is reported.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

import sliplens as sl
from sliplens.cli.console import Terminal
from sliplens.errors import SliplensError
from sliplens.recordings import Dataset
from sliplens.results.evaluation import ScoredFrames

TEST_DAYS, TRIALS_A_DAY = 6, 11
LEVELS = np.linspace(0, 1, 6)
"""Margins at which training trials are compared with their labels, as in the thesis."""
WITHIN = 0.03
RESAMPLES = 2000


def simulate(work: Path, *, seed: int, quiet: bool, frames: int = 200) -> Dataset:
    """Simulate the sensor, three training days and the test days, or load what is there."""
    return sl.simulate(
        work / "data",
        preset="thesis",
        frames_per_trial=frames,
        days=3 + TEST_DAYS,
        test_days=TEST_DAYS,
        dry_trials=(100, 40, 40, *[TRIALS_A_DAY] * TEST_DAYS),
        wet_trials=TRIALS_A_DAY * TEST_DAYS,
        seed=seed,
        on_progress=None if quiet else Terminal(),
    )


def train(work: Path, data: Dataset, options: argparse.Namespace) -> None:
    """Train the networks one after the other."""
    for seed in options.seeds:
        for name in options.inputs:
            sl.train(
                data,
                out=work / f"{name}-{seed}",
                input=name,
                recipe="thesis",
                optimizer=options.optimizer,
                learning_rate=8e-4 if options.optimizer == "ranger21" else 1e-3,
                batch_size=64,
                augmentation="noise",
                image_size=112,
                epochs=options.epochs,
                start_from=options.start_from,
                seed=seed,
                on_progress=Terminal(),
            )


def r2(frames: ScoredFrames, rows: Int[np.ndarray, " rows"]) -> float:
    """Share of the variance of the labels that the predictions explain."""
    labels = frames.safety_margin[rows]
    return float(1 - np.mean((frames.prediction[rows] - labels) ** 2) / labels.var())


def resample(networks: Sequence[ScoredFrames], *, wet: bool) -> Iterator[float]:
    """Mean R2 of networks, days and trials drawn with replacement, each within the one before."""
    rng = np.random.default_rng(0)
    first = networks[0]
    of_condition = first.condition == ("wet" if wet else "dry")
    trials = {
        day: [np.flatnonzero(first.trial == name) for name in np.unique(first.trial[of_condition & (first.day == day)])]
        for day in np.unique(first.day[of_condition]).tolist()
    }
    days = list(trials)
    for _ in range(RESAMPLES):
        rows = []
        for day in rng.choice(days, len(days)):
            some = trials[int(day)]
            rows += [some[at] for at in rng.integers(len(some), size=len(some))]
        chosen = np.concatenate(rows)
        yield float(np.mean([r2(networks[at], chosen) for at in rng.integers(len(networks), size=len(networks))]))


def test_r2(networks: Sequence[ScoredFrames]) -> dict[str, Any]:
    """R2 over all test days, its interval, and that of each network."""
    found: dict[str, Any] = {}
    for condition in ("dry", "wet"):
        rows = np.flatnonzero(networks[0].condition == condition)
        each = [r2(one, rows) for one in networks]
        drawn = list(resample(networks, wet=condition == "wet"))
        found[condition] = float(np.mean(each))
        found[f"{condition}_low"], found[f"{condition}_high"] = np.quantile(drawn, [0.025, 0.975]).tolist()
        found[f"{condition}_networks"] = each
    return found


def close_trials(frames: ScoredFrames) -> set[str]:
    """Trials whose frames nearest to each of the levels are predicted within 3 points."""
    close = set()
    for trial in np.unique(frames.trial):
        rows = np.flatnonzero(frames.trial == trial)
        labels: Float[np.ndarray, " frames"] = frames.safety_margin[rows]
        at = rows[np.abs(labels[:, None] - LEVELS).argmin(axis=0)]
        if np.abs(frames.prediction[at] - frames.safety_margin[at]).max() <= WITHIN:
            close.add(str(trial))
    return close


def measure(work: Path, data: Dataset, options: argparse.Namespace) -> dict[str, Any]:
    """Predict test and training trials by every network there is."""
    scores: dict[str, Any] = {"r2": {}, "train_mse": {}, "train_trials_within_3": {}}
    within: dict[int, list[set[str]]] = {}
    for name in options.inputs:
        networks = []
        for seed in options.seeds:
            run = sl.load(work / f"{name}-{seed}")
            progress = None if options.json else Terminal()
            networks.append(sl.evaluate(run, data, split="test", on_progress=progress).predictions)
            seen = sl.evaluate(run, data, split="train", on_progress=progress).predictions
            close = close_trials(seen)
            within.setdefault(seed, []).append(close)
            scores["train_mse"][f"{name}-{seed}"] = float(np.mean((seen.prediction - seen.safety_margin) ** 2))
            scores["train_trials_within_3"][f"{name}-{seed}"] = len(close)
        scores["r2"][name] = test_r2(networks)
    scores["train_trials_within_3"] |= {
        f"both-{seed}": len(set.intersection(*sets)) for seed, sets in within.items() if len(sets) > 1
    }
    return scores


def main() -> None:
    """Train, or print what was measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path, help="folder of the data set and the networks")
    parser.add_argument("--train", action="store_true")
    parser.add_argument("--inputs", nargs="+", default=["difference", "raw"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="of the networks")
    parser.add_argument("--data-seed", type=int, default=0)
    parser.add_argument("--epochs", type=int, default=10)
    parser.add_argument("--optimizer", default="adamw", choices=["adamw", "ranger21"])
    parser.add_argument("--start-from", help="network to start from, instead of random weights")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    try:
        data = simulate(options.work, seed=options.data_seed, quiet=options.json)
        if options.train:
            train(options.work, data, options)
            return
        scores = measure(options.work, data, options)
    except SliplensError as error:
        sys.exit(f"{Path(__file__).name}: {error}")
    print(json.dumps(scores, indent=None if options.json else 2))


if __name__ == "__main__":
    main()
