"""Exported data sets: an import restores them bit by bit, whatever is changed in them is refused or does not matter."""

import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from data_sets import save_dataset
from exportable import make_trial
from memory import held_below
from there import there

from sliplens.errors import InputError, RecordingError
from sliplens.recordings import Dataset, import_recordings
from sliplens.recordings.capture import Capture
from sliplens.recordings.exporting import export_lerobot, export_mcap
from sliplens.recordings.formats.mcap import IMAGE
from sliplens.recordings.formats.stored import read_stored
from sliplens.recordings.options import ReadOptions
from sliplens.recordings.source import open_source
from sliplens.recordings.trial import Labels

pytest.importorskip("rosbags")
pytest.importorskip("mcap")

KINDS: dict[str, Callable[..., object]] = {"lerobot": export_lerobot, "mcap": export_mcap}


@pytest.fixture(scope="module", params=list(KINDS))
def exported(request: pytest.FixtureRequest, data: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exported") / request.param
    KINDS[request.param](data, folder)
    return folder


@pytest.fixture
def changed(exported: Path, tmp_path: Path) -> Path:
    """An export that may be changed."""
    return shutil.copytree(exported, tmp_path / exported.name)


def sources(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.mcap")) or [folder]


def read_all(folder: Path, **options: Any) -> dict[str, Capture]:
    opened = [open_source(path, options=ReadOptions(**options), whole=True) for path in sources(folder)]
    return {capture.trial: capture for captures in opened for capture in captures}


def assert_same(first: Capture, second: Capture) -> None:
    """Check that two captures are equal bit by bit, but for their sources."""
    for name in ("trial", "sensor", "day", "condition", "object", "split", "simulated", "frame_size", "notes"):
        assert getattr(first, name) == getattr(second, name)
    np.testing.assert_array_equal(list(first.read_frames()), list(second.read_frames()), strict=True)
    np.testing.assert_array_equal(first.frame_time_s, second.frame_time_s, strict=True)
    np.testing.assert_array_equal(there(first.reference), there(second.reference), strict=True)
    for field in fields(Labels):
        np.testing.assert_array_equal(getattr(there(first.labels), field.name), getattr(second.labels, field.name))
    assert (first.forces is None) == (second.forces is None)
    if first.forces is not None and second.forces is not None:
        assert first.forces.source == second.forces.source
        np.testing.assert_array_equal(first.forces.time_s, second.forces.time_s, strict=True)
        np.testing.assert_array_equal(first.forces.force_n, second.forces.force_n, strict=True)


def test_an_exported_trial_comes_back_bit_by_bit(data, exported):
    restored, stored = read_all(exported), read_stored(data.folder)
    assert len(restored) == len(stored) == 3
    assert restored["bare"].forces is None
    for capture in stored:
        assert_same(restored[capture.trial], capture)


def test_an_imported_export_has_the_hash_of_the_original(data, exported, tmp_path):
    again = import_recordings(sources(exported), out=tmp_path / "again")
    ordered = [again.find(info.trial) for info in data.trials]
    # the first import of "bare" notes where its labels come from; all else is the same file
    assert ordered[:2] == list(data.trials[:2])
    assert ordered[2].split == "test"


def test_where_a_topic_or_feature_is_named_it_is_read_as_any_recording(data, exported, tmp_path):
    KINDS[exported.name](data, tmp_path / "full", trials=["full"])
    options = {"image_topic": IMAGE} if exported.name == "mcap" else {"camera_key": "observation.images.tactile"}
    original, (capture,) = read_all(exported)["full"], read_all(tmp_path / "full", **options).values()
    assert capture.labels is None
    assert capture.reference is None
    assert capture.sensor == capture.split == ""
    np.testing.assert_array_equal(list(capture.read_frames()), list(original.read_frames()))
    if exported.name == "mcap":
        np.testing.assert_array_equal(there(capture.forces).force_n, there(original.forces).force_n)
    else:  # (F_t, 0, F_n) at the nominal times of LeRobot, in single precision
        np.testing.assert_array_equal(capture.frame_time_s, (np.arange(40) / 30).astype(np.float32))
        np.testing.assert_array_equal(there(capture.forces).force_n[:, 2], there(original.labels).normal_force_n)


def test_memory_does_not_grow_with_the_length_of_a_trial(tmp_path, exported, rng):
    count, size = 300, (120, 160)
    frames = np.broadcast_to(rng.integers(0, 256, (*size, 3), dtype=np.uint8), (count, *size, 3))
    trial = replace(make_trial("long", rng, count=count), frames=frames, reference=frames[0])
    data = save_dataset(tmp_path / "data", trial)
    # 17 MB of pixels: 16 frames and their PNG at a time, a chunk of 1 MiB a few times over
    with held_below(9e6):
        KINDS[exported.name](data, tmp_path / "out")
        (restored,) = read_all(tmp_path / "out").values()
        assert sum(1 for _ in restored.read_frames()) == count


def test_damaged_bytes_are_refused_or_do_not_matter(data, changed, rng):
    stored = {capture.trial: capture for capture in read_stored(data.folder)}
    refusals = []
    for file in [path for path in changed.rglob("*") if path.is_file() and path.name != "run.json"]:
        whole = file.read_bytes()
        for position in rng.integers(0, len(whole), 5).tolist():
            file.write_bytes(whole[:position] + bytes([whole[position] ^ 0x55]) + whole[position + 1 :])
            try:
                for capture in read_all(changed).values():
                    list(capture.read_frames())
                    if changed.name == "mcap":  # all of it has checksums
                        assert_same(capture, stored[capture.trial])
            except InputError as error:
                refusals.append(str(error))
        file.write_bytes(whole)
    assert len(refusals) > 10
    assert not any("\n" in text for text in refusals)


@pytest.mark.parametrize("name", ["../../etc/cron", "a/b", "/a", "..", "", "a\0b", 3, None])
def test_a_name_that_leads_out_of_the_folder_is_refused(changed, name):
    edit_table(changed, lambda table: table["trials"][0].update(trial=name))
    with pytest.raises(RecordingError, match=r"dataset\.json is not what was written: "):
        read_all(changed)


def edit_table(folder: Path, edit: Callable[[dict], object]) -> None:
    """Change the table of the trials without images, in a folder or among the attachments of bags."""
    if folder.name == "lerobot":
        path = folder / "meta" / "sliplens" / "dataset.json"
        table = json.loads(path.read_text())
        edit(table)
        path.write_text(json.dumps(table))
        return
    for path in folder.glob("*.mcap"):
        rewrite_bag(path, edit)


def rewrite_bag(
    path: Path, edit: Callable[[dict], object], *, schema: bytes | None = None, images: int = 10**9
) -> None:
    """Copy a bag with another table among its attachments, other definitions of messages, or fewer images."""
    from mcap.reader import make_reader  # noqa: PLC0415 (an extra)
    from mcap.writer import Writer  # noqa: PLC0415

    target = path.with_suffix(".part")
    with path.open("rb") as source, target.open("wb") as sink:
        writer, reader, channels = Writer(sink), make_reader(source), {}
        writer.start(profile="ros2", library="test")
        for kind, channel, message in reader.iter_messages(log_time_order=False):
            if channel.topic == IMAGE and (images := images - 1) < 0:
                continue
            if channel.topic not in channels:
                written = writer.register_schema(there(kind).name, there(kind).encoding, schema or there(kind).data)
                channels[channel.topic] = writer.register_channel(channel.topic, "cdr", written)
            writer.add_message(channels[channel.topic], message.log_time, message.data, message.publish_time)
        for attachment in reader.iter_attachments():
            content = attachment.data
            if attachment.name == "dataset.json":
                table = json.loads(content)
                edit(table)
                content = json.dumps(table).encode()
            writer.add_attachment(0, 0, attachment.name, attachment.media_type, content)
        writer.finish()
    target.replace(path)


def test_definitions_that_a_bag_brings_are_not_used(data, tmp_path):
    export_mcap(data, tmp_path / "mcap", trials=["full"])
    rewrite_bag(tmp_path / "mcap" / "full.mcap", lambda table: table, schema=b"uint8 x\n)(")
    assert_same(read_all(tmp_path / "mcap")["full"], read_stored(data.folder)[0])


def test_a_bag_or_an_episode_that_lacks_a_frame_is_refused(changed):
    if changed.name == "mcap":
        rewrite_bag(changed / "full.mcap", lambda table: table, images=39)
        message = r"full\.mcap has not the frames of trial full in"
    else:
        edit_table(changed, lambda table: table["trials"].pop())
        message = "describes 2 trials beside the images of 3"
    with pytest.raises(RecordingError, match=message):
        read_all(changed)


def test_trials_that_ros_or_lerobot_cannot_take_are_refused_and_nothing_stays(tmp_path, rng):
    late = save_dataset(tmp_path / "late", make_trial("late", rng, start_s=3e9))
    with pytest.raises(RecordingError, match=r"trial late goes to 3e.*; import it with times in seconds"):
        export_mcap(late, tmp_path / "out")
    first = make_trial("a", rng)
    small = {"frames": np.zeros((9, 8, 8, 3), np.uint8), "reference": np.zeros((8, 8, 3), np.uint8)}
    for changes, message in (
        ({"time_s": np.arange(9) / 60}, "trial b has another frame rate, and a LeRobot data set has one rate"),
        (small, "trial b has other frames, and a LeRobot data set has one size"),
    ):
        others = replace(first, trial="c"), replace(first, trial="b", **changes)
        mixed = save_dataset(tmp_path / f"{len(message)}", first, *others)
        with pytest.raises(RecordingError, match=message):
            export_lerobot(mixed, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("module", ["mcap", "rosbags"])
def test_without_the_libraries_the_extra_is_named(data, tmp_path, monkeypatch, module):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=r'pip install "sliplens\[ros\]"'):
        export_mcap(data, tmp_path / "out")
