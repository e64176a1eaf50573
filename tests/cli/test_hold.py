"""`sliplens hold`: what it prints and keeps, and what is said to mistakes."""

import json
from pathlib import Path

from command_line import run

from sliplens.codec import load_result
from sliplens.grip.records import Hold
from sliplens.recordings import Dataset


def test_a_line_of_json_a_command_and_a_table_of_all(small_dataset: Dataset, tmp_path: Path, capsys):
    fixed = ("--controller", "fixed", "--set", "force_n=9")
    words = ("hold", small_dataset.folder, "--gripper", "dry-run", *fixed, "--json")
    assert run(*words, "--ceiling", "3.5", "-o", tmp_path / "held") == 0
    captured = capsys.readouterr()
    steps = [json.loads(line) for line in captured.out.splitlines() if line.startswith("{")]
    assert {step["command_n"] for step in steps} == {3.5}
    assert 0 <= steps[-1]["readings"][0]["number"] <= 11
    assert "has ended; nothing was sent" in captured.err
    hold = load_result(tmp_path / "held", Hold, command="sliplens hold")
    assert (hold.gripper, hold.controller, hold.settings) == ("dry-run", "fixed", {"force_n": 9.0})
    assert hold.steps.time_s.tolist() == [step["time_s"] for step in steps]


def test_frames_of_another_sensor_are_told_once(small_dataset: Dataset, difference_run: Path, tmp_path: Path, capsys):
    profile = tmp_path / "tip.toml"
    profile.write_text('name = "another"\n', encoding="utf-8")
    words = ("hold", small_dataset.folder, "--network", difference_run, "--engine", "torch", "--sensor", profile)
    assert run(*words, "--gripper", "dry-run", "--controller", "fixed") == 0
    assert " ".join(capsys.readouterr().err.split()).count("the frames are of another") == 1
