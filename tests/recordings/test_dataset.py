import json
import os
import weakref
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sliplens.errors import RecordingError
from sliplens.recordings import Recording, load_dataset
from sliplens.recordings.store import (
    ROW_GROUP,
    decode_pixels,
    encode_pixels,
    in_turn,
    load_recording,
    read_frames,
    save_recording,
)
from sliplens.recordings.trial import SIGNALS


def test_a_trial_of_many_chunks_comes_back_without_loss(tmp_path: Path, recording: Recording):
    count = 2 * ROW_GROUP + 5
    long = replace(
        recording,
        frames=np.resize(recording.frames, (count, *recording.frames.shape[1:])),
        time_s=np.arange(count) / 30,
        contact_state=(recording.contact_state[1],) * count,
        **{name: np.resize(getattr(recording, name), count) for name in SIGNALS[1:]},
    )
    save_recording(long, tmp_path / "a.parquet")
    assert pq.ParquetFile(tmp_path / "a.parquet").num_row_groups == 3
    back = load_recording(tmp_path / "a.parquet")
    for field in fields(Recording):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(long, field.name))
    np.testing.assert_array_equal(pq.read_table(tmp_path / "a.parquet")["frame"].to_numpy(), np.arange(count))
    places = [count - 1, 0, ROW_GROUP, ROW_GROUP - 1, 0]
    np.testing.assert_array_equal(read_frames(tmp_path / "a.parquet", places), long.frames[places])


def test_a_trial_without_its_pixels_is_all_but_these(tmp_path: Path, recording: Recording):
    save_recording(recording, tmp_path / "a.parquet")
    whole, bare = load_recording(tmp_path / "a.parquet"), load_recording(tmp_path / "a.parquet", pixels=False)
    for name in (*SIGNALS, "safety_margin_sigma", "valid", "contact_state", "reference", "trial", "sensor"):
        np.testing.assert_array_equal(getattr(bare, name), getattr(whole, name))
    np.testing.assert_array_equal(bare.frames, np.stack([recording.reference] * 12))
    # one image in memory, seen twelve times
    assert bare.frames.strides[0] == 0


def test_no_more_than_a_few_frames_are_held_while_a_long_trial_is_encoded():
    workers = os.cpu_count() or 1
    made: list[weakref.ref[np.ndarray]] = []
    most = 0

    def frames() -> Iterator[np.ndarray]:
        nonlocal most
        for index in range(100 * workers):
            frame = np.full((8, 8, 3), index % 256, dtype=np.uint8)
            made.append(weakref.ref(frame))
            yield frame
            most = max(most, sum(one() is not None for one in made))

    images = in_turn(encode_pixels, frames())
    decoded = [decode_pixels(image, size=(8, 8, 3), where="frame") for image in images]
    np.testing.assert_array_equal([one[0, 0, 0] for one in decoded], np.arange(100 * workers) % 256)
    # two a worker that wait or are worked on, one a worker that it has just done, and the newest
    assert most <= 3 * workers + 2


@pytest.mark.parametrize(
    ("column", "value", "said"),
    [
        ("contact_state", "flying", "'flying' is not a valid ContactState"),
        ("safety_margin", "half", "string as 'safety_margin' where numbers belong"),
        ("image", 3, "int64 as 'image' where bytes belong"),
    ],
)
def test_a_stored_trial_with_labels_that_no_trial_has_is_refused(
    tmp_path: Path, recording: Recording, column: str, value: object, said: str
):
    path = tmp_path / "a.parquet"
    save_recording(recording, path)
    table = pq.read_table(path)
    place = table.column_names.index(column)
    pq.write_table(table.set_column(place, column, pa.array([value] * table.num_rows)), path)
    with pytest.raises(RecordingError, match=rf"a\.parquet .*{said}.*; make the data set again"):
        load_recording(path)


def test_a_data_set_of_another_schema_is_refused(tmp_path: Path):
    (tmp_path / "dataset.json").write_text(json.dumps({"schema_version": 99}))
    with pytest.raises(RecordingError, match="is not a sliplens data set of schema 2; make it again"):
        load_dataset(tmp_path)
