"""`sliplens import`: from files of one's own to a data set that trains a network."""

from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import pytest
from command_line import run
from data_sets import save_dataset
from own_recording import TARE, write_forces, write_video
from there import there

from sliplens.recordings import Recording, check_dataset, load_dataset
from sliplens.recordings.store import read_header, write_trial


@pytest.fixture(scope="module")
def table(trial: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_forces(trial, tmp_path_factory.mktemp("forces") / "forces.csv")


@pytest.fixture(scope="module")
def video(trial: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_video(trial, tmp_path_factory.mktemp("video") / "cup.mkv")


def test_labels_of_an_imported_video_are_those_of_the_simulator(
    tmp_path: Path, trial: Recording, table: Path, video: Path, capsys: pytest.CaptureFixture[str]
):
    command = ("import", video, "-o", tmp_path / "data", "--sensor", "mine", "--forces", table)
    assert run(*command) == 0
    assert run("check", tmp_path / "data") == 0
    data = load_dataset(tmp_path / "data")
    back = data.load(data.trials[0])
    assert (back.trial, back.sensor, data.simulated) == ("cup", "mine", False)
    np.testing.assert_array_equal(back.frames, trial.frames)
    # the labels' own goal: Gamma within 0.03 rms, mu within 5 %
    assert there(back.valid).sum() > 180
    error = (back.safety_margin - trial.safety_margin)[there(back.valid)]
    assert np.sqrt(np.mean(error**2)) < 0.03
    labelling = there(read_header(tmp_path / "data" / "trials" / "cup.parquet").labelling)
    basis = there(labelling.basis)
    slip = int(np.argmax(trial.safety_margin == 0))
    assert basis.friction.mu == pytest.approx(there(trial.truth).static_friction[slip], rel=0.05)
    assert (basis.axes.normal, basis.axes.sign) == ("z", -1)
    np.testing.assert_allclose(basis.axes.tare_n, TARE, atol=0.01)
    # the reference was taken before the contact
    np.testing.assert_array_equal(back.reference, trial.frames[labelling.reference.index])
    assert np.isnan(trial.safety_margin[labelling.reference.index])
    assert run(*command) == 0
    assert "kept" in capsys.readouterr().out


def test_friction_given_or_not_frames_after_the_slip_are_0_and_a_wrong_one_is_told_everywhere(
    tmp_path: Path, trial: Recording, table: Path, video: Path, capsys: pytest.CaptureFixture[str]
):
    slip = int(np.argmax(trial.safety_margin == 0))
    mu = float(there(trial.truth).static_friction[slip])
    for name, given in (("right", mu), ("wrong", 0.5 * mu)):
        command = ("import", video, "-o", tmp_path / name, "--sensor", "mine", "--forces", table)
        assert run(*command, "--mu", f"{given:.3f}") == 0
        flagged = f"at the slip at {trial.time_s[slip]:.1f}" in capsys.readouterr().err
        data = load_dataset(tmp_path / name)
        labels = data.read_labels(data.trials[0])
        after = np.arange(len(trial)) > slip + 1
        assert np.all(labels.safety_margin[after] == 0)
        assert not labels.labelled[after].any()
        assert run("check", tmp_path / name) == 0
        checked = capsys.readouterr()
        assert flagged == ("is sound" not in checked.out) == (name == "wrong")
        assert (f"{given:.2f} was given" in checked.err) == (name == "wrong")


def test_doubts_of_an_import_are_said_in_the_same_words_everywhere(
    tmp_path: Path, table: Path, video: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "data"
    assert run("import", video, "-o", out, "--sensor", "mine", "--forces", table, "--frame-rate", 36) == 0
    printed = " ".join(capsys.readouterr().err.split())
    doubts = load_dataset(out).doubts
    assert doubts.keys() == {"cup"}
    assert len(doubts["cup"]) > 1
    assert not load_dataset(out).read_labels(load_dataset(out).trials[0]).labelled.any()
    assert all(doubt in printed for doubt in doubts["cup"])
    found = check_dataset(out)
    assert [(each.where, each.what, each.doubt) for each in found] == [("cup", doubt, True) for doubt in doubts["cup"]]
    assert run("check", out) == 0
    checked = capsys.readouterr()
    assert "is sound" not in checked.out
    assert all(doubt in " ".join(checked.err.split()) for doubt in doubts["cup"])


def test_an_interrupted_import_goes_on_where_it_stopped(
    tmp_path: Path, trial: Recording, monkeypatch: pytest.MonkeyPatch
):
    source = tmp_path / "source"
    save_dataset(source, replace(trial, trial="a"), replace(trial, trial="b"))
    whole, broken = (("import", source, "-o", tmp_path / name, "--no-audit") for name in "wb")
    assert run(*whole) == 0
    written = []

    turn = Lock()

    def write(path: Path, *arguments: Any, **more: Any) -> None:
        with turn:  # trials are written by several threads
            if written:
                raise KeyboardInterrupt
            write_trial(path, *arguments, **more)
            written.append(path)

    with monkeypatch.context() as patch:
        patch.setattr("sliplens.recordings.importing.write_trial", write)
        assert run(*broken) == 130
    assert not (tmp_path / "b").exists()
    [kept] = (tmp_path / ".b.partial" / "parts").glob("trial=*/0*/trials/*.parquet")
    made_ns = kept.stat().st_mtime_ns
    assert run(*broken, "--on", "processes=1") == 0  # wherever it goes on
    assert (tmp_path / "b" / "trials" / kept.name).stat().st_mtime_ns == made_ns
    assert {path.name for path in (tmp_path / "b").iterdir()} == {path.name for path in (tmp_path / "w").iterdir()}
    for name in ("dataset.json", "trials/a.parquet", "trials/b.parquet"):
        assert (tmp_path / "b" / name).read_bytes() == (tmp_path / "w" / name).read_bytes()
