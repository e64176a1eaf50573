"""What a second frame, or a short sequence, adds to what a network reads from one.

The network stays as it is: a small perceptron gets its answers and its uncertainty at several frames of a trial, and is
taught the margin of the last of them, on trials from slippery to rough; it is tried on fresh days, dry (friction 0.5 to
1.2) and wet (0.15 to 0.7). One frame alone goes through such a perceptron too: the difference is what the others add.

All frames lie at fixed times. With `--pulls steady` the speed of the pull is the same in all trials, and a sequence
tells the margin in part by how fast it falls; with `varied` no pull is like another, and what is left is what a
sequence tells of friction.
"""

import argparse
import json
import os
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # must be set before torch is imported

import numpy as np
import pyarrow as pa
import torch
from jaxtyping import Float
from torch import nn

from sliplens.errors import SliplensError
from sliplens.models import Network
from sliplens.models.checkpoint import load
from sliplens.simulation import PRESETS, SimulationRecipe, simulate_dataset
from sliplens.simulation.nuisances import Nuisances
from sliplens.simulation.plan import PULLS
from sliplens.training import evaluate_frames
from sliplens.training.data import load_frames
from sliplens.training.metrics import regression_scores

VIEWS = {"one frame": (0.0,), "and one 0.5 s earlier": (0.0, 0.5), "8 frames over 2.2 s": tuple(np.linspace(0, 2.2, 8))}
"""How many seconds before the last frame each frame lies."""
SIGNALS = ("prediction", "sigma", "low_90", "high_90")
STEPS, BATCH, WIDTH, SEEDS = 1500, 512, 64, 3


class Answers:
    """What a network answered to the frames of some trials."""

    def __init__(self, table: pa.Table) -> None:
        table = table.sort_by([("trial", "ascending"), ("time_s", "ascending")])
        self.trial, self.condition = (np.array(table[name].to_pylist()) for name in ("trial", "condition"))
        self.time_s, self.margin = (table[name].to_numpy() for name in ("time_s", "safety_margin"))
        names = [name for name in SIGNALS if name in table.column_names]
        self.signals = np.stack([table[name].to_numpy() for name in names], axis=1)

    def view(self, before_s: tuple[float, ...]) -> Float[np.ndarray, "frames features"]:
        """Answers at the frames that lie so long before each; the first in contact where there is none so early."""
        nearest = np.empty((len(self.time_s), len(before_s)), dtype=int)
        for trial in np.unique(self.trial):
            rows = np.flatnonzero(self.trial == trial)
            time_s = self.time_s[rows]
            asked = time_s[:, None] - np.asarray(before_s)
            nearest[rows] = rows[np.abs(asked[..., None] - time_s).argmin(axis=-1)]
        return self.signals[nearest].reshape(len(nearest), -1)


def taught(
    inputs: Float[np.ndarray, "frames features"], margin: Float[np.ndarray, " frames"], *, seed: int
) -> nn.Sequential:
    """A perceptron that gives the mean of the margin."""
    generator = torch.Generator().manual_seed(seed)
    given, labels = torch.tensor(inputs, dtype=torch.float32), torch.tensor(margin, dtype=torch.float32)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        first, second = nn.Linear(given.shape[1], WIDTH), nn.Linear(WIDTH, WIDTH)
        network = nn.Sequential(first, nn.GELU(), second, nn.GELU(), nn.Linear(WIDTH, 1))
    optimiser = torch.optim.AdamW(network.parameters(), lr=2e-3, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, max_lr=2e-3, total_steps=STEPS)
    for _ in range(STEPS):
        rows = torch.randint(len(given), (BATCH,), generator=generator)
        loss = nn.functional.mse_loss(network(given[rows])[:, 0], labels[rows])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return network


def r2_by_condition(answers: Answers, margin: Float[np.ndarray, " frames"]) -> dict[str, float | None]:
    """R2 of margins that were read, by condition."""
    return {
        str(name): regression_scores(
            answers.margin[answers.condition == name], margin[answers.condition == name].clip(0, 1)
        ).r2
        for name in np.unique(answers.condition)
    }


def answered(trained: Network, recipe: SimulationRecipe, folder: Path, *, split: str) -> Answers:
    """What the network answers to the trials of one split."""
    data = simulate_dataset(folder, recipe)
    frames = load_frames(
        data, data.select(split=split), encoding=trained.encoding, image_size=trained.manifest.image_size
    )
    return Answers(evaluate_frames(trained, frames).frame())


def main() -> None:
    """Print R2 by condition and view, as a table or as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, default=Path("chromatouch-difference"), help="a trained network")
    parser.add_argument("--days", type=int, default=40, help="that teach, and as many that test")
    parser.add_argument("--pulls", default="varied", choices=PULLS, help="how objects are pulled")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    try:
        trained = load(options.run)
    except SliplensError as error:
        sys.exit(f"{Path(__file__).name}: {error}")
    varied, days = PRESETS["varied"], options.days
    learned_from = replace(
        varied,
        seed=101,
        frames_per_trial=40,
        days=days + 1,
        test_days=1,
        dry_trials=3 * (days + 1),
        wet_trials=0,
        pulls=PULLS[options.pulls],
        nuisances=Nuisances(dry_friction=(0.15, 1.2)),
    )
    tried_on = replace(learned_from, seed=102, test_days=days, wet_trials=3 * days, nuisances=Nuisances())
    with tempfile.TemporaryDirectory() as scratch:
        learn = answered(trained, learned_from, Path(scratch) / "learn", split="train")
        test = answered(trained, tried_on, Path(scratch) / "test", split="test")
    found = {"as the network answers": r2_by_condition(test, test.signals[:, 0])}
    for name, before_s in VIEWS.items():
        inputs, tried = learn.view(before_s), torch.from_numpy(test.view(before_s)).float()
        networks = [taught(inputs, learn.margin, seed=seed) for seed in range(SEEDS)]
        with torch.no_grad():
            read = [network(tried)[:, 0].numpy() for network in networks]
        found[name] = r2_by_condition(test, np.mean(read, axis=0).astype(np.float64))
    if options.json:
        print(json.dumps(found))
        return
    for name, scores in found.items():
        print(f"{name:24}", ", ".join(f"{condition} {r2:.3f}" for condition, r2 in scores.items()))


if __name__ == "__main__":
    main()
