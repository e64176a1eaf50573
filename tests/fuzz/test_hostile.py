"""A slice of the hostile inputs of every format (`make fuzz` runs them all), and what was once let in."""

import json
import os
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hostile import FORMATS, IMPOSSIBLE, Input, claim_size, inputs, outcome
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplens.codec import from_builtins, read_parquet
from sliplens.errors import ImageError, InputError, RecordingError, SliplensError
from sliplens.files import parse_json, require_file
from sliplens.friction import MOST_FRICTION, Friction
from sliplens.images import read_image, write_png
from sliplens.progress import visible
from sliplens.recordings.labelling import FrictionEstimate
from sliplens.recordings.labels.axes import middles
from sliplens.recordings.store import save_recording, stream_frames
from sliplens.recordings.trial import Recording

SLOW = {"network", "weights", "forces", "manifest", "arrays", "tables", "stages"}
"""Formats whose readings take long; of these a few inputs are enough here."""


def some() -> list[Input]:
    drawn = [one for one in inputs(600, seed=3) if one.seed == 3]
    quick = [one for one in drawn if one.format not in SLOW][:24]
    return quick + [one for name in sorted(SLOW) for one in [one for one in drawn if one.format == name][:1]]


@pytest.fixture(scope="session")
def originals(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("originals")


@pytest.mark.parametrize("one", some(), ids=lambda one: f"{one.format}-{one.change}")
def test_a_hostile_input_is_refused_in_a_sentence_or_read_as_it_is(one: Input, originals: Path, tmp_path: Path):
    kind, said = outcome(one, originals, tmp_path / "input")
    assert kind in {"refused", "same", "accepted"}, said


def test_a_number_that_no_stage_measures_is_told_wherever_it_stands_in_a_result(originals: Path, tmp_path: Path):
    for seed in range(6):
        one = Input(format="tables", change="-1e9", seed=seed)
        kind, said = outcome(one, originals, tmp_path / str(seed))
        assert kind == "refused", one
        assert "-1e+09" in said


def test_an_array_whose_header_is_no_text_is_told(originals: Path, tmp_path: Path):
    kind, said = outcome(Input(format="arrays", change="zeros inside", seed=2430), originals, tmp_path / "input")
    assert (kind, "cannot be read as arrays" in said) == ("refused", True)


def test_every_change_of_every_format_comes_before_any_comes_again():
    pairs = sum(len(kind.changes) for kind in FORMATS.values())
    drawn = list(inputs(pairs + 1, seed=5))
    assert len({(one.format, one.change) for one in drawn}) == pairs
    assert drawn[-1].seed == 6
    assert {change for kind in FORMATS.values() for change in kind.changes} >= IMPOSSIBLE


JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)


@settings(max_examples=40)
@given(JSON_VALUES)
def test_json_is_a_record_or_a_sentence(value: object):
    text = json.dumps(value)
    try:
        estimate = from_builtins(
            parse_json(text, where="a file", cure="mend it"), FrictionEstimate, where="a file", command="sliplens label"
        )
    except SliplensError as error:
        told = str(error)
        assert told.startswith(("a file ", "a file:"))
        assert "\n" not in told
    else:
        assert 0 < estimate.low <= estimate.mu <= estimate.high


@given(st.binary(max_size=60))
def test_bytes_are_json_or_a_sentence(data: bytes):
    try:
        expected = json.loads(data.decode(), parse_constant=float)
    except (ValueError, RecursionError):
        expected = None
    try:
        assert parse_json(data, where="a file", cure="mend it") == expected
    except InputError as error:
        told = str(error)
        assert told.startswith("a file")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[" * 65 + "]" * 65, "nests more than 64 deep"),
        ("[" * 100_000, "is not valid JSON"),
        ("9" * 5000, "is not valid JSON|64 bits"),
        (f'{{"a": [{2**64}]}}', "64 bits"),
        ("NaN", "is not valid JSON"),
        ("1e999", "is not valid JSON"),
    ],
)
def test_json_that_nothing_of_ours_holds_is_refused(text: str, said: str):
    with pytest.raises(InputError, match=said):
        parse_json(text, where="a file", cure="mend it")
    assert parse_json("[" * 63 + "]" * 63, where="a file", cure="mend it")
    assert parse_json(str(2**64 - 1), where="a file", cure="mend it") == 2**64 - 1


def test_whatever_is_no_file_is_not_opened(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to("loop")
    for name in ("pipe", ".", "loop", "nothing", "x" * 300, "a\0b"):
        with pytest.raises(InputError, match="; name another"):
            require_file(tmp_path / name, missing="name another")
    (tmp_path / "file").write_bytes(b"123")
    assert require_file(tmp_path / "file") == 3
    with pytest.raises(InputError, match="has 3 bytes, and no such file has more than 2"):
        require_file(tmp_path / "file", most=2)


def test_a_small_table_that_claims_to_be_large_is_not_read(tmp_path: Path):
    once = pa.DictionaryArray.from_arrays(np.zeros(50_000, dtype=np.int32), [b"x" * 100_000])
    pq.write_table(pa.table({"x": once}), tmp_path / "x.parquet", compression="zstd", store_schema=False)
    with pytest.raises(InputError, match=r"claims 50,000 rows"):
        read_parquet(tmp_path / "x.parquet", {"x": "bytes"}, cure="mend it")


def test_a_gap_among_the_pictures_of_a_trial_is_told(recording: Recording, tmp_path: Path):
    save_recording(recording, path := tmp_path / "trial.parquet")
    table = pq.read_table(path)
    pictures = pa.array([None, *table.column("image").to_pylist()[1:]], pa.binary())
    pq.write_table(table.set_column(table.column_names.index("image"), "image", pictures), path)
    with pytest.raises(RecordingError, match=r"frame 0 of .* cannot be read"):
        list(stream_frames(path))


def test_a_sentence_has_an_end_whatever_a_file_holds():
    told = str(InputError(f"{'x' * 10_000}; mend it"))
    assert len(told) == 1500
    assert told.endswith("xx; mend it")
    assert str(InputError("y" * 1500)) == "y" * 1500


def test_no_picture_is_opened_that_no_camera_takes(tmp_path: Path):
    write_png(tmp_path / "x.png", np.zeros((4, 4, 3), dtype=np.uint8))
    claim_size(tmp_path / "x.png", (10_001, 10_000))
    with pytest.raises(ImageError, match="10001 x 10000 pixels are more than any camera has"):
        read_image(tmp_path / "x.png")


def test_windows_over_a_gap_are_as_many_as_samples_fill():
    time = np.concatenate([np.arange(0, 1, 0.01), 1e9 + np.arange(0, 1, 0.01)])
    assert len(middles(time, 0.0, time[-1], width_s=0.03)) < 80
    assert np.array_equal(middles(time[:100], 0.0, 1.0, width_s=0.03), np.arange(0.015, 1.0, 0.03))


def test_friction_of_nothing_that_slides_is_refused():
    for value in (1e56, MOST_FRICTION * 1.01, 0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match="coefficient of friction"):
            Friction(value)
        with pytest.raises(RecordingError, match="coefficient of friction"):
            FrictionEstimate(mu=value, low=value, high=value)
    assert Friction(MOST_FRICTION).mean == pytest.approx(MOST_FRICTION)


@given(st.text(max_size=30))
def test_a_terminal_obeys_nothing_of_a_file(text: str):
    shown = visible(text)
    assert not {one for one in shown if ord(one) < 32 or 127 <= ord(one) < 160} - {"\t", "\n"}
    assert visible(shown) == shown
    if text.isprintable():
        assert shown == text
