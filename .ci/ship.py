"""Put a trained network into the package, its weights rounded so that wheel and source archive stay small.

`python .ci/ship.py RUN src/sliplens/weights/NAME --bits 10` keeps so many of the 23 bits behind the point: 10 are
those of a half-precision number and are stored as one; with more, weights stay float32, whose zeros pack well. RUN may
be the folder itself. It prints by how much answers on simulated frames move, and refuses more than 0.001 of any: of the
margin and, where the network has it, of the ratio F_t / F_n and of margins at a given friction.
"""

import argparse
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sliplens.codec import RESULT_FILE, load_result, save_result
from sliplens.files import RUN_FILE, scratch_folder
from sliplens.grip.fingertip import ReadingTable
from sliplens.models import Network, load, save_checkpoint
from sliplens.recordings import Recording
from sliplens.simulation import PRESETS, plan_trials, simulate_trial

LARGEST_CHANGE = 1e-3
HALF_BITS = 10
FRICTIONS = (0.3, 0.6, 0.9)
"""Coefficients that a network is told."""


def rounded(weights: Tensor, *, bits: int) -> Tensor:
    """Nearest weights with that many bits behind the point; counts of batches stay as they are."""
    if weights.dtype != torch.float32:
        return weights
    if bits == HALF_BITS:
        return weights.half()
    dropped = 23 - bits
    words = weights.numpy().reshape(-1).view(np.uint32).astype(np.uint64)
    words = (words + (1 << (dropped - 1)) - 1 + ((words >> dropped) & 1)) >> dropped << dropped
    return torch.from_numpy(words.astype(np.uint32).view(np.float32).reshape(weights.shape).copy())


def simulate() -> list[Recording]:
    """Six short trials."""
    plans = [plan for preset in ("thesis", "varied") for plan in plan_trials(PRESETS[preset])[::100][:3]]
    return [simulate_trial(replace(plan, frames=20)) for plan in plans]


def read(network: Network, trials: list[Recording]) -> dict[str, np.ndarray]:
    """All that a network answers to the frames of some trials."""
    parts: dict[str, list[np.ndarray]] = {}
    for trial in trials:
        inputs = network.encode(trial.frames, trial.reference)
        estimate = network.estimate(inputs)
        parts.setdefault("margin", []).append(estimate.margin)
        if estimate.ratio is not None:
            parts.setdefault("ratio", []).append(estimate.ratio.mean)
        for friction in FRICTIONS if network.manifest.traction is not None else ():
            told = network.estimate(inputs, friction=friction)
            parts.setdefault(f"margin told {friction:g}", []).append(told.margin)
    return {name: np.concatenate(part) for name, part in parts.items()}


def ship(run: Path, folder: Path, *, bits: int) -> dict[str, float]:
    """Write the network with rounded weights and give the largest change of each of its answers."""
    network, trials = load(run), simulate()
    before = read(network, trials)
    kept = {name: rounded(values, bits=bits) for name, values in network.model.state_dict().items()}
    network.model.load_state_dict(kept, assign=True)
    with scratch_folder() as draft:  # what is read back is what ships: a head takes the rounded edges of the bins
        save_checkpoint(draft, network.model, network.manifest)
        read_back = read(load(draft), trials)
    changes = {name: float(np.abs(after - before[name]).max()) for name, after in read_back.items()}
    if max(changes.values()) > LARGEST_CHANGE:
        sys.exit(
            f"answers move too far ({say(changes)}, {LARGEST_CHANGE:g} at most): keep more bits; nothing was written"
        )
    folder.mkdir(parents=True, exist_ok=True)
    for name in (RUN_FILE, RESULT_FILE):
        if run.resolve() != folder.resolve():
            shutil.copyfile(run / name, folder / name)
    save_checkpoint(folder, network.model, network.manifest)
    if (folder / "readings").is_dir():
        table = load_result(folder / "readings", ReadingTable, command="make weights")
        # of the very network that was rounded: what it reads moves by less than the table resolves
        if table.network == network.manifest.weights_sha256:
            save_result(replace(table, network=load(folder).manifest.weights_sha256), folder / "readings")
    return changes


def say(changes: dict[str, float]) -> str:
    """Largest change of each answer, in a line."""
    return ", ".join(f"{name} {change:.1e}" for name, change in changes.items())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--bits", type=int, required=True)
    given = parser.parse_args()
    print(f"{given.folder.name}: answers move by up to: {say(ship(given.run, given.folder, bits=given.bits))}")
