"""A data set is sound, or it is told what is wrong with it and where."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from data_sets import save_dataset

from sliplens.recordings import ContactState, Dataset, Recording
from sliplens.recordings.check import check_dataset
from sliplens.recordings.dataset import trial_path
from sliplens.simulation import FLAT_GEL, SimulationRecipe, simulate_dataset


def whats(folder: Path) -> list[str]:
    return [f"{one.where}: {one.what}" for one in check_dataset(folder)]


@pytest.mark.parametrize("release", [False, True])
def test_simulated_data_are_sound(tmp_path: Path, release: bool):
    recipe = SimulationRecipe(dry_trials=3, wet_trials=1, days=2, frames_per_trial=20, sensor=FLAT_GEL, release=release)
    simulate_dataset(tmp_path, recipe)
    assert whats(tmp_path) == []


def test_a_changed_file_and_a_missing_one_are_found(tmp_path: Path, small_dataset: Dataset):
    folder = tmp_path / "data"
    shutil.copytree(small_dataset.folder, folder)
    first, second, third = (info.trial for info in small_dataset.trials[:3])
    trial_path(folder, first).unlink()
    with trial_path(folder, second).open("r+b") as stream:
        stream.truncate(1000)
    shutil.copy(trial_path(folder, third), folder / "trials" / "stray.parquet")
    found = whats(folder)
    assert f"{first}: has no file" in found
    assert any(one.startswith(f"{second}: has a file that is not the one") for one in found)
    assert any(one.startswith(f"{second}: cannot be read: ") for one in found)
    assert "trials/stray.parquet: is not in the table of the data set" in found


def test_a_trial_in_two_splits_is_found(tmp_path: Path, recording: Recording):
    folder = save_dataset(tmp_path, recording).folder
    table = json.loads((folder / "dataset.json").read_text())
    table["trials"].append({**table["trials"][0], "split": "test"})
    (folder / "dataset.json").write_text(json.dumps(table))
    assert "trial: is listed 2 times, in split test and train" in whats(folder)


def test_a_table_that_lies_is_found(tmp_path: Path, recording: Recording):
    folder = save_dataset(tmp_path, recording).folder
    table = json.loads((folder / "dataset.json").read_text())
    table["trials"][0] |= {"day": 7, "frames": 99}
    (folder / "dataset.json").write_text(json.dumps(table))
    assert whats(folder) == ["trial: has day 1, the table says 7", "trial: has frames 12, the table says 99"]


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("normal_force_n", (3, np.nan), "frame 3: normal_force_n is not a number"),
        ("normal_force_n", (3, -1.0), "frame 3: the normal force is negative"),
        ("safety_margin", (5, 0.123), "frame 5: the safety margin is not 1 -"),
        ("stick_ratio", (5, np.nan), "frame 5: only one of margin and stick ratio"),
        ("contact_state", (..., ContactState.NO_CONTACT), "frame 1: a frame without contact has a safety margin (11 f"),
        ("contact_state", (..., ContactState.FULL_SLIP), "frame 1: full slip has a margin above 0 (10 frames)"),
    ],
)
def test_a_broken_law_is_found_at_its_frame(tmp_path: Path, recording: Recording, name, change, message: str):
    assert whats(save_dataset(tmp_path / "good", recording).folder) == []
    at, value = change
    values = np.array(getattr(recording, name), dtype=object if at is ... else None)
    values[at] = value
    broken = replace(recording, **{name: tuple(values) if at is ... else values})
    found = whats(save_dataset(tmp_path / "bad", broken).folder)
    assert len(found) == 1
    assert f"trial: {message}" in found[0]


def with_friction(trial: Recording, mu: float, *, sigma: float, slip: int | None = None) -> Recording:
    """Labels as another friction would give them, consistent among themselves; slipping from a frame on."""
    normal, tangential = trial.normal_force_n, trial.tangential_force_n
    contact = np.isfinite(trial.safety_margin)
    slips = contact & (np.arange(len(trial)) >= (len(trial) if slip is None else slip))
    used = np.where(contact, tangential / (mu * np.where(contact, normal, 1)), np.nan)
    margin = np.where(slips, 0.0, np.clip(1 - used, 0, 1))
    states = np.where(slips, ContactState.FULL_SLIP, ContactState.INCIPIENT_SLIP)
    return replace(
        trial,
        friction_coefficient=np.where(slips, used * mu, mu),
        safety_margin=margin,
        stick_ratio=margin ** (2 / 3),
        contact_state=tuple(
            ContactState(state) if here else ContactState.NO_CONTACT
            for state, here in zip(states, contact, strict=True)
        ),
        safety_margin_sigma=np.full(len(trial), sigma),
    )


def test_a_ratio_above_the_friction_is_found_before_and_after_the_slip(tmp_path: Path, recording: Recording):
    contact = np.isfinite(recording.safety_margin)
    ratio = np.where(contact, recording.tangential_force_n / np.where(contact, recording.normal_force_n, 1), 0)
    top, highest = int(np.argmax(ratio)), float(ratio.max())
    early = int(np.argmax(ratio > 0.4 * highest))
    assert early < top
    cases = {
        "sound": with_friction(recording, highest, sigma=0.01),
        # within 3 sigma
        "unsure": with_friction(recording, 0.9 * highest, sigma=0.04),
        "before": with_friction(recording, 0.6 * highest, sigma=0.01),
        "after": with_friction(recording, ratio[early - 1], sigma=0.01, slip=early),
    }
    found = {name: whats(save_dataset(tmp_path / name, case).folder) for name, case in cases.items()}
    assert found["sound"] == found["unsure"] == []
    assert any(f"before a slip, and the friction {0.6 * highest:.2f}" in what for what in found["before"])
    assert any(f"after a slip, and the friction {ratio[early - 1]:.2f}" in what for what in found["after"])
