"""`sliplens view`: a trial as a file of the Rerun viewer, and what is said to mistakes."""

from pathlib import Path
from typing import Any

import pytest
from command_line import typed

from sliplens.recordings import Dataset

rerun = pytest.importorskip("rerun")
chunk = pytest.importorskip("rerun.chunk")


def name_of(path: Path) -> str:
    """Name of the recording in a file."""
    names = [
        batch.column("RecordingInfo:name").to_pylist()
        for one in chunk.RrdReader(path).stream()
        for batch in [one.to_record_batch()]
        if "RecordingInfo:name" in batch.schema.names
    ]
    return names[-1][0][0]


def test_the_first_trial_is_written_unless_another_is_named(small_dataset: Dataset, tmp_path: Path, capsys):
    for trial, words in ((0, ()), (3, ("--trial", small_dataset.trials[3].trial))):
        output = tmp_path / f"{trial}.rrd"
        typed("view", small_dataset.folder, "-o", output, *words)
        assert name_of(output) == small_dataset.trials[trial].trial
        assert f"rerun {output}" in capsys.readouterr().out.replace("\n", "")
    assert len(list(tmp_path.iterdir())) == 2


def test_without_an_output_the_viewer_opens(small_dataset: Dataset, monkeypatch: pytest.MonkeyPatch, tmp_path, capsys):
    def connect(stream: Any, url: str) -> None:
        stream.save(tmp_path / "sent.rrd")

    monkeypatch.setattr(rerun.RecordingStream, "connect_grpc", connect)
    monkeypatch.setattr("sliplens.live.viewer.start_viewer", lambda: "rerun+http://127.0.0.1:1/proxy")
    typed("view", small_dataset.folder, "--trial", "test-wet-7")
    assert name_of(tmp_path / "sent.rrd") == "test-wet-7"
    # whoever opens it is told what it tells others
    assert "rerun analytics disable" in capsys.readouterr().out
