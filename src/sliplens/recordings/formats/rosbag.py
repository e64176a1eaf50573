"""ROS 2 bags (MCAP or sqlite3) of a tactile camera and a force-torque sensor."""

import os
from array import array
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache, partial
from importlib import import_module
from importlib.util import find_spec, module_from_spec
from itertools import accumulate
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Int64
from PIL import Image

from sliplens.errors import InputError, RecordingError, SliplensError
from sliplens.extras import require_packages
from sliplens.files import require_file, scratch_folder
from sliplens.images import telling_damage, upright_size
from sliplens.recordings.capture import Capture, Forces, Frame
from sliplens.recordings.formats.images import open_encoded, rgb_pixels
from sliplens.recordings.formats.mcap import IMAGE, TOPICS, WRENCH, extract_attachments, trial_types
from sliplens.recordings.formats.stored import restore_trials
from sliplens.recordings.formats.tables import trial_name
from sliplens.recordings.options import ReadOptions

if TYPE_CHECKING:
    from rosbags.rosbag2 import Reader


RAW, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"

_CHANNELS = {"rgb8": 3, "bgr8": 3, "mono8": 1}


def image_size(message: Any, *, where: str) -> tuple[int, int]:
    """Return height and width of an image, in pixels, without decoding it."""
    if message.__msgtype__ == COMPRESSED:
        with _open_compressed(message, where=where) as image:
            return upright_size(image)
    channels = _CHANNELS.get(message.encoding)
    if channels is None:
        raise RecordingError(f"{where} has encoding {message.encoding[:40]!r}; record it as rgb8, bgr8, mono8 or PNG")
    if min(message.height, message.width) == 0 or message.step < message.width * channels:
        raise RecordingError(f"{where} claims rows of {message.step} bytes, no {message.encoding}; record it again")
    # Python's integers do not overflow, and nothing has the claimed size until it is known to be there
    if message.height * message.step > len(message.data):
        raise RecordingError(f"{where} claims {message.height} rows of {message.step} bytes but holds fewer; mend it")
    return message.height, message.width


def image_pixels(message: Any, *, where: str) -> Frame:
    """Decode an image as RGB; grey is repeated in all three channels."""
    if message.__msgtype__ == COMPRESSED:
        damage = telling_damage(f"{where} is damaged", "cut the bag before it", kind=RecordingError)
        with _open_compressed(message, where=where) as image, damage:
            return rgb_pixels(image)
    height, width = image_size(message, where=where)
    channels = _CHANNELS[message.encoding]
    # rows may be padded: step counts the padding too
    rows = message.data[: height * message.step].reshape(height, message.step)[:, : width * channels]
    pixels = rows.reshape(height, width, channels)
    if message.encoding == "mono8":
        return np.repeat(pixels, 3, axis=2)
    return np.array(pixels[..., ::-1] if message.encoding == "bgr8" else pixels, order="C")


@contextmanager
def _open_compressed(message: Any, *, where: str) -> Iterator[Image.Image]:
    """Open an image and read its header; one that would expand too far (a decompression bomb) is refused."""
    text = f"{where}, of format {message.format[:40]!r}, cannot be read as JPEG or PNG"
    damage = telling_damage(text, "record it again, or as one of these", kind=RecordingError)
    with damage, open_encoded(message.data, where=where) as image:
        yield image


MOST_BYTES = 256 * 2**20
"""In memory at a time: of a chunk, of all chunks that cover one moment, or of a message. Chunks are of some 1 MB."""
MOST_TIMES = 100  #: A file that is compressed as a whole expands on disk, so far that its size may be multiplied.


class ExpandsTooFarError(Exception):
    """Data that expand to more than they may; the message continues a sentence that begins with the bag."""


@cache
def bounded_reader() -> "type[Reader]":
    """Return `rosbags.rosbag2.Reader`, changed to raise `ExpandsTooFarError` before memory or disk are filled."""
    mcap, reader = _load_copy("rosbags.rosbag2.storage_mcap"), _load_copy("rosbags.rosbag2.reader")
    sqlite = import_module("rosbags.rosbag2.storage_sqlite3")
    zstd, lz4 = mcap.zstd, import_module("lz4.frame")

    class Mcap(mcap.McapReader):
        def _open(self) -> None:
            super()._open()
            _require_room(self.chunks)

    class Sqlite(sqlite.Sqlite3Reader):
        def _open(self) -> None:
            # a tiny database may compute a message of any size
            self.dbconn.limit(sqlite.apsw.SQLITE_LIMIT_LENGTH, MOST_BYTES)
            super()._open()

    # each gets the bytes and the size that is claimed for them, which rosbags compares with what comes out
    mcap.DECOMPRESSORS = {
        "": lambda data, _: data,
        "lz4": lambda data, size: _expand_chunk(data, lz4.LZ4FrameDecompressor, size, frames=1),
        "zstd": lambda data, size: _expand_chunk(data, zstd.ZstdDecompressor, size),
    }
    reader.zstd = SimpleNamespace(
        decompress=lambda data: _expand(
            data, zstd.ZstdDecompressor, most=MOST_BYTES, refusal=_beyond("a message", MOST_BYTES)
        ),
        open=lambda file, mode: _BoundedFile(
            zstd.open(file, mode), most=max(MOST_BYTES, MOST_TIMES * os.fstat(file.fileno()).st_size)
        ),
    )
    reader.DirectoryReader.STORAGE_PLUGINS = {"mcap": Mcap, "sqlite3": Sqlite}
    reader.Reader.STORAGE_PLUGINS = {"dir": reader.DirectoryReader, ".mcap": Mcap, ".db3": Sqlite}
    return reader.Reader


def _load_copy(name: str) -> Any:
    """Load a module a second time, so that its changes stay here."""
    spec = find_spec(name)
    if spec is None or spec.loader is None:
        raise ImportError(f"{name} is not there")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _expand_chunk(data: bytes, decompressor: Any, size: int, *, frames: int | None = None) -> bytes:
    if size > MOST_BYTES:
        raise _beyond("a chunk", MOST_BYTES)
    refusal = ExpandsTooFarError(f"a chunk expands to more than the {size:,} bytes that it claims")
    return _expand(data, decompressor, most=size, refusal=refusal, frames=frames)


def _require_room(chunks: Iterable[Any]) -> None:
    """Refuse chunks that cover one moment and are too large together: rosbags expands all of these at once."""
    # at the same moment what begins counts before what ends
    begins = [(chunk.message_start_time, 0, chunk.uncompressed_size) for chunk in chunks]
    ends = [(max(chunk.message_start_time, chunk.message_end_time), 1, -chunk.uncompressed_size) for chunk in chunks]
    for total in accumulate(size for _, _, size in sorted(begins + ends)):
        if total > MOST_BYTES:
            raise _beyond("a chunk, or chunks of the same moment together,", MOST_BYTES)


def _expand(
    data: bytes, decompressor: Any, *, most: int, refusal: ExpandsTooFarError, frames: int | None = None
) -> bytes:
    """Expand compressed frames that follow each other, at most `frames` of them, to `most` bytes or fewer."""
    parts, room, done = [], most + 1, 0
    while data and done != frames:
        frame, rest = decompressor(), data
        while not frame.eof and (rest or not frame.needs_input):
            parts.append(frame.decompress(rest, max_length=room))
            room -= len(parts[-1])
            rest = b""
            if room <= 0:
                raise refusal
        if not frame.eof:
            raise EOFError("compressed bytes end early")
        data, done = frame.unused_data or b"", done + 1
    return b"".join(parts)


class _BoundedFile:
    """File that is expanded while it is read."""

    def __init__(self, file: Any, *, most: int) -> None:
        self._file, self._room, self._most = file, most, most

    def __enter__(self) -> "_BoundedFile":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def read(self, size: int = -1) -> bytes:
        part = self._file.read(min(size, self._room + 1) if size >= 0 else self._room + 1)
        self._room -= len(part)
        if self._room < 0:
            raise _beyond("a file", self._most)
        return part


def _beyond(what: str, most: int) -> ExpandsTooFarError:
    return ExpandsTooFarError(f"{what} expands to more than {most / 2**20:,.0f} MiB")


_STORAGE = (".mcap", ".db3")


def bag_topics(path: Path) -> dict[str, str]:
    """List the topics of a bag with the types of their messages."""
    with open_bag(path) as bag:
        return {connection.topic: connection.msgtype for connection in bag.connections}


def bag_messages(path: Path, topics: Mapping[str, str]) -> Iterator[tuple[str, int, Any]]:
    """Iterate over topic, time of arrival in nanoseconds and content of messages, in the order of recording."""
    with open_bag(path) as bag:
        types = trial_types()
        chosen = [each for each in bag.connections if topics.get(each.topic) == each.msgtype]
        if not chosen:  # to rosbags none means all
            return
        for connection, time_ns, data in bag.messages(chosen):
            yield connection.topic, time_ns, types.deserialize_cdr(memoryview(data), connection.msgtype)


@contextmanager
def open_bag(path: Path) -> Iterator["Reader"]:
    """Open a bag; whatever its readers raise inside becomes a `RecordingError`."""
    require_packages("mcap", "rosbags", extra="ros", purpose="a ROS 2 bag")
    _require_bag(path)
    for file in [file for file in path.iterdir() if file.suffix in _STORAGE] if path.is_dir() else [path]:
        require_file(file)
        if file.suffix == ".db3":
            _require_whole_pages(file)
    try:
        with bounded_reader()(path) as bag:
            yield bag
    except SliplensError:
        raise
    except ExpandsTooFarError as error:
        raise RecordingError(f"{path}: {error}, as damaged and hostile files do; expand it beforehand") from None
    # a damaged byte may lead rosbags, sqlite or YAML into any error there is, from KeyError to MemoryError
    except Exception as error:
        text = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise RecordingError(f"{path} is not a readable ROS 2 bag ({text}); try `mcap recover`") from None


def _require_bag(path: Path) -> None:
    if not path.exists():
        raise RecordingError(f"{path} does not exist; check the path")
    if path.is_dir():
        if (path / "metadata.yaml").is_file():
            return
        inside = sorted(file.name for file in path.iterdir() if file.suffix in _STORAGE)
        cure = f"name {inside[0]} itself" if len(inside) == 1 else "name the folder of one bag"
        raise RecordingError(f"{path} has no metadata.yaml; write it with `ros2 bag reindex`, or {cure}")
    if path.suffix == ".bag":
        raise RecordingError(f"{path} is a ROS 1 bag; convert it with `rosbags-convert --src BAG --dst FOLDER`")
    if path.suffix not in _STORAGE:
        raise RecordingError(f"{path} is no ROS 2 bag; name its folder, or its {' or '.join(_STORAGE)} file")


def _require_whole_pages(file: Path) -> None:
    """Refuse a database that is cut off within a page, for sqlite would read zeros there."""
    with file.open("rb") as stream:
        head = stream.read(18)
    # https://www.sqlite.org/fileformat.html: 16 bytes of magic, then the page size, where 1 stands for 65536
    page = int.from_bytes(head[16:18], "big")
    if head.startswith(b"SQLite format 3\0") and file.stat().st_size % (65536 if page == 1 else page or 1):
        raise RecordingError(f"{file} is cut off; copy it again")


class _Topic:
    """Stamps and forces of the messages of a topic; stamps of an hour at 1 kHz are 58 MB."""

    def __init__(self) -> None:
        self.stamps_ns = {"header": array("q"), "bag": array("q")}
        self.force_n = array("d")

    def times(self, clock: str) -> Int64[np.ndarray, " messages"]:
        return np.array(self.stamps_ns[clock], dtype=np.int64)


def _scan(path: Path, topics: Mapping[str, str], *, images: str) -> tuple[dict[str, _Topic], tuple[int, int]]:
    """Read stamps, forces and the size of the frames, but no pixel of one."""
    scanned, size = defaultdict(_Topic), None
    for name, bag_ns, message in bag_messages(path, topics):
        topic = scanned[name]
        if name == images:
            where = f"frame {len(topic.stamps_ns['bag'])} of {images} in {path}"
            before, size = size, image_size(message, where=where)
            if before not in {None, size}:
                raise RecordingError(f"{where} is of another size than those before it; cut the bag there")
        else:
            force = message.wrench.force
            topic.force_n.extend((force.x, force.y, force.z))
        stamp = message.header.stamp
        topic.stamps_ns["header"].append(stamp.sec * 1_000_000_000 + stamp.nanosec)
        topic.stamps_ns["bag"].append(bag_ns)
    if size is None:
        raise RecordingError(f"{images} of {path} has no frame; leave it out or record it again")
    return scanned, size


def _read_frames(path: Path, images: str, kind: str) -> Iterator[Frame]:
    for index, (_, _, message) in enumerate(bag_messages(path, {images: kind})):
        yield image_pixels(message, where=f"frame {index} of {images} in {path}")


_IMAGES, _WRENCHES = (RAW, COMPRESSED), (TOPICS[WRENCH],)


def read_rosbag(path: Path, options: ReadOptions) -> Capture:
    """Read a bag as one trial; one that `export_mcap` wrote is restored, unless a topic is named.

    A first pass reads stamps and sizes; pixels are decoded when frames are read. Frames
    and forces share one clock, that of the message headers; where a header has no stamp, or the two topics have clocks
    that never meet, both take the times at which the bag received them, and `notes` say so.
    Times are seconds since the first frame or force: since the epoch, double precision would round them to 0.2 us.
    """
    topics, wrench_topic = bag_topics(path), options.wrench_topic
    if options.image_topic is None and wrench_topic is None and topics.get(IMAGE) == TOPICS[IMAGE]:
        with scratch_folder() as copy:
            if (capture := _restore_trial(path, copy)) is not None:
                return capture
    images = _choose(topics, options.image_topic, types=_IMAGES, what="images", path=path)
    wrenches = _choose(topics, wrench_topic, types=_WRENCHES, what="wrenches", path=path)
    if images is None:
        raise RecordingError(f"{path} has no topic with images; record the camera too (it has {_list_topics(topics)})")
    chosen = [name for name in (images, wrenches) if name is not None]
    scanned, size = _scan(path, {name: topics[name] for name in chosen}, images=images)
    notes = []
    if wrenches is None:
        notes.append(f"There are no forces: the bag has no topic of {_WRENCHES[0]}.")
    elif wrench_topic is None and wrenches not in scanned:
        notes.append(f"There are no forces: {wrenches} has no message.")
        wrenches = None
    clock, why = _choose_clock({name: scanned[name] for name in chosen if name in scanned})
    times = {name: topic.times(clock) for name, topic in scanned.items()}
    zero = min(series[0] for series in times.values())
    forces = None
    if wrenches is not None:
        time_s = (times.get(wrenches, np.zeros(0)) - zero) / 1e9
        force_n = np.array(scanned[wrenches].force_n, dtype=np.float64).reshape(-1, 3)
        forces = Forces(time_s=time_s, force_n=force_n, source=f"{wrenches} of {path}")
    return Capture(
        trial=trial_name(path.stem if path.is_file() else path.resolve().name),
        source=f"{images} of {path}",
        frame_time_s=(times[images] - zero) / 1e9,
        frame_size=size,
        read_frames=partial(_read_frames, path, images, topics[images]),
        forces=forces,
        notes=(*notes, *why),
    )


def _restore_trial(path: Path, copy: Path) -> Capture | None:
    """Read a bag that `write_mcap` wrote, bit by bit as its data set was; None where it is another one."""
    if path.is_dir() or path.suffix != ".mcap":
        return None
    try:
        with open_bag(path):
            if not extract_attachments(path, copy):
                return None
        scanned, size = _scan(path, {IMAGE: TOPICS[IMAGE]}, images=IMAGE)
        read_frames = partial(_read_frames, path, IMAGE, TOPICS[IMAGE])
        (capture,) = restore_trials(copy, [(str(path), len(scanned[IMAGE].stamps_ns["bag"]), size, read_frames)])
    except InputError as error:
        raise RecordingError(str(error).replace(str(copy), str(path))) from None
    return capture


def _choose(topics: dict[str, str], name: str | None, *, types: tuple[str, ...], what: str, path: Path) -> str | None:
    """Return the topic `name`, or the only one of some types."""
    fitting = {topic: kind for topic, kind in topics.items() if kind in types}
    if name is not None:
        if name not in topics:
            raise RecordingError(f"{path} has no topic {name}; it has {_list_topics(topics)}")
        if name not in fitting:
            raise RecordingError(f"{name} of {path} holds {topics[name]}, no {what}; name one of {' or '.join(types)}")
        return name
    if len(fitting) > 1:
        raise RecordingError(f"{path} has {len(fitting)} topics with {what}, {_list_topics(fitting)}; name one of them")
    return next(iter(fitting), None)


def _choose_clock(topics: dict[str, _Topic]) -> tuple[str, list[str]]:
    """Choose the clock that all topics have, "header" or "bag", with a note where it is not the header's."""
    instead = "times are those at which the bag received the messages."
    for name, topic in topics.items():
        stamps = topic.stamps_ns["header"]
        if missing := stamps.count(0):
            return "bag", [f"{missing} of {len(stamps)} messages of {name} have no header stamp: {instead}"]

    def meet(clock: str) -> bool:
        frames, wrenches = (topic.stamps_ns[clock] for topic in topics.values())
        return frames[0] <= wrenches[-1] and wrenches[0] <= frames[-1]

    if len(topics) == 2 and not meet("header") and meet("bag"):
        return "bag", [f"The header stamps of {' and '.join(topics)} are of different clocks: {instead}"]
    return "header", []


def _list_topics(topics: dict[str, str]) -> str:
    return ", ".join(f"{topic} ({kind})" for topic, kind in sorted(topics.items())) or "no topic"
