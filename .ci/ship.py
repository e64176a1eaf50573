"""Put a trained network into the package, its weights rounded so that wheel and source archive stay small.

`python .ci/ship.py RUN src/sliplens/weights/NAME --bits 10` keeps so many of the 23 bits behind the point: 10 are
those of a half-precision number and are stored as one; with more, weights stay float32, whose zeros pack well. RUN may
be the folder itself. It prints by how much answers on simulated frames move, and refuses more than 0.001 of margin.
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
from sliplens.files import RUN_FILE
from sliplens.grip.readings import ReadingTable
from sliplens.models import Run, load, save_checkpoint
from sliplens.simulation import PRESETS, plan_trials, simulate_trial

LARGEST_CHANGE = 1e-3
HALF_BITS = 10


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


def inputs(network: Run) -> Tensor:
    """Frames of six trials, as the network sees them."""
    plans = [plan for preset in ("thesis", "varied") for plan in plan_trials(PRESETS[preset])[::100][:3]]
    trials = [simulate_trial(replace(plan, frames=20)) for plan in plans]
    return torch.cat([network.encode(trial.frames, trial.reference) for trial in trials])


def ship(run: Path, folder: Path, *, bits: int) -> float:
    """Write the network with rounded weights and give the largest change of an answer, in margin units."""
    network = load(run)
    frames = inputs(network)
    before = network.predict(frames)
    kept = {name: rounded(values, bits=bits) for name, values in network.model.state_dict().items()}
    network.model.load_state_dict(kept)
    change = float((network.predict(frames) - before).abs().max())
    if change > LARGEST_CHANGE:
        sys.exit(
            f"answers move by up to {change:.1e}, more than {LARGEST_CHANGE:g}: keep more bits; nothing was written"
        )
    folder.mkdir(parents=True, exist_ok=True)
    for name in (RUN_FILE, RESULT_FILE):
        if run.resolve() != folder.resolve():
            shutil.copyfile(run / name, folder / name)
    network.model.load_state_dict(kept, assign=True)
    save_checkpoint(folder, network.model, network.manifest, sequence=network.sequence)
    if (folder / "readings").is_dir():
        table = load_result(folder / "readings", ReadingTable, command="make weights")
        # of the very network that was rounded: what it reads moves by less than the table resolves
        if table.network == network.manifest.weights_sha256:
            save_result(replace(table, network=load(folder).manifest.weights_sha256), folder / "readings")
    return change


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--bits", type=int, required=True)
    given = parser.parse_args()
    print(f"{given.folder.name}: answers move by up to {ship(given.run, given.folder, bits=given.bits):.1e}")
