"""`sliplens predict`: the file it writes, and what is said to mistakes."""

from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from command_line import table_cells, typed
from own_recording import write_images, write_video
from pyarrow.csv import read_csv

from sliplens import __version__
from sliplens.files import hash_file, hash_json, read_json
from sliplens.images import write_png
from sliplens.models.checkpoint import STRANGE_REASON
from sliplens.recordings import Dataset, Recording
from sliplens.simulation import PRESETS, plan_trials, simulate_trial


def run(*words: object) -> None:
    typed("predict", *words)


def test_a_data_set_is_predicted(
    difference_run: Path, small_dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    output = tmp_path / "new" / "a.parquet"
    run(difference_run, small_dataset.folder, "-o", output, "--split", "test")
    table = pq.read_table(output)
    assert table.num_rows == 24
    told = {key.decode(): value.decode() for key, value in table.schema.metadata.items() if key.startswith(b"sliplens")}
    assert told == {
        "sliplens.version": __version__,
        "sliplens.engine": "torch",  # for so few frames
        "sliplens.manifest_hash": hash_json(read_json(difference_run / "manifest.json")),
        "sliplens.weights_sha256": hash_file(difference_run / "model.safetensors"),
    }
    assert "24 frames, by torch" in capsys.readouterr().out
    assert [path.name for path in output.parent.iterdir()] == ["a.parquet"]


def test_a_video_alone_is_read_by_a_network_and_beside_a_frame_that_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    trial = simulate_trial(replace(plan_trials(PRESETS["small"])[0], frames=20))
    write_video(trial, tmp_path / "cup.mkv")
    (tmp_path / "tip.toml").write_text('name = "tip"\nnetwork = "thesis-raw"\n')
    run(tmp_path / "cup.mkv", "--engine", "torch")
    alone = " ".join(capsys.readouterr().err.split())
    assert "no network was named, so chromatouch-pair is used, which comes with sliplens" in alone
    assert "its first frame was taken for the untouched sensor" in alone
    run(tmp_path / "cup.mkv", "--engine", "torch", "--sensor", tmp_path / "tip.toml")
    known = " ".join(capsys.readouterr().err.split())
    assert "so thesis-raw is used, which the profile tip names" in known
    assert "the frames are of tip" in known
    assert "untouched" not in known


def test_few_frames_are_told_one_by_one(difference_run: Path, difference_folder: Path, tmp_path: Path, capsys):
    run(difference_run, difference_folder, "-o", tmp_path / "a.parquet")
    rows = pq.read_table(tmp_path / "a.parquet").to_pylist()
    assert [row["file"].split("_")[0] for row in rows] == ["frame1", "frame6", "frame11"]
    printed = capsys.readouterr()
    assert "taken for difference images" in printed.err.replace("\n", " ")
    lines = printed.out.splitlines()
    for row in rows:
        (line,) = (line for line in lines if row["file"] in line)
        assert f"{100 * row['prediction']:.0f} %" in line
        assert row["low_90"] is None or f"{100 * row['low_90']:.0f} to {100 * row['high_90']:.0f} %" in line


def test_many_frames_are_told_by_their_lowest(difference_run: Path, small_dataset: Dataset, tmp_path: Path, capsys):
    run(difference_run, small_dataset.folder, "-o", tmp_path / "a.csv", "--plot", tmp_path / "a.png")
    rows = read_csv(tmp_path / "a.csv").to_pylist()
    cells = table_cells(capsys.readouterr().out)
    for trial in {row["trial"] for row in rows}:
        margins = [row["prediction"] for row in rows if row["trial"] == trial]
        touching = [row["prediction"] for row in rows if row["trial"] == trial and row["touches"]]
        (row,) = (row for row in cells if row[0] == trial)
        assert row[1] == f"{100 * min(touching):.0f} %"
        assert row[3:] == [str(len(margins)), str(len(touching))]
    assert {"normal_force_n", "tangential_force_n", "safety_margin"} <= rows[0].keys()
    assert (tmp_path / "a.png").stat().st_size > 10_000


@pytest.mark.parametrize("shown", [slice(10, 20), slice(None)])  # a line a frame, and a line a trial
def test_what_is_withheld_has_no_margin_on_the_terminal(
    trials: dict[str, Recording], tmp_path: Path, capsys: pytest.CaptureFixture[str], shown: slice
):
    trial = trials["flat-gel"]
    write_png(tmp_path / "untouched.png", trial.reference)
    write_images(tmp_path / "frames", trial.frames[shown], "{:02}.png")
    options = ("--reference", tmp_path / "untouched.png", "-o", tmp_path / "a.csv")
    run("chromatouch-difference", tmp_path / "frames", *options)
    lines = capsys.readouterr().out.splitlines()
    withheld = [row["file"] for row in read_csv(tmp_path / "a.csv").to_pylist() if row["withheld"]]
    assert any(STRANGE_REASON in line for line in lines)
    counts = [int(line.split()[2]) for line in lines if line.startswith("withheld in ")]
    assert sum(counts) == len(withheld) > 0
    if shown == slice(None):
        [row] = (row for row in table_cells("\n".join(lines)) if row[0] == "frames")
        assert (row[1], row[-1]) == ("none", str(len(withheld)))
    else:
        told = {line.split()[1]: line for line in lines if ".png" in line}
        assert all("withheld" in told[name] for name in withheld)
        assert not any(" to " in told[name] for name in withheld)
