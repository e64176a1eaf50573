"""Trials written as MCAP come back bit by bit; the format's own library reads them with nothing but the file."""

import io
import json
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labelled import LABELLING
from memory import held_below
from PIL import Image
from readers import read_rosbag, refused
from there import there

from sliplens.codec import to_builtins
from sliplens.errors import InputError, RecordingError
from sliplens.recordings.capture import Capture, Forces
from sliplens.recordings.dataset import Dataset, load_dataset, trial_info, trial_path, write_dataset_table
from sliplens.recordings.exporting import export_mcap
from sliplens.recordings.formats.stored import read_stored
from sliplens.recordings.store import forces_path
from sliplens.recordings.trial import LABEL_SIGNALS, ContactState, Labels
from sliplens.recordings.trial_writer import import_trial

pytest.importorskip("rosbags")
pytest.importorskip("mcap")
pytest.importorskip("mcap_ros2")

from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_typestore

from sliplens.recordings.formats.mcap import write_mcap

HEIGHT, WIDTH, FRAMES, SAMPLES = 12, 16, 40, 1200
LABELS, IMAGE, TRIAL = "/tactile/labels", "/tactile/image", "/tactile/trial"
TYPES = get_typestore(Stores.LATEST)

Edit = Callable[[str, int, bytes], bytes | None]
"""What becomes of a message, given its topic, its number there, and its bytes; None drops it."""


def make_labels(rng: np.random.Generator, *, full: bool) -> Labels:
    margin = rng.uniform(size=FRAMES)
    margin[:3] = np.nan  # nothing touches yet
    margin[3:5] = 1, 0
    signals: dict[str, Any] = {name: rng.normal(size=FRAMES) for name in LABEL_SIGNALS} | {
        "safety_margin": margin,
        "stick_ratio": margin**2,
    }
    states = list(ContactState)
    return Labels(
        **signals,
        contact_state=tuple(states[i % len(states)] for i in range(FRAMES)),
        safety_margin_sigma=rng.exponential(size=FRAMES) if full else None,
        valid=rng.uniform(size=FRAMES) < 0.5 if full else None,
        reason=tuple(("no contact", "")[i % 2] for i in range(FRAMES)) if full else None,
        labelling=LABELLING if full else None,
    )


def make_capture(name: str, rng: np.random.Generator, *, start_s: float, full: bool, forces: bool) -> Capture:
    frames = rng.integers(0, 256, (FRAMES, HEIGHT, WIDTH, 3), dtype=np.uint8)
    samples = None
    if forces:
        # steps from 1 us to 1 ms, thirds of which no nanosecond holds
        time = start_s - 0.01 + np.cumsum(rng.uniform(1e-6, 1e-3, SAMPLES)) / 3
        samples = Forces(time_s=time, force_n=rng.normal(size=(SAMPLES, 3)), source="/wrench of bag")
    return Capture(
        trial=name,
        source=name,
        frame_time_s=start_s + np.arange(FRAMES) / 30,
        frame_size=(HEIGHT, WIDTH),
        read_frames=lambda: iter(frames),
        forces=samples,
        labels=make_labels(rng, full=full),
        reference=rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8),
        sensor="Sensor 1",
        day=3,
        condition="wet",
        object="cup" if full else "",
        split="test",
    )


def store(captures: list[Capture], folder: Path) -> Dataset:
    """Import into a data set, as `sliplens import` does."""
    table = []
    for capture in captures:
        path, samples = trial_path(folder, capture.trial), forces_path(folder, capture.trial)
        import_trial(capture, path, rng=np.random.default_rng(0), forces_file=samples)
        table.append(trial_info(path, split=capture.split))
    write_dataset_table(folder, table)
    return load_dataset(folder)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A trial with all there can be, from before zero on; one in seconds since 1970; one without a force, at zero."""
    rng = np.random.default_rng(20261121)
    captures = [
        make_capture("full", rng, start_s=-2.7, full=True, forces=True),
        make_capture("since-1970", rng, start_s=1_742_563_762.69, full=True, forces=True),
        make_capture("bare", rng, start_s=0.0, full=False, forces=False),
    ]
    unknown = np.full(FRAMES, np.nan)
    bare = {**vars(captures[2].labels), "normal_force_n": unknown, "tangential_force_n": unknown}
    captures[2] = Capture(**{**vars(captures[2]), "labels": Labels(**bare)})
    return store(captures, tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def exported(data: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mcap")
    write_mcap(data, folder)
    return folder


def decoded(path: Path) -> dict[str, list[tuple[Any, Any]]]:
    """Records and decoded messages by topic, by the format's own library from the schemas of the file."""
    found = defaultdict(list)
    with path.open("rb") as stream:
        for _, channel, record, message in make_reader(
            stream, validate_crcs=True, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages(log_time_order=False):
            found[channel.topic].append((record, message))
    return found


def rewrite(path: Path, target: Path, edit: Edit, *, schema: bytes | None = None) -> Path:
    """Copy a file message by message, some of them changed."""
    with path.open("rb") as source, target.open("wb") as sink:
        writer = Writer(sink)
        writer.start(profile="ros2", library="test")
        channels, counts = {}, defaultdict(int)
        for kind, channel, message in make_reader(source).iter_messages(log_time_order=False):
            assert kind is not None
            index, counts[channel.topic] = counts[channel.topic], counts[channel.topic] + 1
            data = edit(channel.topic, index, message.data)
            if data is None:
                continue
            if channel.topic not in channels:
                written = writer.register_schema(kind.name, kind.encoding, schema or kind.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "cdr", written)
            writer.add_message(channels[channel.topic], message.log_time, data, message.publish_time)
        writer.finish()
    return target


def text_message(text: str) -> bytes:
    return bytes(TYPES.serialize_cdr(TYPES.types["std_msgs/msg/String"](data=text), "std_msgs/msg/String"))


def edit_text(change: Callable[[str], str]) -> Edit:
    def edit(topic: str, index: int, data: bytes) -> bytes:
        if topic != TRIAL:
            return data
        message: Any = TYPES.deserialize_cdr(data, "std_msgs/msg/String")
        return text_message(change(message.data))

    return edit


def edit_table(**entries: Any) -> Edit:
    return edit_text(lambda text: json.dumps({**json.loads(text), **entries}))


def drop(topic: str, index: int | None = None) -> Edit:
    return lambda where, at, data: None if where == topic and index in {None, at} else data


def replace_bytes(topic: str, old: bytes, new: bytes) -> Edit:
    return lambda where, _, data: data.replace(old, new) if where == topic else data


def assert_same(found: Capture, expected: Capture) -> None:
    for name in ("trial", "sensor", "day", "condition", "object", "split", "simulated", "frame_size"):
        assert getattr(found, name) == getattr(expected, name)
    assert found.notes == expected.notes == ()
    np.testing.assert_array_equal(found.frame_time_s, expected.frame_time_s, strict=True)
    np.testing.assert_array_equal(list(found.read_frames()), list(expected.read_frames()), strict=True)
    np.testing.assert_array_equal(there(found.reference), np.array(expected.reference), strict=True)
    assert found.reference_index == expected.reference_index
    assert (found.forces is None) == (expected.forces is None)
    pairs = [(there(found.labels), expected.labels)] + ([(found.forces, expected.forces)] if found.forces else [])
    for one, other in pairs:
        assert set(vars(one)) <= set(vars(other))  # labels that were stored are a whole recording
        for name, value in vars(one).items():
            if isinstance(value, np.ndarray):
                np.testing.assert_array_equal(value, vars(other)[name], strict=True)
            else:
                assert value == vars(other)[name]


def test_a_trial_comes_back_bit_by_bit(data, exported):
    assert sorted(file.name for file in exported.iterdir()) == ["bare.mcap", "full.mcap", "since-1970.mcap"]
    stored = {capture.trial: capture for capture in read_stored(data.folder)}
    assert stored["bare"].forces is None
    assert there(stored["full"].labels).safety_margin_sigma is not None
    for name, capture in stored.items():
        assert_same(read_rosbag(exported / f"{name}.mcap"), capture)


def test_imported_again_the_data_set_has_the_same_hash(data, exported, tmp_path):
    # the hash is that of every file, so of all frames, times, labels, descriptions and force samples
    again = store([read_rosbag(exported / f"{info.trial}.mcap") for info in data.trials], tmp_path / "again")
    assert again.hash == data.hash
    info = data.trials[0]
    np.testing.assert_array_equal(again.load(info).frames, data.load(info).frames)


def test_a_simulated_trial_writes_the_forces_of_its_frames(small_dataset, tmp_path):
    write_mcap(small_dataset, tmp_path, trials=small_dataset.trials[:1])
    (path,) = tmp_path.iterdir()
    recording = small_dataset.load(small_dataset.trials[0])
    found = decoded(path)["/tactile/wrench"]
    pushes = [
        (m.wrench.force.x, m.wrench.force.y, m.wrench.force.z, m.wrench.torque.x, m.wrench.torque.y, m.wrench.torque.z)
        for _, m in found
    ]
    zero = np.zeros(len(recording))
    expected = np.stack([recording.tangential_force_n, zero, recording.normal_force_n, zero, zero, zero], axis=-1)
    np.testing.assert_array_equal(pushes, expected)
    assert_same(read_rosbag(path), read_stored(small_dataset.folder)[0])
    assert read_rosbag(path).simulated


def test_the_library_of_the_format_decodes_every_message_from_the_file_alone(data, exported):
    for expected in read_stored(data.folder):
        path = exported / f"{expected.trial}.mcap"
        found = decoded(path)
        labels = expected.labels
        assert labels is not None
        (_, text), *others = found[TRIAL]
        table = json.loads(text.data)
        assert not others
        assert (table["facts"]["trial"], table["facts"]["sensor"], table["frames"]) == (
            expected.trial,
            "Sensor 1",
            FRAMES,
        )
        assert table["labelling"] == json.loads(json.dumps(to_builtins(labels.labelling)))
        ((_, reference),) = found["/tactile/reference"]
        np.testing.assert_array_equal(np.array(Image.open(io.BytesIO(reference.data))), expected.reference)
        for (_, message), frame in zip(found[IMAGE], expected.read_frames(), strict=True):
            assert message.format == "png"
            np.testing.assert_array_equal(np.array(Image.open(io.BytesIO(message.data))), frame)
        for name in LABEL_SIGNALS:
            np.testing.assert_array_equal([getattr(m, name) for _, m in found[LABELS]], getattr(labels, name))
        sigma = labels.safety_margin_sigma
        np.testing.assert_array_equal(
            [m.safety_margin_sigma for _, m in found[LABELS]], np.full(FRAMES, np.nan) if sigma is None else sigma
        )
        valid = np.isfinite(labels.safety_margin) if labels.valid is None else labels.valid
        assert [m.valid for _, m in found[LABELS]] == valid.tolist()
        assert [m.contact_state for _, m in found[LABELS]] == [str(state) for state in labels.contact_state]
        assert [m.invalid_reason for _, m in found[LABELS]] == list(labels.reason or [""] * FRAMES)
        np.testing.assert_array_equal([m.data for _, m in found["/tactile/safety_margin"]], labels.safety_margin)
        assert ("/tactile/wrench" in found) == ("/tactile/wrench_times" in found) == (expected.forces is not None)


def test_stamps_are_the_times_to_the_nanosecond_later_by_whole_seconds(data, exported):
    for expected in read_stored(data.folder):
        found = decoded(exported / f"{expected.trial}.mcap")
        offset_s = json.loads(found[TRIAL][0][1].data)["stamp_offset_s"]
        # -2.71 s goes to 1.29 s, 0 to 1; seconds since 1970 stay
        assert offset_s == {"full": 4, "since-1970": 0, "bare": 1}[expected.trial]
        series = {IMAGE: expected.frame_time_s, LABELS: expected.frame_time_s}
        if expected.forces is not None:
            series["/tactile/wrench"] = expected.forces.time_s
            exact = [time for _, m in found["/tactile/wrench_times"] for time in m.time_s]
            assert exact == expected.forces.time_s.tolist()
        assert [m.time_s for _, m in found[LABELS]] == expected.frame_time_s.tolist()
        for topic, time_s in series.items():
            for (record, message), time in zip(found[topic], time_s.tolist(), strict=True):
                stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
                assert record.log_time == record.publish_time == stamp_ns
                # half a nanosecond, and what 53 bits round of a fraction of a second: 1e9 / 2**53 = 1e-7 ns
                assert abs(stamp_ns - (Fraction(time) + offset_s) * 10**9) <= Fraction(1, 2) + Fraction(1, 10**6)


def test_messages_stand_in_the_order_of_time_and_say_first_what_the_trial_is(exported):
    for path in exported.iterdir():
        with path.open("rb") as stream:
            reader = make_reader(stream)
            records = [
                (channel.topic, record.log_time) for _, channel, record in reader.iter_messages(log_time_order=False)
            ]
            summary = reader.get_summary()
            assert reader.get_header().profile == "ros2"
        assert [topic for topic, _ in records[:2]] == [TRIAL, "/tactile/reference"]
        times = [time for _, time in records]
        assert times == sorted(times)
        assert times[0] >= 10**9  # to ROS a stamp of zero is none
        assert summary is not None
        assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
        assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
        assert summary.chunk_indexes


def test_the_same_trial_makes_the_same_file(data, exported, tmp_path):
    (tmp_path / "again").mkdir()
    write_mcap(data, tmp_path / "again", trials=data.trials[:1])
    (file,) = (tmp_path / "again").iterdir()
    assert file.read_bytes() == (exported / file.name).read_bytes()


def test_progress_counts_the_frames_of_all_trials(data, tmp_path):
    seen: list[tuple[int, int]] = []
    folder = tmp_path / "out"
    folder.mkdir()
    write_mcap(data, folder, trials=data.trials[1:], on_progress=lambda *counts: seen.append(counts))
    assert seen == [(count, 2 * FRAMES) for count in range(1, 2 * FRAMES + 1)]
    assert sorted(file.name for file in folder.iterdir()) == ["bare.mcap", "since-1970.mcap"]


def test_where_a_topic_is_named_the_file_is_read_like_any_bag(exported):
    capture = read_rosbag(exported / "full.mcap", image_topic=IMAGE)
    assert capture.labels is None
    assert (capture.sensor, capture.split) == ("", "")
    ours = read_rosbag(exported / "full.mcap")
    np.testing.assert_array_equal(list(capture.read_frames()), list(ours.read_frames()))
    np.testing.assert_array_equal(there(capture.forces).force_n, there(ours.forces).force_n)


def test_a_trial_of_another_program_is_read_as_before(exported, tmp_path):
    edits = [edit_text(lambda _: '{"trial": 7}'), drop(TRIAL)]
    for number, edit in enumerate(edits):

        def without_labels(topic: str, index: int, data: bytes, edit: Edit = edit) -> bytes | None:
            return None if topic in {LABELS, "/tactile/reference"} else edit(topic, index, data)

        capture = read_rosbag(rewrite(exported / "full.mcap", tmp_path / f"other-{number}.mcap", without_labels))
        assert capture.trial == f"other-{number}"
        assert capture.labels is None
        assert len(capture.frame_time_s) == FRAMES


def test_definitions_that_a_file_brings_are_not_used(data, exported, tmp_path):
    path = rewrite(exported / "full.mcap", tmp_path / "full.mcap", lambda *message: message[2], schema=b"uint8 x\n)(")
    assert_same(read_rosbag(path), read_stored(data.folder)[0])


def damages() -> Iterator[Any]:
    facts = {"trial": "full", "sensor": "s", "day": 1, "condition": "dry", "object": ""}
    improper = r"/tactile/trial of .* is not what was written: .*; make it again with `sliplens export`"
    texts = {
        "cut": lambda text: text[:-9],
        "infinite": lambda text: text.replace('"labelling":{', '"labelling":{"x": 1e999, '),
        "not a number": lambda text: text.replace('"labelling":{', '"labelling":{"x": NaN, '),
        "half a character": lambda text: text.replace('"Sensor 1"', '"\\ud800"'),
        "deep": lambda text: text[:-1] + ', "x": ' + "[" * 100_000,
    }
    for name, change in texts.items():
        yield pytest.param(edit_text(change), r"/tactile/trial of .* is not valid JSON \(.*\); export", id=name)
    yield pytest.param(
        edit_text(lambda text: text + " " * 2**24), r"has \d+ characters, no description does; export", id="endless"
    )
    yield pytest.param(edit_text(lambda _: "7"), "does not describe a sliplens trial; export", id="another text")
    yield pytest.param(edit_table(version=3), "is of version 3, this sliplens reads 2; update it", id="version")
    for name, values in {
        "facts": (
            {},
            None,
            *({**facts, "trial": name} for name in ("../../evil", "", "a/b", 7, None)),
            *({**facts, "day": day} for day in ("1", True, None)),
            {**facts, "sensor": 1},
        ),
        "frames": (-1, 0, 1.0, True, None),
        "force_samples": (-1, "2"),
        "force_source": (None, 1),
        "optional": (None, ["labelling"], "valid", [[]]),
        "labelling": ([], 7),
    }.items():
        for value in values:
            yield pytest.param(edit_table(**{name: value}), improper, id=f"{name}={value}")
    for topic in (LABELS, IMAGE, "/tactile/reference", "/tactile/wrench", "/tactile/wrench_times"):
        yield pytest.param(drop(topic), rf"lacks {topic} \(.*/msg/.*\); export the trial again", id=f"no {topic}")
    for topic, said in {
        LABELS: "has 39 labels, /tactile/trial promises 40",
        IMAGE: "has 39 frames, /tactile/trial promises 40",
        "/tactile/wrench": "has 1199 wrenches, /tactile/trial promises 1200",
        "/tactile/wrench_times": "has 200 times of wrenches, /tactile/trial promises 1200",
    }.items():
        yield pytest.param(drop(topic, 0), said, id=f"one less of {topic}")
    yield pytest.param(edit_table(frames=10**18), "has 40 frames, .* promises 1000000000000000000", id="many frames")
    yield pytest.param(
        replace_bytes(LABELS, b"full slip", b"fool slip"),
        r"full of .* has the contact state 'fool slip', none of no contact, contact",
        id="state",
    )
    yield pytest.param(
        replace_bytes(LABELS, np.float64(-2.7).tobytes(), np.float64(np.nan).tobytes()),
        r"full of .* has a time that is not a number; export",
        id="time",
    )
    yield pytest.param(
        replace_bytes(LABELS, np.float64(-2.7).tobytes(), np.float64(9.0).tobytes()),
        "time does not rise at sample 1",
        id="order",
    )
    yield pytest.param(
        replace_bytes(LABELS, np.float64(1.0).tobytes(), np.float64(1.5).tobytes()),
        "safety_margin of frame 3 is 1.5, outside",
        id="margin",
    )
    # the first stamp: 1 s and 300 ms after the zero of stamps
    yield pytest.param(
        replace_bytes(IMAGE, (300_000_000).to_bytes(4, "little"), (300_000_001).to_bytes(4, "little")),
        "label 0 of .* has another stamp than its frame",
        id="stamp",
    )
    yield pytest.param(replace_bytes(IMAGE, b"IHDR", b"IXXX"), "frame 0 of /tactile/image in .* cannot be", id="image")
    yield pytest.param(replace_bytes("/tactile/reference", b"IDAT", b"IXXX"), "/tactile/reference of", id="reference")
    yield pytest.param(lambda topic, _, data: data[:30] if topic == LABELS else data, "not a readable", id="cut labels")


@pytest.mark.parametrize(("edit", "message"), list(damages()))
def test_a_file_that_was_changed_is_refused_with_one_sentence(exported, tmp_path, edit, message):
    path = rewrite(exported / "full.mcap", tmp_path / "changed.mcap", edit)
    with pytest.raises(RecordingError, match=message) as caught:
        list(read_rosbag(path).read_frames())
    assert "\n" not in str(caught.value)


def test_damaged_bytes_are_refused_or_do_not_matter(data, exported, tmp_path, rng):
    whole, expected = (exported / "full.mcap").read_bytes(), read_stored(data.folder)[0]
    path = tmp_path / "damaged.mcap"
    said = []
    for position in rng.integers(0, len(whole), 60).tolist():
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 0x55]) + whole[position + 1 :])
        try:
            capture = read_rosbag(path)
            list(capture.read_frames())
        except RecordingError as error:
            said.append(str(error))
        else:
            assert_same(capture, expected)
    # most bytes lie in chunks, which have checksums
    assert len(said) > 30
    assert not any("\n" in sentence for sentence in said)


def test_a_file_that_is_cut_off_is_refused(exported, tmp_path):
    path = tmp_path / "full.mcap"
    path.write_bytes((exported / path.name).read_bytes()[:-5000])
    refused(read_rosbag, path, r"full\.mcap is not a readable ROS 2 bag")


def test_memory_does_not_grow_with_the_length_of_the_trial(tmp_path, rng):
    count, size = 300, (120, 160)
    image = rng.integers(0, 256, (*size, 3), dtype=np.uint8)
    unknown = np.full(count, np.nan)
    capture = Capture(
        trial="long",
        source="long",
        frame_time_s=np.arange(count) / 30,
        frame_size=size,
        read_frames=lambda: iter([image] * count),
        forces=None,
        labels=Labels(
            **dict.fromkeys(LABEL_SIGNALS, unknown), contact_state=(ContactState.UNKNOWN,) * count, labelling=LABELLING
        ),
        reference=image,
        sensor="s",
        split="train",
    )
    data = store([capture], tmp_path / "data")
    folder = tmp_path / "out"
    folder.mkdir()
    # 17 MB of pixels: 16 frames and their PNG at a time, a chunk of 1 MiB held a few times over
    with held_below(9e6):
        write_mcap(data, folder)
        assert sum(1 for _ in read_rosbag(folder / "long.mcap").read_frames()) == count


def test_a_folder_that_is_missing_or_not_empty_is_refused(data, tmp_path):
    with pytest.raises(InputError, match=r"nothing does not exist; check the path"):
        write_mcap(data, tmp_path / "nothing")
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"is not empty; name a new folder"):
        write_mcap(data, tmp_path)


def test_times_beyond_the_stamps_of_ros_are_refused_and_nothing_is_left(tmp_path, rng):
    data = store([make_capture("late", rng, start_s=3e9, full=False, forces=False)], tmp_path / "data")
    with pytest.raises(RecordingError, match=r"trial late goes from 3e.*; import it with times in seconds"):
        export_mcap(data, tmp_path / "out")
    assert [file.name for file in tmp_path.iterdir()] == ["data"]


@pytest.mark.parametrize("start_s", [-3e9, 1.7e12])  # of milliseconds since 1970, taken for seconds
def test_times_of_no_clock_are_refused(rng, start_s):
    with pytest.raises(RecordingError, match=r"as no clock does; give them in seconds"):
        make_capture("late", rng, start_s=start_s, full=False, forces=False)


def test_a_trial_that_cannot_name_a_file_is_refused(data, tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    text = (data.folder / "dataset.json").read_text()
    (folder / "dataset.json").write_text(text.replace(f'"{data.trials[0].trial}"', '"../full"'))
    with pytest.raises(InputError, match=r"a trial is named with letters, digits, .*, not '\.\./full' at trials"):
        load_dataset(folder)


@pytest.mark.parametrize("module", ["mcap", "rosbags"])
def test_without_the_libraries_the_extra_is_named(data, tmp_path, monkeypatch, module):
    folder = tmp_path / "out"
    folder.mkdir()
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=r'pip install "sliplens\[ros\]"'):
        write_mcap(data, folder)
