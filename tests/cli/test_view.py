"""`sliplens view`: a trial as a file of the Rerun viewer, and what is said to mistakes."""

from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from command_line import command

from sliplens.errors import InputError, RecordingError
from sliplens.recordings import Dataset
from sliplens.recordings.dataset import write_dataset_table

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
    for trial in (None, small_dataset.trials[3].trial):
        output = tmp_path / f"{trial}.rrd"
        command("view", source=small_dataset.folder, trial=trial, out=output)
        assert name_of(output) == (trial or small_dataset.trials[0].trial)
        assert f"rerun {output}" in capsys.readouterr().out.replace("\n", "")
    assert len(list(tmp_path.iterdir())) == 2


def test_a_table_of_predictions_finds_its_frames(small_dataset: Dataset, tmp_path: Path):
    rows = {"trial": ["test-wet-7"], "frame": [3], "prediction": [0.5], "low_90": [0.4], "high_90": [0.6]}
    table, output = tmp_path / "margins.parquet", tmp_path / "a.rrd"
    for source in (str(small_dataset.folder), str(tmp_path / "gone"), ""):
        pq.write_table(pa.table(rows).replace_schema_metadata({"sliplens.source": source}), table)
        if source == str(small_dataset.folder):
            command("view", source=table, out=output)
            assert name_of(output) == "test-wet-7"
            continue
        with pytest.raises(
            InputError, match=r"which does not exist; name the source first, and the table with --predic"
        ):
            command("view", source=table, out=tmp_path / "b.rrd")
    command("view", source=small_dataset.folder, trial="test-wet-7", predictions=table, out=tmp_path / "b.rrd")


def test_an_unknown_trial_is_refused_with_those_there_are(small_dataset: Dataset, tmp_path: Path):
    with pytest.raises(InputError, match=r"has no trial nobody; it has train-dry-0, .*, test-wet-7$"):
        command("view", source=small_dataset.folder, trial="nobody", out=tmp_path / "a.rrd")
    assert not list(tmp_path.iterdir())


def test_of_many_trials_ten_are_named(small_dataset: Dataset, tmp_path: Path):
    write_dataset_table(tmp_path, [small_dataset.trials[0]] * 12)
    with pytest.raises(InputError, match=r"it has (train-dry-0, ){9}train-dry-0 and 2 more$"):
        command("view", source=tmp_path, trial="nobody")


def test_a_file_that_exists_is_kept_unless_told_otherwise(small_dataset: Dataset, tmp_path: Path):
    output = tmp_path / "a.rrd"
    output.write_text("somebody's")
    with pytest.raises(InputError, match=r"a\.rrd exists; choose another file or pass --overwrite"):
        command("view", source=small_dataset.folder, out=output)
    assert output.read_text() == "somebody's"
    command("view", source=small_dataset.folder, out=output, overwrite=True)
    assert name_of(output) == small_dataset.trials[0].trial


def test_another_suffix_is_refused(small_dataset: Dataset, tmp_path: Path):
    with pytest.raises(InputError, match=r"a\.html does not end in \.rrd"):
        command("view", source=small_dataset.folder, out=tmp_path / "a.html")


def test_a_folder_that_is_no_data_set_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="does not exist"):
        command("view", source=tmp_path / "nothing")


def test_a_lost_trial_is_told(small_dataset: Dataset, tmp_path: Path):
    write_dataset_table(tmp_path, small_dataset.trials[:1])
    with pytest.raises(RecordingError, match="does not exist; make the data set again"):
        command("view", source=tmp_path, out=tmp_path / "a.rrd")
    assert [path.name for path in tmp_path.iterdir()] == ["dataset.json"]


def test_without_an_output_the_viewer_opens(small_dataset: Dataset, monkeypatch: pytest.MonkeyPatch, tmp_path, capsys):
    def connect(stream: Any, url: str) -> None:
        stream.save(tmp_path / "sent.rrd")

    monkeypatch.setattr(rerun.RecordingStream, "connect_grpc", connect)
    monkeypatch.setattr("sliplens.live.viewer.start_viewer", lambda: "rerun+http://127.0.0.1:1/proxy")
    command("view", source=small_dataset.folder, trial="test-wet-7")
    assert name_of(tmp_path / "sent.rrd") == "test-wet-7"
    # whoever opens it is told what it tells others
    assert "rerun analytics disable" in capsys.readouterr().out
