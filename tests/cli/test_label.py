"""`sliplens label`, and the import of recordings that bring labels of their own."""

import csv
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import refused, run
from data_sets import contents, save_dataset
from there import there

from sliplens.recordings import (
    Corrections,
    LabelSettings,
    Recording,
    label_dataset,
    load_dataset,
    read_corrections,
)
from sliplens.recordings.dataset import trial_path
from sliplens.recordings.store import forces_path, load_forces, load_recording, read_header, save_forces
from sliplens.simulation import PRESETS, plan_trials, simulate_trial


@pytest.fixture(scope="module")
def trial() -> Recording:
    """A simulated trial at 30 frames a second."""
    return replace(simulate_trial(replace(plan_trials(PRESETS["small"])[0], frames=240)), object="cup")


@pytest.fixture(scope="module")
def simulated(trial: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("simulated")
    return save_dataset(folder, trial, split="validation", simulated=True).folder


@pytest.fixture(scope="module")
def relabelled(simulated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("relabelled") / "data"
    assert run("label", simulated, "-o", folder) == 0
    return folder


def signals(recording: Recording) -> dict[str, np.ndarray]:
    names = ("time_s", "normal_force_n", "tangential_force_n", "friction_coefficient", "safety_margin", "stick_ratio")
    return {name: getattr(recording, name) for name in names}


def test_an_imported_data_set_keeps_its_labels_and_what_it_is(tmp_path: Path, trial: Recording, simulated: Path):
    assert run("import", simulated, "-o", tmp_path / "data") == 0
    assert run("check", tmp_path / "data") == 0
    data = load_dataset(tmp_path / "data")
    back = data.load(data.trials[0])
    for name, values in signals(trial).items():
        np.testing.assert_array_equal(getattr(back, name), values, err_msg=name)
    np.testing.assert_array_equal(back.frames, trial.frames)
    np.testing.assert_array_equal(back.reference, trial.reference)
    assert back.contact_state == trial.contact_state
    assert (back.sensor, back.day, back.condition, back.object) == (trial.sensor, trial.day, trial.condition, "cup")
    assert (data.trials[0].split, data.trials[0].object, data.simulated) == ("validation", "cup", True)
    # a page is drawn of labels that were not found, too
    assert (tmp_path / "data" / "audit" / f"{trial.trial}.png").is_file()


def test_the_labels_of_a_simulated_trial_come_back_from_its_forces(trial: Recording, relabelled: Path):
    back = load_recording(trial_path(relabelled, trial.trial))
    labelling = there(back.labelling)
    slip = int(np.argmax(trial.safety_margin == 0))
    # forces without noise: what is left is the time of a frame over which they are averaged
    assert there(labelling.basis).friction.mu == pytest.approx(there(trial.truth).static_friction[slip], rel=0.02)
    error = (back.safety_margin - trial.safety_margin)[there(back.valid)]
    assert np.sqrt(np.mean(error**2)) < 0.02
    np.testing.assert_array_equal(back.reference, trial.reference)
    assert run("check", relabelled) == 0


def test_force_samples_are_kept_and_labels_made_anew_from_them_are_the_same(
    tmp_path: Path, trial: Recording, relabelled: Path
):
    samples = load_forces(forces_path(relabelled, trial.trial))
    np.testing.assert_array_equal(samples.force_n[:, 2], trial.normal_force_n)
    np.testing.assert_array_equal(samples.force_n[:, 0], trial.tangential_force_n)
    shutil.copytree(relabelled, tmp_path / "data")
    before = load_recording(trial_path(relabelled, trial.trial))
    # in place, with the same settings and seed
    assert run("label", tmp_path / "data") == 0
    after = load_recording(trial_path(tmp_path / "data", trial.trial))
    for name, values in signals(before).items():
        np.testing.assert_array_equal(getattr(after, name), values, err_msg=name)
    # and with another friction: 1 - Gamma is inversely proportional to it
    assert run("label", tmp_path / "data", "--mu", 1.6) == 0
    after = load_recording(trial_path(tmp_path / "data", trial.trial))
    both = before.labelled & after.labelled
    assert both.sum() > 150
    expected = 1 - (1 - before.safety_margin) * before.friction_coefficient / 1.6
    np.testing.assert_allclose(after.safety_margin[both], expected[both], atol=1e-9)
    assert load_dataset(tmp_path / "data").trials[0].split == "validation"
    # what the trial came from, what was noted then, and how it was divided stay
    first, last = (
        there(read_header(trial_path(folder, trial.trial)).labelling) for folder in (relabelled, tmp_path / "data")
    )
    assert (last.source, last.notes) == (first.source, first.notes)


def test_labels_that_were_not_found_are_not_overwritten(simulated: Path, capsys: pytest.CaptureFixture[str]):
    before = (simulated / "dataset.json").read_bytes()
    assert "did not come from its forces and would be lost" in refused(capsys, "label", simulated)
    assert (simulated / "dataset.json").read_bytes() == before


def test_changed_force_samples_are_found(tmp_path: Path, trial: Recording, relabelled: Path):
    shutil.copytree(relabelled, tmp_path / "data")
    forces_path(tmp_path / "data", trial.trial).write_bytes(b"PAR1")
    assert run("check", tmp_path / "data") == 2


def test_corrections_give_the_labels_of_their_settings_and_removed_those_of_before(
    tmp_path: Path, trial: Recording, relabelled: Path, capsys: pytest.CaptureFixture[str]
):
    folder, name, table = tmp_path / "data", trial.trial, tmp_path / "corrections.csv"
    shutil.copytree(relabelled, folder)
    before = load_recording(trial_path(folder, name))
    slip_s = there(there(there(before.labelling).basis).friction.onset_s) - 0.5
    values = {"slip_s": slip_s, "contact_s": 0.7, "reference_frame": 5, "tare": (0.01, 0.0, -0.02)}
    settings = LabelSettings(**values, bad_frames=((60, 79), (90, 90)))
    expected = label_dataset(relabelled, out=tmp_path / "expected", labelling=settings)
    table.write_text(
        f"trial,slip_s,contact_s,reference_frame,tare,bad_frames\n{name},{slip_s!r},0.7,5,0.01 0 -0.02,60..79 90\n"
    )
    assert run("label", folder, "--no-audit", "--corrections", table) == 0
    assert "corrections of 1 trial applied" in capsys.readouterr().err
    corrected = load_recording(trial_path(folder, name))
    np.testing.assert_array_equal(corrected.safety_margin, expected.load(expected.trials[0]).safety_margin)
    np.testing.assert_array_equal(corrected.reference, trial.frames[5])
    reasons = np.array(there(corrected.reason))
    assert {*reasons[60:80], reasons[90]} == {"marked by hand"}
    assert {*reasons[trial.time_s < 0.7]} == {"no contact"}
    labelling = there(corrected.labelling)
    assert there(labelling.basis).friction.onset_s == pytest.approx(slip_s)
    assert labelling.corrections == Corrections(**values, bad_frames=((60, 79), (90, 90)))
    assert run("check", folder) == 0
    # a later call follows them
    assert run("label", folder, "--no-audit") == 0
    again = load_recording(trial_path(folder, name))
    assert again.labelling == labelling
    np.testing.assert_array_equal(again.safety_margin, corrected.safety_margin)
    # an empty table takes them back, though the reference had been replaced
    table.write_text(f"trial,slip_s\n{name},\n")
    assert run("label", folder, "--no-audit", "--corrections", table) == 0
    assert f"corrections of 1 trial removed, such as {name}" in capsys.readouterr().err
    after = load_recording(trial_path(folder, name))
    for field, numbers in signals(before).items():
        np.testing.assert_array_equal(getattr(after, field), numbers, err_msg=field)
    np.testing.assert_array_equal(after.reference, before.reference)
    assert after.labelling == before.labelling


def test_an_excluded_trial_has_no_label_until_it_is_included_again(tmp_path: Path, trial: Recording, relabelled: Path):
    folder, table = shutil.copytree(relabelled, tmp_path / "data"), tmp_path / "corrections.csv"
    before = load_recording(trial_path(folder, trial.trial))
    table.write_text(f"trial,exclude\n{trial.trial},yes\n")
    assert run("label", folder, "--corrections", table) == 0
    excluded = load_recording(trial_path(folder, trial.trial))
    assert not excluded.labelled.any()
    assert excluded.count() == {"excluded by hand": len(excluded)}
    assert run("check", folder) == 0
    table.write_text(f"trial,exclude\n{trial.trial},no\n")
    assert run("label", folder, "--no-audit", "--corrections", table) == 0
    after = load_recording(trial_path(folder, trial.trial))
    np.testing.assert_array_equal(after.safety_margin, before.safety_margin)
    assert after.labelling == before.labelling


def test_a_draft_is_a_table_that_changes_nothing_until_it_is_edited(
    tmp_path: Path, trial: Recording, relabelled: Path, capsys: pytest.CaptureFixture[str]
):
    folder, table = shutil.copytree(relabelled, tmp_path / "data"), tmp_path / "corrections.csv"
    assert run("label", folder, "--draft", table) == 0
    assert read_corrections(table) == {}
    (row,) = csv.DictReader(table.read_text().splitlines())
    row |= {"mu": "1.6", "bad_frames": "3..4"}
    table.unlink()
    with table.open("w") as stream:
        writer = csv.DictWriter(stream, list(row))
        writer.writeheader()
        writer.writerow(row)
    expected = Corrections(mu=1.6, bad_frames=((3, 4),))
    assert read_corrections(table) == {trial.trial: expected}
    assert run("label", folder, "--no-audit", "--corrections", table) == 0
    assert run("label", folder, "--draft", tmp_path / "second.csv") == 0
    assert read_corrections(tmp_path / "second.csv") == {trial.trial: expected}
    capsys.readouterr()
    assert "name a file that does not" in refused(capsys, "label", folder, "--draft", table)


def test_what_cannot_be_labelled_is_listed_and_the_data_set_is_as_it_was(
    tmp_path: Path, relabelled: Path, trial: Recording, capsys: pytest.CaptureFixture[str]
):
    data, name = shutil.copytree(relabelled, tmp_path / "data"), trial.trial
    short = load_recording(trial_path(relabelled, name), truth=False)
    samples = load_forces(forces_path(relabelled, name))
    for other, force_n in (("cup", samples.force_n), ("jar", 0 * samples.force_n)):  # nothing touches it
        save_forces(replace(samples, force_n=force_n), forces_path(data, other))
    save_dataset(data, replace(short, trial="cup"), replace(short, trial="jar"), simulated=True)
    before = contents(data)
    assert run("label", data, "--mu", 1.6, "--no-audit") == 1
    told = capsys.readouterr().err
    assert "1 of 2 could not be done" in told
    assert told.count("jar: ") == 1
    assert contents(data) == before


def test_corrections_outside_their_data_set_are_refused_with_their_cure(
    tmp_path: Path, trial: Recording, relabelled: Path, capsys: pytest.CaptureFixture[str]
):
    folder, table = shutil.copytree(relabelled, tmp_path / "data"), tmp_path / "corrections.csv"
    before = contents(folder)
    cases = {
        f"{trial.trial},100..900,": "frames 100 to 900 cannot be marked as bad: name them from 0 to 239",
        f"{trial.trial},,99": "the slip is set to 99.00 s",
        "nobody,1..2,": f"has no trial nobody; it has {trial.trial}",
    }
    for row, error in cases.items():
        table.write_text(f"trial,bad_frames,slip_s\n{row}\n")
        assert error in refused(capsys, "label", folder, "--no-audit", "--corrections", table)
    # types are checked under pytest only, so that a user's mistake needs another process
    mistakes = {
        f"sl.label_dataset({str(folder)!r}, corrections={{{trial.trial!r}: {{'slip_s': 3}}}})": "such as Corrections(",
        "sl.load_dataset([1])": "[1] is no data set; give its folder",
    }
    for call, error in mistakes.items():
        done = subprocess.run(
            [sys.executable, "-c", f"import sliplens as sl; {call}"], capture_output=True, text=True, check=False
        )
        assert done.stderr.splitlines()[-1].startswith("sliplens.errors.InputError: ")
        assert error in done.stderr.splitlines()[-1]
    assert contents(folder) == before
