"""Training and evaluation as calls of the library, from a data set to a record."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from there import there

import sliplens as sl
from sliplens.errors import InputError
from sliplens.recordings import Dataset

SMALL: dict[str, Any] = {"image_size": 32, "epochs": 2, "batch_size": 11, "head": "point", "untouched_share": 0.0}


def test_a_network_may_stay_in_memory(small_dataset: Dataset):
    counts = []
    run = sl.train(small_dataset, **SMALL, on_progress=lambda done, total: counts.append((done, total)))
    assert run.training is not None
    assert len(run.training.curve) == 2
    assert run.training.best_validation_mse == min(run.training.curve.validation_mse)
    # trials that were read, then steps of the two epochs: 44 frames and batches of 11
    assert counts[-1] == (8, 8)
    evaluation = sl.evaluate(run, small_dataset)
    table = evaluation.to_arrow().to_pydict()
    assert set(table["trial"]) == set(evaluation.trials)
    squares = (np.array(table["prediction"]) - np.array(table["safety_margin"])) ** 2
    dry = np.array(table["condition"]) == "dry"
    assert evaluation.conditions["dry"].mse == pytest.approx(squares[dry].mean())
    assert run.manifest.colour
    assert run.manifest.pull_direction_deg is None  # what these pictures show is no shear
    assert evaluation.known_trials == 0
    assert sl.evaluate(run, small_dataset, split="train").known_trials == 4


def test_what_was_written_comes_back_as_it_was_returned(small_dataset: Dataset, tmp_path: Path):
    run = sl.train(small_dataset.folder, tmp_path / "run", **SMALL)
    again = sl.load(tmp_path / "run")
    assert again.manifest == run.manifest
    assert there(again.training).curve.to_arrow() == there(run.training).curve.to_arrow()
    first = sl.evaluate(tmp_path / "run", small_dataset.folder, tmp_path / "scores")
    kept = sl.evaluate(run, small_dataset, tmp_path / "scores")
    assert kept.conditions == first.conditions
    assert kept.lead_times == first.lead_times
    for name in ("prediction", "low_90", "high_90", "sigma"):
        np.testing.assert_array_equal(getattr(kept.predictions, name), getattr(first.predictions, name))


def test_a_network_that_is_adapted_stays_of_its_kind(small_dataset: Dataset):
    once: dict[str, Any] = SMALL | {"epochs": 1}
    start = sl.train(small_dataset, **once, input="raw")
    short: dict[str, Any] = {"epochs": 1, "epoch_frames": 32, "learning_rate": 1e-12}
    run = sl.train(small_dataset, recipe="adapt", start_from=start, **short)
    for name in ("input", "backbone", "head", "image_size"):
        assert getattr(run.manifest, name) == getattr(start.manifest, name)
    with pytest.raises(InputError, match="teaches an existing network; name it with --start-from"):
        sl.train(small_dataset, recipe="adapt")
