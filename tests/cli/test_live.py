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


def told_by_a_process(*words: str) -> str:
    """What `sliplens live` says: a process serves one page, and this one has other things to do."""
    ended = subprocess.run(
        [sys.executable, "-m", "sliplens", "live", *words], capture_output=True, text=True, timeout=120, check=True
    )
    return ended.stderr


def test_the_address_of_the_page_is_told_with_its_token(small_dataset: Dataset):
    pytest.importorskip("websockets")
    told = told_by_a_process(str(small_dataset.folder), "--seconds", "1", "--port", "0", "--host", "0.0.0.0")
    assert re.search(r"open http://\S+:\d+/\?token=\S{32}", told)


def test_what_can_be_read_is_listed(capsys: pytest.CaptureFixture[str]):
    assert main(["live", "--list"]) == 0
    assert "camera by its number or device file" in capsys.readouterr().out
