"""`sliplens import` of a folder or a manifest: many trials, some of them bad, and more of them later."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from data_sets import save_dataset
from own_recording import write_forces, write_video
from small import make_recording
from there import there

from sliplens.recordings import Recording, importing, load_dataset
from sliplens.recordings.importing import TrialJob, import_trial

PROFILE = 'name = "mine"\ncamera_size_px = [112, 112]\nrotate_deg = 90\nnormal_axis = "z"\nnormal_sign = -1\n'


@pytest.fixture(scope="module")
def source(trial: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two good trials, one without forces, one whose video is no video, and a profile."""
    folder = tmp_path_factory.mktemp("many")
    write_video(trial, folder / "cup.mkv")
    write_forces(trial, folder / "cup.csv")
    for name in ("jar", "mug"):
        shutil.copy(folder / "cup.mkv", folder / f"{name}.mkv")
    shutil.copy(folder / "cup.csv", folder / "jar_forces.csv")
    (folder / "bad.mkv").write_bytes(b"nothing")
    shutil.copy(folder / "cup.csv", folder / "bad.csv")
    (folder / "tip.toml").write_text(PROFILE)
    return folder


@pytest.fixture(scope="module")
def imported(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    data = tmp_path_factory.mktemp("imported") / "data"
    with pytest.raises(SystemExit, match="1"):
        run("import", source, "-o", data, "--sensor", source / "tip.toml", "--no-audit")
    return data


def test_bad_trials_are_listed_and_do_not_stop_the_others(imported: Path, trial: Recording):
    data = load_dataset(imported)
    assert {info.trial for info in data.trials} == {"cup", "jar"}
    assert {one.trial: "forces" in one.why for one in data.left_out} == {"bad": False, "mug": True}
    assert run("check", imported) == 0
    # frames went through the profile, which is kept
    cup = data.load(data.find("cup"))
    np.testing.assert_array_equal(cup.frames[100], np.rot90(trial.frames[100], k=-1))
    assert cup.sensor == "mine"
    profile = there(data.profile("mine"))
    assert profile.normal_sign == -1


def test_more_trials_are_added_and_the_old_ones_stay(
    imported: Path, source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    data = shutil.copytree(imported, tmp_path / "data")
    before = {info.trial: info for info in load_dataset(data).trials}
    manifest = tmp_path / "more.csv"
    manifest.write_text(
        "trial,video,forces,sensor,day,object,condition,mu\n"
        f"mug,{source / 'mug.mkv'},{source / 'cup.csv'},{source / 'tip.toml'},3,mug,wet,0.5\n"
        f"cup,{source / 'cup.mkv'},{source / 'cup.csv'},mine,,,,\n"
    )
    command = ("import", manifest, "-o", data, "--add", "--no-audit")
    with pytest.raises(SystemExit, match="1"):  # bad is still left out
        run(*command)
    assert "already" in capsys.readouterr().err
    after = load_dataset(data)
    assert {name: after.find(name) for name in before} == before
    mug = after.find("mug")
    assert (mug.day, mug.object, mug.condition, mug.sensor) == (3, "mug", "wet", "mine")
    labelling = there(after.read_labels(mug).labelling)
    assert there(labelling.basis).friction.mu == 0.5
    assert [one.trial for one in after.left_out] == ["bad"]
    assert run("check", data) == 0


def test_a_trial_that_fails_is_left_out_until_it_is_added(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    manifest, data = tmp_path / "trials.csv", tmp_path / "data"
    manifest.write_text("trial,video\n" + "".join(f"{name},{name}\n" for name in ("cup", "jar")))
    for seed, name in enumerate(("cup", "jar")):
        save_dataset(tmp_path / name, make_recording(name, frames=8, seed=seed))
    tries = []

    def import_but_one(job: TrialJob, path: Path) -> None:
        if job.capture.trial == "jar":
            tries.append(path)
            raise RuntimeError("out of luck")
        import_trial(job, path)

    monkeypatch.setattr(importing, "import_trial", import_but_one)
    with pytest.raises(SystemExit, match="1"):
        run("import", manifest, "-o", data, "--no-audit")
    assert len(tries) == 1
    after = load_dataset(data)
    assert [info.trial for info in after.trials] == ["cup"]
    assert [(one.trial, "out of luck" in one.why and "--add" in one.why) for one in after.left_out] == [("jar", True)]
    assert not list(tmp_path.glob(".*"))
    # what was named itself is missed: nothing is made before it is there
    assert run("import", tmp_path / "cup", tmp_path / "jar", "-o", tmp_path / "named", "--no-audit") == 1
    assert not (tmp_path / "named").exists()
    monkeypatch.undo()
    assert run("import", manifest, "-o", data, "--no-audit", "--add") == 0
    assert [info.trial for info in load_dataset(data).trials] == ["cup", "jar"]
    assert not load_dataset(data).left_out
