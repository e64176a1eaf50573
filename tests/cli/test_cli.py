"""The command line, run as a user would: every stage once, and what it says to mistakes."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import refused, run

from sliplens import __version__
from sliplens.recordings import Dataset


def test_version(capsys: pytest.CaptureFixture[str]):
    assert run("--version") == 0
    assert capsys.readouterr().out.startswith(f"sliplens {__version__}, python ")


def test_a_reader_that_stops_reading_is_no_error():
    asked = subprocess.Popen(
        [sys.executable, "-m", "sliplens", "simulate", "--help"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert asked.stdout is not None
    asked.stdout.close()
    _, told = asked.communicate()
    assert told == b""
    assert asked.returncode == 1


def test_the_stages_one_by_one(
    tmp_path: Path, small_dataset: Dataset, difference_folder: Path, capsys: pytest.CaptureFixture[str]
):
    data, work = small_dataset.folder, tmp_path / "work"
    train = ("train", data, "-o", work / "train", "--image-size", 32, "--epochs", 1, "--batch-size", 11)
    assert run(*train) == 0
    assert run("evaluate", work / "train", data, "-o", work / "evaluate") == 0
    explain = ("explain", work / "train", data, "-o", work / "explain", "--levels", "1", "0", "--method", "grad-cam")
    assert run(*explain) == 0
    assert run("score", work / "train", work / "explain", "-o", work / "score", "--steps", "4") == 0
    real = ("--frames", difference_folder, "--labels-in-names", "--method", "grad-cam")
    assert run("explain", work / "train", *real, "-o", work / "explain-real") == 0
    assert run("score", work / "train", work / "explain-real", "-o", work / "score-real", "--steps", "4") == 0
    assert run("report", work) == 0
    out = capsys.readouterr().out
    for name in ("train", "evaluate", "explain", "score", "explain-real", "score-real", "report.html"):
        assert (work / name).exists()
        assert str(work / name) in out.replace("\n", "")
    assert json.loads((work / "evaluate" / "result.json").read_text())["conditions"].keys() == {"dry", "wet"}
    assert not [path for path in work.iterdir() if path.name.startswith(".")]
    before = (work / "train" / "model.safetensors").stat().st_mtime_ns
    assert run(*train) == 0  # nothing to do
    assert (work / "train" / "model.safetensors").stat().st_mtime_ns == before
    assert "refused" not in capsys.readouterr().out
    assert "other settings" in refused(capsys, *train, "--seed", 1)


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (KeyboardInterrupt(), (130, "run the same command again to continue")),
        (OSError(28, "No space left on device", "a.npz"), (2, "a.npz could not be read or written (No space left on")),
    ],
)
def test_whatever_ends_a_command_is_one_sentence(error, told: tuple[int, str], monkeypatch, tmp_path: Path, capsys):
    def stop(workspace: Path) -> None:
        raise error

    monkeypatch.setattr("sliplens.report.page.write_report", stop)
    assert run("report", tmp_path) == told[0]
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert told[1] in line
