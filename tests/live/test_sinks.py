"""What a sink sent is read back with the own library of those who listen."""

import base64
import io
import json
from dataclasses import replace
from pathlib import Path
from threading import Event

import msgspec
import numpy as np
import pytest
from PIL import Image
from rrd import read_rrd, shown
from scripted import plain_reader, source_of
from zenoh_router import open_router

from sliplens.errors import InputError
from sliplens.live.reading import Reading
from sliplens.live.sinks import (
    IMAGE_TOPIC,
    READING_TOPIC,
    ROS_TOPICS,
    SINKS,
    Sender,
    Sink,
    reading_schema,
)

READING = Reading(number=7, time_s=0.5, captured_s=100.25, margin=0.4, low=0.3, high=0.55)
IMAGE = np.full((8, 12, 3), (200, 100, 50), dtype=np.uint8)


def same(image: np.ndarray) -> bool:
    """Whether it is the frame, but for what JPEG loses of a plain colour."""
    return image.shape == IMAGE.shape and bool(np.abs(image.astype(int) - IMAGE).max() <= 3)


def test_an_mcap_file_is_read_by_mcap(tmp_path: Path):
    reader = pytest.importorskip("mcap.reader", reason="mcap is not installed")
    sink = SINKS["mcap"](str(tmp_path / "grip.mcap"))
    sink.send(READING, IMAGE)
    sink.send(replace(READING, number=8, margin=None, withheld="the camera moved"), None)
    sink.close()
    with (tmp_path / "grip.mcap").open("rb") as file:
        found = [(schema, channel, message) for schema, channel, message in reader.make_reader(file).iter_messages()]
    readings, [picture] = (
        [json.loads(message.data) for _, channel, message in found if channel.topic == topic]
        for topic in (READING_TOPIC, IMAGE_TOPIC)
    )
    assert [(reading["number"], reading["margin"]) for reading in readings] == [(7, 0.4), (8, None)]
    schema, *_ = found[0]
    assert schema.encoding == "jsonschema"
    assert json.loads(schema.data)["properties"].keys() == json.loads(reading_schema())["properties"].keys()
    assert (picture["format"], picture["frame_id"]) == ("jpeg", "fingertip")
    assert same(np.asarray(Image.open(io.BytesIO(base64.b64decode(picture["data"])))))


def test_a_rerun_file_is_read_by_rerun(tmp_path: Path):
    pytest.importorskip("rerun", reason="Rerun is not installed")
    sink = SINKS["rerun"](str(path := tmp_path / "grip.rrd"))
    sink.send(READING, IMAGE)
    sink.send(replace(READING, number=8, time_s=0.6, margin=None), None)
    sink.close()
    entities = read_rrd(path)
    assert shown(entities, "margin", "Scalars:scalars") == ([7], [[0.4]])
    assert shown(entities, "interval/low", "Scalars:scalars")[1][0] == [0.3]
    [[blob]] = shown(entities, "frame", "EncodedImage:blob")[1]
    assert same(np.asarray(Image.open(io.BytesIO(bytes(blob)))))


def test_what_zenoh_carries_is_read_as_messages_of_ros(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    samples: dict[str, list] = {}
    all_sent = Event()

    def hear(sample) -> None:
        samples.setdefault(str(sample.key_expr), []).append(sample)
        if sum(map(len, samples.values())) == 8:
            all_sent.set()

    with open_router() as (session, address), session.declare_subscriber("**", hear):
        sink = SINKS["zenoh"](f"tip/left@{address}")
        sink.send(READING, IMAGE)
        sink.send(replace(READING, number=8, margin=None, withheld="the camera moved"), None)
        assert all_sent.wait(10)
        sink.close()
    typesys = pytest.importorskip("rosbags.typesys")
    types = typesys.get_typestore(typesys.Stores.LATEST)
    own = {key: heard for key, heard in samples.items() if key.startswith("tip/left/")}
    assert {key: len(heard) for key, heard in own.items()} == {
        "tip/left/margin": 1, "tip/left/reading": 2, "tip/left/image/compressed": 1,
    }  # fmt: skip
    for topic, kind in ROS_TOPICS.items():
        by_name = own[f"tip/left/{topic}"]
        # the name that rmw_zenoh listens to, with the attachment without which it drops a message
        by_type = samples[f"7/tip/left/{topic}/{kind.replace('/', '::').replace('msg::', 'msg::dds_::')}_/"
                          f"{types.hash_rihs01(kind)}"]  # fmt: skip
        assert [bytes(sample.payload) for sample in by_type] == [bytes(sample.payload) for sample in by_name]
        attached = [bytes(sample.attachment) for sample in by_type]
        assert {len(words) for words in attached} == {8 + 8 + 1 + 16}
        assert [int.from_bytes(words[:8], "little") for words in attached] == list(range(1, 1 + len(attached)))
    parse = types.deserialize_cdr
    margin = parse(bytes(own["tip/left/margin"][0].payload), "std_msgs/msg/Float32")
    assert margin.data == pytest.approx(READING.margin)
    texts = [parse(bytes(sample.payload), "std_msgs/msg/String").data for sample in own["tip/left/reading"]]
    assert msgspec.json.decode(texts[0], type=Reading) == READING
    assert msgspec.json.decode(texts[1])["withheld"] == "the camera moved"
    picture = parse(bytes(own["tip/left/image/compressed"][0].payload), "sensor_msgs/msg/CompressedImage")
    assert (picture.format, picture.header.frame_id) == ("jpeg", "fingertip")
    assert same(np.asarray(Image.open(io.BytesIO(picture.data.tobytes()))))


class Slow:
    """A sink that takes its time."""

    def __init__(self) -> None:
        self.go, self.began, self.taken, self.closed = Event(), Event(), [], False

    def send(self, reading: Reading, _: np.ndarray | None, /) -> None:
        self.began.set()
        assert self.go.wait(10)
        if reading.number == 99:
            raise OSError(28, "No space left on device")
        self.taken.append(reading.number)

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def slow(monkeypatch: pytest.MonkeyPatch) -> Slow:
    sink = Slow()
    monkeypatch.setitem(SINKS._rows, "slow", lambda _: Sink(sink.send, sink.close))
    monkeypatch.setattr("sliplens.live.sinks._MOST_WAITING_BYTES", 3 * 4096)
    return sink


def test_a_slow_sink_loses_the_oldest_and_nobody_waits_for_it(slow: Slow):
    sender = Sender("slow")
    sender.add(replace(READING, number=0), None)
    assert slow.began.wait(10)
    for number in range(1, 8):
        sender.add(replace(READING, number=number), None)
    slow.go.set()
    assert sender.finish(5.0)
    assert slow.taken == [0, 5, 6, 7]
    assert slow.closed
    assert (sender.sent, sender.lost, sender.trouble) == (4, 4, None)


def test_a_sink_that_hangs_is_left_after_a_while(slow: Slow):
    sender = Sender("slow")
    for number in range(2):
        sender.add(replace(READING, number=number), None)
    assert slow.began.wait(10)
    assert not sender.finish(0.05)  # the first is still being sent
    sender.shut(discard=True)
    assert (sender.sent, sender.lost) == (0, 1)
    slow.go.set()


def test_a_sink_that_breaks_off_says_so_and_the_reading_goes_on(slow: Slow):
    frames = np.full((6, 8, 8, 3), 128, dtype=np.uint8)
    slow.go.set()
    reader = plain_reader(source_of(frames, patient=False), reference=frames[0])
    reader.send_to("slow")
    [sender] = reader.outputs
    sender.put((replace(READING, number=99), None))
    assert slow.began.wait(10)  # before any other reading, which might push it out unsent
    with reader:
        numbers = [reading.number for reading in reader.readings()]
    assert numbers[-1] == 5
    assert slow.closed
    assert reader.troubles == (sender.trouble,)
    assert "slow stopped after" in str(sender)
    assert "No space left on device" in str(sender)
    assert sender.lost >= 1


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("mcap", "writes a file that ends in .mcap; give mcap:grip.mcap"),
        ("mcap:nowhere/grip.mcap", "nowhere/grip.mcap cannot be written (No such file or directory)"),
        ("rerun:grip.txt", "ends in .rrd"),
        ("zenoh", "names no key that ROS can have; give letters and digits, as zenoh:tip"),
        ("zenoh:a b@tcp/127.0.0.1:1", "names no key"),
        ("zenoh:tip@tcp/127.0.0.1:1", "reaches nothing at tcp/127.0.0.1:1"),
        ("paper", "there is no sink named 'paper'"),
    ],
)
def test_mistakes_are_told_in_a_sentence(name: str, told: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("sliplens.live.sinks._ZENOH_PATIENCE_MS", 100)
    with pytest.raises(InputError) as error:
        Sender(name)
    assert told in str(error.value)
