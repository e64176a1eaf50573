"""Bags that expand further than they should are refused before memory is full; honest ones come back as they were."""

import sqlite3
import struct
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from memory import held_below

from sliplens.errors import RecordingError

pytest.importorskip("rosbags")

import lz4.frame
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from sliplens.recordings.formats import rosbag as ros_expansion
from sliplens.recordings.formats.rosbag import bag_messages, bounded_reader

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

TYPES = get_typestore(Stores.LATEST)
KIND, TOPIC = "std_msgs/msg/String", "/words"
LIMIT = 4 * 2**20
"""Instead of the true limit, so that bombs are small."""
Compress = Callable[[bytes], bytes]


def words(size: int) -> bytes:
    """A message with so many letters, which expands from next to nothing."""
    return bytes(TYPES.serialize_cdr(TYPES.types[KIND](data="a" * size), KIND))


def write_bag(folder: Path, messages: list[tuple[int, bytes]], *, storage: str, compression: str) -> Path:
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin[storage])
    writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection(TOPIC, KIND, typestore=TYPES)
        for time_ns, data in messages:
            writer.write(connection, time_ns, data)
    return folder


def write_mcap(path: Path, message: bytes, *, compress: Compress, compression: str, claim: int | None = None) -> Path:
    """Write a file of one chunk, without a summary, by the specification (https://mcap.dev/spec)."""

    def record(op: int, *parts: bytes) -> bytes:
        body = b"".join(parts)
        return struct.pack("<BQ", op, len(body)) + body

    def text(value: str) -> bytes:
        return struct.pack("<I", len(value)) + value.encode()

    inside = (
        record(3, struct.pack("<H", 1), text(KIND), text("ros2msg"), text("string data"))
        + record(4, struct.pack("<HH", 1, 1), text(TOPIC), text("cdr"), struct.pack("<I", 0))
        + record(5, struct.pack("<HIQQ", 1, 0, 7, 7), message)
    )
    expanded, packed = len(inside) if claim is None else claim, compress(inside)
    chunk = record(
        6, struct.pack("<QQQI", 7, 7, expanded, 0), text(compression), struct.pack("<Q", len(packed)), packed
    )
    magic = b"\x89MCAP0\r\n"
    end = record(15, struct.pack("<I", 0)) + record(2, struct.pack("<QQI", 0, 0, 0))
    path.write_bytes(magic + record(1, text("ros2"), text("by hand")) + chunk + end + magic)
    return path


def without_sizes(data: bytes) -> bytes:
    """Compress so that no frame says how far it expands, in two frames."""
    half = len(data) // 2
    parts = []
    for piece in (data[:half], data[half:]):
        packer = zstd.ZstdCompressor()
        parts.append(packer.compress(piece) + packer.flush())
    return b"".join(parts)


PACKERS: dict[str, tuple[str, Compress]] = {
    "zstd": ("zstd", zstd.compress),
    "zstd without sizes": ("zstd", without_sizes),
    "lz4": ("lz4", lz4.frame.compress),
    "lz4 without a size": ("lz4", lambda data: lz4.frame.compress(data, store_size=False)),
}


def refuse(path: Path, most_bytes: float, match: str = r"expands to more than 4,194,304 bytes in one piece") -> None:
    """Check that a bag is refused before it takes memory."""
    with held_below(most_bytes), pytest.raises(RecordingError, match=match):
        list(bag_messages(path, {TOPIC: KIND}))


@pytest.fixture
def small_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros_expansion, "MOST_BYTES", LIMIT)


@pytest.mark.parametrize("packer", PACKERS)
def test_a_chunk_comes_back_whatever_it_is_packed_with(tmp_path, small_limit, packer):
    compression, compress = PACKERS[packer]
    path = write_mcap(tmp_path / "a.mcap", words(LIMIT // 2), compress=compress, compression=compression)
    ((topic, time_ns, message),) = bag_messages(path, {TOPIC: KIND})
    assert (topic, time_ns, message.data) == (TOPIC, 7, "a" * (LIMIT // 2))


@pytest.mark.parametrize("packer", PACKERS)
def test_a_chunk_is_expanded_no_further_than_it_says_or_may(tmp_path, small_limit, packer):
    compression, compress = PACKERS[packer]
    path = tmp_path / "a.mcap"
    write_mcap(path, words(16 * LIMIT), compress=compress, compression=compression)
    # what is compressed, a few times over, and no more
    refuse(path, 2**20 + 8 * path.stat().st_size)
    write_mcap(path, words(16 * LIMIT), compress=compress, compression=compression, claim=LIMIT - 1)
    # a lie that is believed would take 16 times as many
    refuse(path, 4 * LIMIT, "expands to more than 4,194,303 bytes")


def test_an_index_that_lies_is_believed_no_more_than_a_chunk(tmp_path, small_limit):
    bag = write_bag(tmp_path / "bag", [(7, words(16 * LIMIT))], storage="MCAP", compression="STORAGE")
    refuse(bag, LIMIT)
    (file,) = bag.glob("*.mcap")
    with Reader(file) as opened:
        (chunk,) = opened.storage.chunks  # pyright: ignore[reportAttributeAccessIssue]
        said, lie = struct.pack("<Q", chunk.uncompressed_size), struct.pack("<Q", 1000)
    whole = file.read_bytes()
    assert whole.count(said) == 2  # in the chunk and in the index
    file.write_bytes(whole.replace(said, lie))
    refuse(bag, LIMIT, "expands to more than 1,000 bytes")


def test_chunks_of_one_moment_count_together(tmp_path, small_limit):
    size = 3 * 2**18  # two to a chunk, for rosbags ends one beyond 1 MiB
    apart = [(time_ns, words(size)) for time_ns in range(16)]
    bag = write_bag(tmp_path / "apart", apart, storage="MCAP", compression="STORAGE")
    assert len(list(bag_messages(bag, {TOPIC: KIND}))) == 16
    together = [(time_ns % 2, data) for time_ns, data in apart]
    refuse(write_bag(tmp_path / "together", together, storage="MCAP", compression="STORAGE"), LIMIT)


@pytest.mark.parametrize(("compression", "most"), [("MESSAGE", 4 * LIMIT), ("FILE", LIMIT)])
def test_a_compressed_message_or_file_is_expanded_no_further_than_the_limit(
    tmp_path, small_limit, monkeypatch, compression, most
):
    bag = write_bag(tmp_path / "bag", [(7, words(16 * LIMIT))], storage="SQLITE3", compression=compression)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "expanded"))
    (tmp_path / "expanded").mkdir()
    refuse(bag, most, r"expands to more than [4-8],\d{3},\d{3} bytes")
    assert not list((tmp_path / "expanded").iterdir())


def test_a_database_that_makes_its_messages_up_is_refused(tmp_path, small_limit):
    bag = write_bag(tmp_path / "bag", [(7, words(8))], storage="SQLITE3", compression="NONE")
    (file,) = bag.glob("*.db3")
    with closing(sqlite3.connect(file)) as database, database:
        database.executescript(
            f"""
            ALTER TABLE messages RENAME TO old;
            CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,
                data BLOB GENERATED ALWAYS AS (zeroblob({16 * LIMIT})) VIRTUAL);
            INSERT INTO messages(topic_id, timestamp) SELECT topic_id, timestamp FROM old;
            """
        )
    refuse(bag, LIMIT, r"bag is not a readable ROS 2 bag \(TooBigError")


def test_rosbags_itself_is_left_as_it_was(tmp_path, small_limit):
    bag = write_bag(tmp_path / "bag", [(7, words(2 * LIMIT))], storage="SQLITE3", compression="MESSAGE")
    assert bounded_reader() is not Reader
    with Reader(bag) as opened:
        ((_, _, data),) = opened.messages()
    assert data == words(2 * LIMIT)
