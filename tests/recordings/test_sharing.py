"""A data set is checked against another: by seeds in simulation, by frames and names elsewhere."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from data_sets import save_dataset
from simulated_data import simulate_recipe

from sliplens.recordings import Dataset, Recording, check_dataset, import_recordings
from sliplens.simulation import SimulationRecipe

RECIPE = SimulationRecipe(dry_trials=4, wet_trials=0, days=2, frames_per_trial=20, sensors=2, seed=3)


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Dataset:
    return simulate_recipe(tmp_path_factory.mktemp("first") / "data", RECIPE)


def shared_trials(data: Dataset, other: Dataset) -> list[tuple[str, str]]:
    return [(each.where, each.what.split()[1]) for each in check_dataset(data, against=other)]


def test_the_same_seed_shares_what_both_have_though_no_file_is_the_same(data: Dataset, tmp_path: Path):
    other = simulate_recipe(tmp_path / "other", replace(RECIPE, dry_trials=3, frames_per_trial=22, sensors=1))
    assert not {trial.sha256 for trial in data.trials} & {trial.sha256 for trial in other.trials}
    names = {trial.trial for trial in data.trials} & {trial.trial for trial in other.trials}
    assert shared_trials(data, other) == [(name, name) for name in sorted(names)]
    assert shared_trials(data, simulate_recipe(tmp_path / "third", replace(RECIPE, seed=4))) == []


def test_simulated_trials_that_were_imported_are_told_by_what_they_show(data: Dataset, tmp_path: Path):
    imported = import_recordings(data.folder, out=tmp_path / "imported", condition="wet")
    assert not {trial.sha256 for trial in data.trials} & {trial.sha256 for trial in imported.trials}
    same = [(trial.trial, trial.trial) for trial in data.trials]
    assert shared_trials(data, imported) == shared_trials(imported, data) == same


def test_recorded_data_are_told_by_files_and_names(recording: Recording, tmp_path: Path, capsys):
    one = replace(recording, sensor="tip", day=2)
    brighter = replace(one, trial="again", frames=np.clip(one.frames, 3, None))
    first = save_dataset(tmp_path / "first", one)
    for other, trials, note in (
        (one, 1, "the sensor tip, day 2 of tip"),
        (brighter, 0, "the sensor tip, day 2 of tip"),
        (replace(brighter, day=3), 0, "the sensor tip"),
        (replace(brighter, sensor="thumb"), 0, ""),
        (replace(brighter, sensor=""), 0, ""),
    ):
        second = save_dataset(tmp_path / f"{other.trial}{other.sensor}{other.day}", other)
        assert run("check", first.folder, "--against", second.folder) == 2 * trials
        told = "".join(capsys.readouterr().err.split())
        assert ("has,too:" in told) == bool(note)
        assert note.replace(" ", "") in told
