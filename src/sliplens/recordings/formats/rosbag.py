"""ROS 2 bags (MCAP or sqlite3) of a tactile camera and a force-torque sensor."""

from array import array
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import av
import numpy as np

from sliplens.errors import RecordingError, SliplensError
from sliplens.extras import require_packages
from sliplens.files import require_file
from sliplens.images import image_size, read_image
from sliplens.recordings.capture import Capture, Forces, Frame
from sliplens.recordings.formats.tables import trial_name
from sliplens.recordings.options import ReadOptions

if TYPE_CHECKING:
    from rosbags.rosbag2 import Reader

COMPRESSED, WRENCH = "sensor_msgs/msg/CompressedImage", "geometry_msgs/msg/WrenchStamped"
_TYPES = {"image": ("sensor_msgs/msg/Image", COMPRESSED), "wrench": (WRENCH, "geometry_msgs/msg/Wrench")}
_ENCODINGS = {
    "rgb8": (3, "rgb24"),
    **dict.fromkeys(("bgr8", "8UC3"), (3, "bgr24")),
    **dict.fromkeys(("mono8", "8UC1"), (1, "gray")),
    "rgba8": (4, "rgba"),
    **dict.fromkeys(("bgra8", "8UC4"), (4, "bgra")),
    **dict.fromkeys(("yuv422", "uyvy", "yuv422_yuy2", "yuyv"), (2, "yuyv422")),
    **{f"bayer_{order}8": (1, f"bayer_{order}8") for order in ("rggb", "bggr", "gbrg", "grbg")},
}
"""Bytes a pixel of each encoding, and FFmpeg's name of its format."""
_CLOCKS = ("header", "bag")  # of the stamp in a message, and of its arrival at the bag


def _message_size(message: Any, *, where: str) -> tuple[int, int]:
    """Return height and width of an image, in pixels, without decoding it."""
    if message.__msgtype__ == COMPRESSED:
        return image_size(message.data, where=f"{where}, of format {message.format[:40]!r},")
    if message.encoding not in _ENCODINGS:
        raise RecordingError(f"{where} has encoding {message.encoding[:40]!r}; record it as rgb8, bgr8, mono8 or PNG")
    channels, _ = _ENCODINGS[message.encoding]
    height, width, step = message.height, message.width, message.step
    # nothing has the claimed size until it is known to be there
    fits = step >= width * channels and height * step <= len(message.data) and not (channels == 2 and width % 2)
    if not (height and width and fits):
        claims = f"claims {height} rows of {step} bytes for {width} pixels of {message.encoding}"
        raise RecordingError(f"{where} {claims} but holds {len(message.data)} bytes; correct it or record it again")
    return height, width


def bag_messages(path: Path, topics: Mapping[str, str]) -> Iterator[tuple[str, int, Any]]:
    """Iterate over topic, time of arrival in nanoseconds and content of messages, in the order of recording."""
    with open_bag(path) as bag:
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 (an extra)

        # never the types that a file defines: `rosbags` turns definitions into code
        types = get_typestore(Stores.LATEST)
        chosen = [each for each in bag.connections if topics.get(each.topic) == each.msgtype]
        if not chosen:  # to rosbags none means all
            return
        for connection, time_ns, data in bag.messages(chosen):
            yield connection.topic, time_ns, types.deserialize_cdr(memoryview(data), connection.msgtype)


@contextmanager
def open_bag(path: Path) -> Iterator["Reader"]:
    """Open a bag; whatever its readers raise inside becomes a `RecordingError`."""
    if path.suffix == ".bag":
        raise RecordingError(f"{path} is a ROS 1 bag; convert it with `rosbags-convert --src BAG --dst FOLDER`")
    require_packages("rosbags", extra="ros", purpose="a ROS 2 bag")
    from rosbags.rosbag2 import Reader  # noqa: PLC0415 (an extra)

    files = sorted(file for file in path.iterdir() if file.suffix in {".mcap", ".db3"}) if path.is_dir() else [path]
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        inside = " or ".join(file.name for file in files[:3]) or "the folder of a bag"
        raise RecordingError(f"{path} has no metadata.yaml; write it with `ros2 bag reindex`, or name {inside}")
    for file in files:
        require_file(file)
        # https://www.sqlite.org/fileformat.html: 16 bytes of magic, then the page size, where 1 stands for 65536
        with file.open("rb") as stream:
            head = stream.read(18)
        page = int.from_bytes(head[16:18], "big")
        if head.startswith(b"SQLite format 3\0") and file.stat().st_size % (65536 if page == 1 else page or 1):
            raise RecordingError(f"{file} is cut off; copy it again")  # sqlite would read zeros there
    try:
        with Reader(path) as bag:
            yield bag
    except SliplensError:
        raise
    # a damaged byte may lead rosbags, sqlite or YAML into any error there is, from KeyError to MemoryError
    except Exception as error:
        text = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise RecordingError(f"{path} is not a readable ROS 2 bag ({text}); try `mcap recover`") from None


def _choose_topic(path: Path, topics: Mapping[str, str], name: str | None, *, what: str) -> str | None:
    """Return the topic that an option names, or the only one of its kind; None where there is none."""
    fitting = [topic for topic, kind in topics.items() if kind in _TYPES[what]]
    chosen = [topic for topic in fitting if name in {None, topic}]
    if len(chosen) > 1 or (name and not chosen):
        wanted = f"no {what} topic {name}" if name else f"{len(chosen)} {what} topics"
        raise RecordingError(f"{path} has {wanted} among {', '.join(fitting) or 'none'}; name one with --{what}-topic")
    return next(iter(chosen), None)


def read_rosbag(path: Path, options: ReadOptions) -> Capture:
    """Read a bag as one trial.

    A first pass reads stamps and sizes; pixels are decoded when frames are read. Frames and forces share the clock of
    the message headers; where a header has no stamp, or the two topics have clocks that never meet, both take the
    times at which the bag received them, and `notes` say so.
    Times are seconds since the first frame or force: since the epoch, double precision would round them to 0.2 us.
    """
    notes, size = [], None
    with open_bag(path) as bag:
        topics = {connection.topic: connection.msgtype for connection in bag.connections}
    images = _choose_topic(path, topics, options.image_topic, what="image")
    wrenches = _choose_topic(path, topics, options.wrench_topic, what="wrench")
    if images is None:
        listed = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(topics.items())) or "no topic"
        raise RecordingError(f"{path} has no topic with images; record the camera too (it has {listed})")
    chosen = {name: topics[name] for name in (images, wrenches) if name is not None}
    # an hour at 1 kHz is 100 MB
    stamps_ns, forces_n = {name: {clock: array("q") for clock in _CLOCKS} for name in chosen}, array("d")
    for name, bag_ns, message in bag_messages(path, chosen):
        if name == images:
            where = f"frame {len(stamps_ns[name]['bag'])} of {images} in {path}"
            before, size = size, _message_size(message, where=where)
            if before not in {None, size}:
                raise RecordingError(f"{where} is of another size than those before it; cut the bag there")
        else:
            force = getattr(message, "wrench", message).force
            forces_n.extend((force.x, force.y, force.z))
        stamp = message.header.stamp if hasattr(message, "header") else None
        stamps_ns[name]["header"].append(0 if stamp is None else stamp.sec * 1_000_000_000 + stamp.nanosec)
        stamps_ns[name]["bag"].append(bag_ns)
    if size is None:
        raise RecordingError(f"{images} of {path} has no frame; leave it out or record it again")
    if not forces_n and options.wrench_topic is None:
        notes.append(f"There are no forces: {wrenches or 'the bag'} has no message of {WRENCH}.")
        wrenches = None
    clock, why = _choose_clock({name: stamps for name, stamps in stamps_ns.items() if stamps["bag"]})
    zero = min(stamps[clock][0] for stamps in stamps_ns.values() if stamps[clock])
    time_s = {name: (np.array(stamps[clock], dtype=np.int64) - zero) / 1e9 for name, stamps in stamps_ns.items()}
    force_n, source = np.array(forces_n, dtype=np.float64).reshape(-1, 3), f"{wrenches} of {path}"
    forces = None if wrenches is None else Forces(time_s=time_s[wrenches], force_n=force_n, source=source)
    return Capture(
        trial=trial_name(path.stem if path.is_file() else path.resolve().name),
        source=f"{images} of {path}",
        frame_time_s=time_s[images],
        frame_size=size,
        read_frames=partial(_read_frames, path, images, topics[images]),
        forces=forces,
        notes=(*notes, *why),
    )


def _read_frames(path: Path, images: str, kind: str) -> Iterator[Frame]:
    for index, (_, _, message) in enumerate(bag_messages(path, {images: kind})):
        where = f"frame {index} of {images} in {path}"
        if kind == COMPRESSED:
            yield read_image(message.data, where=where)
            continue
        height, width = _message_size(message, where=where)
        channels, form = _ENCODINGS[message.encoding]
        # rows may be padded: step counts the padding too
        rows = message.data[: height * message.step].reshape(height, message.step)[:, : width * channels]
        swapped = form == "bgr24" or message.encoding in {"yuv422", "uyvy"}
        pixels = np.ascontiguousarray(rows.reshape(height, width, channels)[..., :: -1 if swapped else 1])
        if form not in {"rgb24", "bgr24", "gray"}:
            frame = av.VideoFrame.from_ndarray(pixels if channels > 1 else pixels[..., 0], format=form)
            pixels = frame.to_ndarray(format="rgb24")
        yield np.repeat(pixels, 3, axis=2) if pixels.shape[2] == 1 else pixels


def _choose_clock(topics: Mapping[str, Mapping[str, array]]) -> tuple[str, list[str]]:
    """Choose the clock that all topics have, "header" or "bag", with a note where it is not the header's."""
    instead = "times are those at which the bag received the messages."
    for name, stamps in topics.items():
        if missing := stamps["header"].count(0):
            return "bag", [f"{missing} of {len(stamps['header'])} messages of {name} have no header stamp: {instead}"]

    def meet(clock: str) -> bool:
        frames, wrenches = (stamps[clock] for stamps in topics.values())
        return frames[0] <= wrenches[-1] and wrenches[0] <= frames[-1]

    if len(topics) == 2 and not meet("header") and meet("bag"):
        return "bag", [f"The header stamps of {' and '.join(topics)} are of different clocks: {instead}"]
    return "header", []
