"""Average the weights of networks that were trained further from the same one, and calibrate what comes of it.

`python .ci/average.py DATA RUN RUN... -o OUT` takes the calibration, and what is usual among the features, from the
validation trials of DATA and from a tenth of its training trials. The average often reads better than each of them, and
an answer costs what it did: Wortsman et al., *Model soups* (2022). Given again, the same average stays.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from sliplens.errors import SliplensError
from sliplens.files import output_folder, versions
from sliplens.models import Network, load, save_checkpoint
from sliplens.models.checkpoint import read_manifest
from sliplens.models.novelty import fit_novelty
from sliplens.recordings import Dataset, load_dataset
from sliplens.training.data import load_frames
from sliplens.training.fitting import calibrate

BATCH = 64
SOME = 10
"""One training trial of so many tells which frictions and features are usual."""


def average(data: Path, folders: Sequence[Path], out: Path) -> float:
    """Write the average network, and give its mean squared error on the validation trials."""
    runs = [load(folder) for folder in folders]
    kind = [(run.manifest.input, run.manifest.backbone, run.manifest.head, run.manifest.image_size) for run in runs]
    begun = {run.manifest.started_from for run in runs}
    # of networks that began with random weights nothing tells whether these were the same
    if len(runs) < 2 or len(set(kind)) > 1 or len(begun) > 1 or "" in begun:
        sys.exit("average.py: name two networks or more of one kind that were trained further from the same one")
    dataset = load_dataset(data)
    config = {"data_hash": dataset.hash, "networks": [run.manifest.weights_sha256 for run in runs]}
    with output_folder(out, stage="average", config=config, overwrite=False) as output:
        if not output.complete:
            _average(runs, dataset, output.folder)
    return read_manifest(out).metrics["validation_mse"]


def _average(runs: Sequence[Network], dataset: Dataset, out: Path) -> None:
    """Write the average of networks of one kind, calibrated on a data set."""
    first = runs[0]
    validation, train = (
        load_frames(dataset, trials, encoding=first.encoding, image_size=first.manifest.image_size)
        for trials in (dataset.select(split="validation"), dataset.select(split="train")[::SOME])
    )
    states = [run.model.state_dict() for run in runs]
    first.model.load_state_dict({
        name: torch.stack([state[name] for state in states]).mean(dim=0) if value.is_floating_point() else value
        for name, value in states[0].items()
    })  # fmt: skip
    calibration, traction = calibrate(first.model, validation, batch_size=BATCH, trained_friction=train.friction)
    manifest = replace(
        first.manifest,
        calibration=calibration,
        traction=traction,
        novelty=fit_novelty(first.model, train.batches(BATCH), validation.batches(BATCH)),
        metrics={"validation_mse": calibration.mse},
        trained_on=tuple(dict.fromkeys(one for run in runs for one in run.manifest.trained_on)),
        versions=versions(),
    )
    save_checkpoint(out, first.model, manifest)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("-o", "--output", type=Path, required=True)
    given = parser.parse_args()
    try:
        error = average(given.data, given.runs, given.output)
    except SliplensError as mistake:
        sys.exit(f"average.py: {mistake}")
    print(f"{given.output}: validation MSE {error:.4f}")
