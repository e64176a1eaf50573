"""What `write_lerobot` keeps beside a data set is believed only as far as it can be true."""

import contextlib
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image
from readers import read_lerobot, refused

from sliplens.errors import RecordingError
from sliplens.recordings import ContactState, Recording, load_dataset
from sliplens.recordings.capture import Forces
from sliplens.recordings.dataset import trial_info, trial_path, write_dataset_table
from sliplens.recordings.formats.lerobot_export import write_lerobot
from sliplens.recordings.store import forces_path, save_forces, save_recording

HEIGHT, WIDTH, FRAMES = 24, 32, 20
CAMERA = "observation.images.tactile"


@pytest.fixture
def exported(tmp_path: Path, rng: np.random.Generator) -> Path:
    """Two trials, the first with samples of the force sensor; of both every frame slips a little more."""
    source, table = tmp_path / "source", []
    for trial in ("first", "second"):
        margin = np.linspace(0.9, 0.1, FRAMES)
        ones = np.ones(FRAMES)
        recording = Recording(
            trial=trial,
            sensor="dome",
            day=1,
            condition="dry",
            reference=rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8),
            frames=rng.integers(0, 256, (FRAMES, HEIGHT, WIDTH, 3), dtype=np.uint8),
            time_s=5 + np.arange(FRAMES) / 30.3,
            normal_force_n=ones,
            tangential_force_n=ones - margin,
            friction_coefficient=ones,
            safety_margin=margin,
            stick_ratio=margin,
            contact_state=(ContactState.INCIPIENT_SLIP,) * FRAMES,
        )
        save_recording(recording, trial_path(source, trial))
        if trial == "first":
            samples = Forces(time_s=np.arange(50) / 100, force_n=rng.normal(size=(50, 3)), source="/wrench")
            save_forces(samples, forces_path(source, trial))
        table.append(trial_info(trial_path(source, trial), split="train"))
    write_dataset_table(source, table)
    folder = tmp_path / "exported"
    folder.mkdir()
    write_lerobot(load_dataset(source), folder)
    return folder


def edit_line(folder: Path, number: int, edit: Callable[[dict[str, Any]], object]) -> None:
    path = folder / "meta" / "sliplens" / "trials.jsonl"
    lines = path.read_text().splitlines()
    trial = json.loads(lines[number])
    edit(trial)
    lines[number] = json.dumps(trial)
    path.write_text("\n".join(lines) + "\n")


def edit_info(folder: Path, edit: Callable[[dict[str, Any]], object]) -> None:
    path = folder / "meta" / "info.json"
    info = json.loads(path.read_text())
    edit(info)
    path.write_text(json.dumps(info))


def set_column(folder: Path, name: str, values: Any) -> None:
    path = folder / "data" / "chunk-000" / "file-000.parquet"
    table = pq.read_table(path)
    pq.write_table(table.set_column(table.schema.get_field_index(name), name, pa.array(values)), path)


def test_without_what_is_kept_it_is_a_data_set_like_any_other(exported):
    (exported / "meta" / "sliplens" / "trials.jsonl").unlink()
    first, second = read_lerobot(exported)
    assert (first.trial, second.trial) == ("exported-000000", "exported-000001")
    assert first.labels is None
    assert first.reference is None
    assert second.forces is not None
    # the nominal times of LeRobot, in single precision; (F_t, 0, F_n)
    np.testing.assert_array_equal(second.frame_time_s, (np.arange(FRAMES) / 30).astype(np.float32))
    np.testing.assert_array_equal(second.forces.force_n[:, 2], 1)


def test_a_feature_that_is_named_is_read_as_of_any_data_set(exported):
    for named in ({"camera_key": CAMERA}, {"force_key": "observation.force"}):
        capture = read_lerobot(exported, **named)[1]
        assert capture.labels is None
        assert capture.trial == "exported-000001"


@pytest.mark.parametrize("name", ["../../etc/cron", "a/b", "/a", "..", "", "a\0b", 3, None])
def test_a_name_that_leads_out_of_a_data_set_is_refused(exported, name):
    edit_line(exported, 1, lambda trial: trial["facts"].update(trial=name))
    refused(read_lerobot, exported, r"line 2 of .*trials\.jsonl is not what was written: .*facts|name")


def test_a_name_that_is_there_twice_is_refused(exported):
    edit_line(exported, 1, lambda trial: trial["facts"].update(trial="first"))
    refused(read_lerobot, exported, r"trials\.jsonl names a trial twice")


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "[" * 100_000, '{"format": "sliplens trial", "version": 99}', "\ufeff"]
)
def test_text_of_something_else_is_refused(exported, text):
    (exported / "meta" / "sliplens" / "trials.jsonl").write_text(text, encoding="utf-8")
    refused(read_lerobot, exported, r"line 1 of .*trials\.jsonl (is|does)")


def test_bytes_that_are_no_text_are_refused(exported):
    (exported / "meta" / "sliplens" / "trials.jsonl").write_bytes(b"\xff\xfe\x00")
    refused(read_lerobot, exported, r"trials\.jsonl cannot be read")


def test_episodes_that_changed_since_are_not_given_the_labels_of_others(exported):
    path = exported / "meta" / "sliplens" / "trials.jsonl"
    whole = path.read_text()
    path.write_text(whole.splitlines()[0])
    refused(read_lerobot, exported, r"are no longer those that .* tells of; export the trials again")
    path.write_text(whole)
    edit_line(exported, 0, lambda trial: trial.update(frames=FRAMES - 1))
    refused(read_lerobot, exported, "are no longer those that")


def test_a_missing_or_damaged_reference_is_refused(exported):
    path = exported / "meta" / "sliplens" / "reference-000001.png"
    whole = path.read_bytes()
    buffer = io.BytesIO()
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(buffer, format="PNG")
    # its header claims 4e9 pixels
    bomb = buffer.getvalue()[:16] + (65535).to_bytes(4, "big") * 2 + buffer.getvalue()[24:]
    for data, message in (
        (whole[: len(whole) // 2], r"reference-000001\.png cannot be read as PNG"),
        (bomb, r"reference-000001\.png cannot be read as PNG"),
        (buffer.getvalue(), "has frames of 24 x 32 pixels but a reference of 8 x 8"),
    ):
        path.write_bytes(data)
        refused(read_lerobot, exported, message)
    path.unlink()
    refused(read_lerobot, exported, r"reference-000001\.png cannot be read \(No such file")


def test_missing_or_damaged_samples_are_refused(exported):
    path = exported / "meta" / "sliplens" / "forces-000000.parquet"
    table = pq.read_table(path)
    pq.write_table(table.slice(0, 20), path)
    refused(read_lerobot, exported, r"forces-000000\.parquet has 20 samples of first, 50 were exported")
    path.write_bytes(path.read_bytes()[:-9])
    refused(read_lerobot, exported, r"forces-000000\.parquet is not a readable Parquet file")
    path.unlink()
    refused(read_lerobot, exported, r"forces-000000\.parquet does not exist")


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("observation.safety_margin", [1.5] * 2 * FRAMES, "safety_margin of frame 0 is 1.5, outside"),
        ("observation.safety_margin", ["1"] * 2 * FRAMES, "safety_margin of .* does not hold numbers"),
        ("observation.time_s", [float("nan")] * 2 * FRAMES, "episode 0 of .* has a time that is not a number; export"),
        ("observation.time_s", [1.0] * 2 * FRAMES, "time does not rise at sample 1"),
        ("observation.valid", [1] * 2 * FRAMES, "valid of .* does not hold true and false"),
        ("observation.contact_state", [5] * 2 * FRAMES, "contact_state of .* leads beyond the 5 values"),
        ("observation.contact_state", [-1] * 2 * FRAMES, "contact_state of .* leads beyond the 5 values"),
        ("observation.invalid_reason", [1.0] * 2 * FRAMES, "invalid_reason of .* does not hold whole numbers"),
        ("observation.invalid_reason", [None] * 2 * FRAMES, "has gaps in the column 'observation.invalid_reason'"),
        ("observation.force", [[1.0, 2.0]] * 2 * FRAMES, "force of .* does not hold 3 numbers a frame"),
    ],
)
def test_labels_that_cannot_be_are_refused(exported, name, values, message):
    set_column(exported, name, values)
    refused(read_lerobot, exported, message)


def test_words_that_are_not_known_are_refused(exported):
    state = "observation.contact_state"
    edit_info(exported, lambda info: info["features"][state]["info"].update(values=["flying"] * 5))
    refused(read_lerobot, exported, "has the contact state 'flying', none of no contact, contact")
    for broken in ({"values": "abcde"}, {"values": [1, 2, 3, 4, 5]}, {}, None, []):
        edit_info(exported, lambda info, broken=broken: info["features"][state].update(info=broken))
        refused(read_lerobot, exported, r"does not list the values of observation\.contact_state")
    edit_info(exported, lambda info: info["features"].pop(state))
    refused(read_lerobot, exported, r"lacks observation\.contact_state; copy the data set again, or remove")


def test_an_episode_is_read_without_those_that_share_its_file(exported):
    first, second = read_lerobot(exported)[:2]
    path = exported / "data" / "chunk-000" / "file-000.parquet"
    damaged = bytearray(path.read_bytes())
    group = pq.read_metadata(path).row_group(0)
    images = next(
        group.column(at) for at in range(group.num_columns) if group.column(at).path_in_schema.endswith("bytes")
    )
    damaged[images.data_page_offset : images.data_page_offset + images.total_compressed_size] = bytes(
        images.total_compressed_size
    )
    path.write_bytes(damaged)
    assert len(list(second.read_frames())) == FRAMES
    with pytest.raises(RecordingError, match=r"file-000\.parquet is not a readable Parquet file"):
        list(first.read_frames())


def test_a_data_set_with_any_byte_changed_raises_no_foreign_error(exported, rng):
    for file in [path for path in exported.rglob("*") if path.is_file()]:
        whole = file.read_bytes()
        for at in rng.integers(0, len(whole), 10):
            damaged = bytearray(whole)
            damaged[at] ^= int(rng.integers(1, 256))
            file.write_bytes(damaged)
            with contextlib.suppress(RecordingError):
                for capture in read_lerobot(exported):
                    list(capture.read_frames())
        file.write_bytes(whole)
