"""`sliplens live`: lines of JSON, lines for people, and what is there."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from sliplens.cli import main
from sliplens.recordings import Dataset


def test_a_line_of_json_a_reading(small_dataset: Dataset, difference_run: Path, capfdbinary: pytest.CaptureFixture):
    words = ["live", str(small_dataset.folder), "--network", str(difference_run), "--engine", "torch"]
    assert main([*words, "--speed", "2.0", "--sink", "json", "--no-page"]) == 0
    lines = [json.loads(line) for line in capfdbinary.readouterr().out.splitlines()]
    assert lines
    for line in lines:
        # frames of noise are not healthy, and the margin of those is withheld
        assert line["withheld"] or 0 <= line["margin"] <= 1
        assert {"exposure", "touch"} <= {check["name"] for check in line["health"]}
        assert set(line["latency"]) == {"decode_ms", "checks_ms", "encode_ms", "network_ms", "total_ms"}
    assert lines[-1]["number"] == 11
    assert len(lines) + lines[-1]["dropped"] + lines[0]["number"] == 12


def test_a_line_for_people(small_dataset: Dataset, capsys: pytest.CaptureFixture[str]):
    assert main(["live", str(small_dataset.folder), "--speed", "4", "--no-page"]) == 0
    # a frame is not healthy, or there is no network
    assert re.search("name one with --network|no margin: .*; ", capsys.readouterr().out)


def test_the_network_is_that_of_the_profile(small_dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    profile = tmp_path / "tip.toml"
    profile.write_text('name = "tip"\nnetwork = "trained-elsewhere"\n', encoding="utf-8")
    assert main(["live", str(small_dataset.folder), "--sensor", str(profile), "--no-page"]) == 2
    assert "the run trained-elsewhere does not exist" in " ".join(capsys.readouterr().err.split())


def told_by_a_process(*words: str) -> str:
    """What `sliplens live` says: a process serves one page, and this one has other things to do."""
    ended = subprocess.run(
        [sys.executable, "-m", "sliplens", "live", *words], capture_output=True, text=True, timeout=120, check=True
    )
    return ended.stderr


def test_the_address_of_the_page_is_told_with_its_token(small_dataset: Dataset):
    pytest.importorskip("nicegui")
    told = told_by_a_process(str(small_dataset.folder), "--seconds", "1", "--port", "0", "--host", "0.0.0.0")
    assert re.search(r"open http://\S+:\d+/\?token=\S{32}", told)


def test_what_can_be_read_is_listed(capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("linuxpy")
    assert main(["live", "--list"]) == 0
    assert "camera by its number or device file" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["99"], "the camera /dev/video99 is not there; plug it in"),
        (["0", "--size", "640"], "--size requires 2"),
        (["simulated", "--sink", "paper"], "there is no sink named 'paper'; choose one of json"),
        (["simulated", "--speed", "2"], "the simulated fingertip takes no --speed; leave it out"),
        (["nowhere"], "nowhere is no source that is known"),
    ],
)
def test_mistakes_are_told_in_a_sentence(words: list[str], told: str, capsys: pytest.CaptureFixture[str]):
    assert main(["live", *words]) == 2
    assert told in " ".join(capsys.readouterr().err.split())


def test_the_command_shows_no_page_where_none_is_wanted(capsys: pytest.CaptureFixture[str]):
    assert main(["live", "--seconds", "0.3", "--no-page"]) == 0
    assert "open http" not in capsys.readouterr().err
