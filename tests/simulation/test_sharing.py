"""Two data sets are told what they share, by seeds in simulation and by names and files elsewhere."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from data_sets import save_dataset
from simulated_data import simulate_recipe

from sliplens.cli import main
from sliplens.recordings import Dataset, Recording, import_recordings
from sliplens.simulation import SimulationRecipe
from sliplens.simulation.trials import compare_datasets

RECIPE = SimulationRecipe(dry_trials=4, wet_trials=0, days=2, frames_per_trial=20, sensors=2, seed=3)


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Dataset:
    return simulate_recipe(tmp_path_factory.mktemp("first") / "data", RECIPE)


def test_the_same_seed_shares_what_both_have_though_no_file_is_the_same(data: Dataset, tmp_path: Path):
    other = simulate_recipe(tmp_path / "other", replace(RECIPE, dry_trials=3, frames_per_trial=22, sensors=1))
    shared = compare_datasets(data, other)
    assert not {trial.sha256 for trial in data.trials} & {trial.sha256 for trial in other.trials}
    names = {trial.trial for trial in data.trials} & {trial.trial for trial in other.trials}
    assert shared.trials == tuple((name, name) for name in sorted(names))
    assert shared.days == (("day 1", "day 1"), ("day 2", "day 2"))
    assert shared.sensors == (("chromatouch-1", "chromatouch-1"),)


def test_splits_of_one_data_set_share_sensors_alone(data: Dataset):
    shared = compare_datasets(data, data, splits=("train", "test"))
    assert (shared.trials, shared.days) == ((), ())
    assert shared.sensors == (("chromatouch-1", "chromatouch-1"),)


def test_simulated_trials_that_were_imported_are_told_by_what_they_show(data: Dataset, tmp_path: Path):
    imported = import_recordings(data.folder, out=tmp_path / "imported", condition="wet")
    assert not {trial.sha256 for trial in data.trials} & {trial.sha256 for trial in imported.trials}
    for shared in (compare_datasets(data, imported), compare_datasets(imported, data)):
        assert not shared.by_seeds
        assert shared.trials == tuple((trial.trial, trial.trial) for trial in data.trials)


def test_recorded_data_are_told_by_files_and_names(recording: Recording, tmp_path: Path):
    one = replace(recording, sensor="tip", day=2)
    brighter = replace(one, trial="again", frames=np.clip(one.frames, 3, None))
    first = save_dataset(tmp_path / "first", one)
    for other, trials, days, sensors in (
        (one, 1, 1, 1),
        (brighter, 0, 1, 1),
        (replace(brighter, day=3), 0, 0, 1),
        (replace(brighter, sensor="thumb"), 0, 0, 0),
        (replace(brighter, sensor=""), 0, 0, 0),
    ):
        shared = compare_datasets(first, save_dataset(tmp_path / f"{other.trial}{other.sensor}{other.day}", other))
        assert not shared.by_seeds
        assert (len(shared.trials), len(shared.days), len(shared.sensors)) == (trials, days, sensors)


def test_the_command_tells_what_is_shared_and_what_a_network_knows(
    data: Dataset, capsys: pytest.CaptureFixture, difference_run: Path
):
    assert main(["compare", str(data.folder), str(data.folder), "--splits", "train", "test"]) == 0
    assert "share 0 trials, 0 days, 1 sensor (compared by seeds and frames)" in " ".join(
        capsys.readouterr().out.split()
    )
    assert main(["compare", str(data.folder), str(difference_run)]) == 0
    assert "was trained on 0 of the" in " ".join(capsys.readouterr().out.split())
