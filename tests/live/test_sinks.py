"""What a sink sent is read back with the own library of those who listen."""

import io
import json
import socket
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from PIL import Image

from sliplens.errors import InputError
from sliplens.live.reading import Reading
from sliplens.live.sinks import IMAGE_TOPIC, READING_TOPIC, FoxgloveTopics, open_sink, reading_schema

READING = Reading(number=7, time_s=0.5, captured_s=100.25, margin=0.4, low=0.3, high=0.55)
IMAGE = np.full((8, 12, 3), (200, 100, 50), dtype=np.uint8)


def same(image: np.ndarray) -> bool:
    """Whether it is the frame, but for what JPEG loses of a plain colour."""
    return image.shape == IMAGE.shape and bool(np.abs(image.astype(int) - IMAGE).max() <= 3)


def test_a_datagram_is_a_reading():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(10)
        sink = open_sink(f"udp:127.0.0.1:{listener.getsockname()[1]}")
        sink.send(READING, IMAGE)
        sink.close()
        assert msgspec.json.decode(listener.recv(65536), type=Reading) == READING


def test_datagrams_for_nobody_disturb_nobody():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    sink = open_sink(f"udp::{port}")
    for _ in range(3):
        sink.send(READING, None)
    sink.close()


def test_an_mcap_file_is_read_by_mcap(tmp_path: Path):
    pytest.importorskip("foxglove", reason="Foxglove's SDK is not installed")
    reader = pytest.importorskip("mcap.reader", reason="mcap is not installed")
    sink = open_sink(f"mcap:{tmp_path / 'grip.mcap'}")
    sink.send(READING, IMAGE)
    sink.send(replace(READING, number=8, margin=None, withheld="the camera moved"), None)
    sink.close()
    with (tmp_path / "grip.mcap").open("rb") as file:
        found = [(schema, channel, message) for schema, channel, message in reader.make_reader(file).iter_messages()]
    readings = [
        (json.loads(message.data), schema) for schema, channel, message in found if channel.topic == READING_TOPIC
    ]
    assert [told["number"] for told, _ in readings] == [7, 8]
    assert readings[1][0]["margin"] is None
    assert readings[0][1].encoding == "jsonschema"
    assert json.loads(readings[0][1].data)["properties"].keys() == reading_schema()["properties"].keys()
    [image] = [message for _, channel, message in found if channel.topic == IMAGE_TOPIC]
    start = image.data.index(b"\xff\xd8\xff")
    assert same(np.asarray(Image.open(io.BytesIO(image.data[start:]))))


def test_a_foxglove_viewer_is_told_the_reading():
    pytest.importorskip("foxglove", reason="Foxglove's SDK is not installed")
    client = pytest.importorskip("websockets.sync.client", reason="websockets is not installed")
    sink = FoxgloveTopics(port=0)
    try:
        with client.connect(f"ws://127.0.0.1:{sink.port}", subprotocols=["foxglove.sdk.v1"]) as viewer:
            channels = {}
            while READING_TOPIC not in channels:
                told = viewer.recv(timeout=10)
                if isinstance(told, str):
                    channels |= {one["topic"]: one["id"] for one in json.loads(told).get("channels", [])}
            subscription = {"id": 1, "channelId": channels[READING_TOPIC]}
            viewer.send(json.dumps({"op": "subscribe", "subscriptions": [subscription]}))
            message: str | bytes = b""
            for _ in range(100):  # until the server has taken the subscription
                sink.send(READING, None)
                try:
                    message = viewer.recv(timeout=0.1)
                except TimeoutError:
                    continue
                if isinstance(message, bytes) and message[0] == 1:
                    break
            # operation, subscription (4 bytes), time in nanoseconds (8 bytes), payload
            assert isinstance(message, bytes)
            assert msgspec.json.decode(message[13:], type=Reading) == READING
    finally:
        sink.close()


def test_a_rerun_file_is_read_by_rerun(tmp_path: Path):
    pytest.importorskip("rerun", reason="Rerun is not installed")
    path = tmp_path / "grip.rrd"
    sink = open_sink(f"rerun:{path}")
    sink.send(READING, IMAGE)
    sink.send(replace(READING, number=8, time_s=0.6, margin=None), None)
    sink.close()
    assert path.read_bytes()[:3] == b"RRF"
    found: dict[str, list] = {}
    for chunk in pytest.importorskip("rerun.chunk").RrdReader(path).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            found.setdefault(f"{chunk.entity_path} {name}", []).extend(batch.column(name).to_pylist())
    assert [value for value in found["/margin Scalars:scalars"] if value] == [[0.4]]
    assert found["/interval/low Scalars:scalars"][0] == [0.3]
    [blob] = found["/frame EncodedImage:blob"][0]
    assert same(np.asarray(Image.open(io.BytesIO(bytes(blob)))))


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("udp", "names no port; give udp:HOST:PORT"),
        ("udp:robot", "names no port"),
        ("foxglove:here:http", "names no port; give foxglove:HOST:PORT"),
        ("mcap", "writes a file that ends in .mcap; give mcap:grip.mcap"),
        ("mcap:nowhere/grip.mcap", "the folder nowhere does not exist"),
        ("rerun:grip.txt", "ends in .rrd"),
        ("paper", "there is no sink named 'paper'"),
    ],
)
def test_mistakes_are_told_in_a_sentence(name: str, told: str):
    with pytest.raises(InputError) as error:
        open_sink(name)
    assert told in str(error.value)
